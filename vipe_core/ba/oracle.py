"""One Gauss-Newton step of a small problem by brute force: the truth that the solvers are tested against.

Float64, every Jacobian by automatic differentiation of the public camera and SE3 functions, the whole matrix over
poses, intrinsics and inverse depths dense. Shares no linearisation, elimination or layout with the solvers.
"""

from __future__ import annotations

import torch
from torch import Tensor

from vipe_core.ba import robust
from vipe_core.ba.problem import Options, Problem, State
from vipe_core.ba.solver import Step
from vipe_core.cameras import projection
from vipe_core.geometry import se3


def newton_step(problem: Problem, state: State, options: Options, damping: float = 0.0) -> Step:
    """The step that `vipe_core.ba.newton_step` must give, for problems of a few thousand unknowns.

    Damping is the solver's: lambda times the curvature of each inverse depth, and lambda times the diagonal of the
    reduced system (the Schur complement of the damped depths). Steps of log f and alpha are not clamped here.
    """
    edges, free = problem.edges, problem.free
    num_frames, num_cells = state.inverse_depth.shape
    touched = torch.zeros(num_frames, dtype=torch.bool)
    touched[edges.source] = True
    touched[edges.target] = True
    sources = torch.zeros(num_frames, dtype=torch.bool)
    sources[edges.source] = True
    moving = torch.cat(
        (
            (free.poses & touched).repeat_interleave(6),
            torch.tensor([free.focal, free.distortion and problem.camera_model == "mei"]),
            (free.inverse_depth & sources).repeat_interleave(num_cells),
        )
    )
    sizes = [6 * num_frames, 2, num_frames * num_cells]
    sample_px = problem.grid.sample_px()
    sqrt_weight = edges.weight.double().sqrt()
    start = torch.zeros(len(moving), dtype=torch.float64)

    def unpack(update: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        twists, intrinsics, depth = torch.split(update, sizes)
        poses = se3.exp(twists.reshape(num_frames, 6)) @ state.cam_from_world
        params = torch.cat((state.intrinsics[:2] * intrinsics[0].exp(), state.intrinsics[2:]))
        if problem.camera_model == "mei":
            params = torch.cat((params[:4], params[4:] + intrinsics[1]))
        return poses, params, state.inverse_depth.double() + depth.reshape(num_frames, num_cells)

    def measure(update: Tensor) -> tuple[Tensor, Tensor]:
        poses, params, depth = unpack(update)
        rays = projection.unproject(problem.camera_model, params, sample_px)
        transform = se3.relative(poses[edges.target], poses[edges.source])
        points = torch.einsum("eij,pj->epi", transform[:, :3, :3], rays)
        points = points + depth[edges.source][..., None] * transform[:, None, :3, 3]
        px, valid = projection.project(problem.camera_model, params, points)
        factor, _ = projection.depth_factor(problem.camera_model, params, points)
        first, _ = projection.depth_factor(problem.camera_model, params, rays)
        return px - edges.target_px, valid & (factor > options.min_depth_ratio * first)

    residual, valid = measure(start)
    squared = ((sqrt_weight * residual) ** 2).sum(-1) / edges.weight.double().amax(-1).clamp_min(1e-300)
    slope = robust.root_slope(options.robust, options.robust_scale_px, squared)
    scale = sqrt_weight * valid[..., None] * (1.0 if slope is None else slope[..., None])

    def weighted(update: Tensor) -> Tensor:
        rows = [(scale * measure(update)[0]).flatten()]
        _, params, depth = unpack(update)
        priors = problem.priors
        if priors.inverse_depth is not None and priors.inverse_depth_weight is not None:
            rows.append((priors.inverse_depth_weight.double().sqrt() * (depth - priors.inverse_depth)).flatten())
        if priors.log_focal is not None:
            rows.append(((params[0].log() - priors.log_focal) / priors.log_focal_sigma)[None])
        return torch.cat(rows)

    jacobian = torch.func.jacfwd(weighted)(start)[:, moving]
    hessian = jacobian.T @ jacobian
    gradient = -jacobian.T @ weighted(start)

    depths = torch.zeros_like(moving)
    depths[6 * num_frames + 2 :] = True
    depths = depths[moving]
    curvature = hessian.diagonal()[depths] * (1 + damping)
    seen = curvature > 0
    q = torch.where(seen, curvature, 1).reciprocal() * seen
    coupling = hessian[~depths][:, depths]
    reduced = hessian[~depths][:, ~depths] - (coupling * q) @ coupling.T
    damped = reduced + damping * torch.diag(reduced.diagonal())
    shared = torch.linalg.solve(damped, gradient[~depths] - coupling @ (q * gradient[depths]))
    solution = torch.zeros_like(gradient)
    solution[~depths] = shared
    solution[depths] = q * (gradient[depths] - coupling.T @ shared)

    update = start.clone()
    update[moving] = solution
    twists, intrinsics, depth = torch.split(update, sizes)
    return Step(
        pose=twists.reshape(num_frames, 6),
        log_focal=intrinsics[0],
        alpha=intrinsics[1],
        inverse_depth=depth.reshape(num_frames, num_cells),
        predicted_drop=gradient @ solution,
        factorised=torch.tensor(True),
    )
