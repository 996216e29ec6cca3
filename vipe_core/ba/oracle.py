"""One Gauss-Newton step of a small problem by brute force: the truth that the solvers are tested against.

Float64, every Jacobian by automatic differentiation of the public camera and SE3 functions, the whole matrix over
poses, extrinsics, intrinsics and inverse depths dense. Shares no linearisation, elimination or layout with the solvers.
"""

from __future__ import annotations

import torch
from torch import Tensor

from vipe_core.ba import robust
from vipe_core.ba.problem import Options, Problem, State
from vipe_core.ba.rigs import extrinsic_residual
from vipe_core.ba.solver import Step
from vipe_core.cameras import projection
from vipe_core.geometry import se3


def newton_step(problem: Problem, state: State, options: Options, damping: float = 0.0) -> Step:
    """The step that `vipe_core.ba.newton_step` must give, for problems of a few thousand unknowns.

    Damping is the solver's: lambda times the curvature of each inverse depth, and lambda times the diagonal of the
    reduced system (the Schur complement of the damped depths). Steps of log f and alpha are not clamped here.
    """
    edges, free, rig = problem.edges, problem.free, problem.rig
    num_frames, num_cells = state.inverse_depth.shape
    pose_of = torch.arange(num_frames) if rig is None else rig.pose_of_frame
    view_of = torch.zeros(num_frames, dtype=torch.int64) if rig is None else rig.view_of_frame
    num_poses, num_views = int(pose_of.max()) + 1, int(view_of.max()) + 1
    cam_from_rig = torch.eye(4, dtype=torch.float64).expand(num_views, 4, 4)
    if state.cam_from_rig is not None:
        cam_from_rig = state.cam_from_rig
    cameras = state.intrinsics.reshape(-1, state.intrinsics.shape[-1])
    num_cameras = len(cameras)
    camera_of = view_of if num_cameras > 1 else torch.zeros_like(view_of)

    apart = pose_of[edges.source] != pose_of[edges.target]
    touched = torch.zeros(num_poses, dtype=torch.bool)
    touched[pose_of[edges.source[apart]]] = True
    touched[pose_of[edges.target[apart]]] = True
    free_poses = torch.zeros(num_poses, dtype=torch.bool)
    free_poses[pose_of[free.poses]] = True
    seen_views = torch.zeros(num_views, dtype=torch.bool)
    seen_views[view_of[edges.source]] = True
    seen_views[view_of[edges.target]] = True
    seen_views[0] = False
    sources = torch.zeros(num_frames, dtype=torch.bool)
    sources[edges.source] = True
    bends = free.distortion and problem.camera_model == "mei"
    # Scale and shift of each frame's prior.
    priors = problem.priors
    sigmas = torch.tensor([priors.inverse_depth_scale_sigma, priors.inverse_depth_shift_sigma], dtype=torch.float64)
    own = (sigmas > 0) & (priors.inverse_depth is not None)
    moving = torch.cat(
        (
            (free_poses & touched).repeat_interleave(6),
            (seen_views & free.extrinsics).repeat_interleave(6),
            torch.tensor([free.focal] * num_cameras + [bends] * num_cameras),
            (free.inverse_depth & sources).repeat_interleave(num_cells),
            (free.inverse_depth & sources).repeat_interleave(2) & own.repeat(num_frames),
        )
    )
    sizes = [6 * num_poses, 6 * num_views, num_cameras, num_cameras, num_frames * num_cells, 2 * num_frames]
    num_shared = sum(sizes[:-2])
    sample_px = problem.grid.sample_px()
    if sample_px.ndim == 3:
        sample_px = sample_px[edges.source]
    sqrt_weight = edges.weight.double().sqrt()
    start = torch.zeros(len(moving), dtype=torch.float64)

    def unpack(update: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        twists, extrinsics, log_focal, alpha, depth, _ = torch.split(update, sizes)
        views = se3.exp(extrinsics.reshape(num_views, 6)) @ cam_from_rig
        if rig is None:
            poses = se3.exp(twists.reshape(num_frames, 6)) @ state.cam_from_world
        else:
            rig_from_world = se3.inverse(cam_from_rig[view_of]) @ state.cam_from_world
            poses = views[view_of] @ se3.exp(twists.reshape(num_poses, 6))[pose_of] @ rig_from_world
        params = torch.cat((cameras[:, :2] * log_focal.exp()[:, None], cameras[:, 2:]), dim=1)
        if problem.camera_model == "mei":
            params = torch.cat((params[:, :4], params[:, 4:] + alpha[:, None]), dim=1)
        return poses, views, params, state.inverse_depth.double() + depth.reshape(num_frames, num_cells)

    def measure(update: Tensor) -> tuple[Tensor, Tensor]:
        poses, _, params, depth = unpack(update)
        # (K, E, 1): a number per edge.
        from_camera, in_camera = (params[camera_of[ends]].T[..., None] for ends in (edges.source, edges.target))
        rays = projection.unproject(problem.camera_model, from_camera, sample_px)
        transform = se3.relative(poses[edges.target], poses[edges.source])
        points = torch.einsum("eij,epj->epi", transform[:, :3, :3], rays)
        points = points + depth[edges.source][..., None] * transform[:, None, :3, 3]
        px, valid = projection.project(problem.camera_model, in_camera, points)
        factor, _ = projection.depth_factor(problem.camera_model, in_camera, points)
        first, _ = projection.depth_factor(problem.camera_model, from_camera, rays)
        return px - edges.target_px, valid & (factor > options.min_depth_ratio * first)

    residual, valid = measure(start)
    squared = ((sqrt_weight * residual) ** 2).sum(-1) / edges.weight.double().amax(-1).clamp_min(1e-300)
    slope = robust.root_slope(
        options.robust, options.robust_scale_px, residual**2 if options.componentwise else squared[..., None]
    )
    scale = sqrt_weight * valid[..., None] * (1.0 if slope is None else slope)

    def weighted(update: Tensor) -> Tensor:
        rows = [(scale * measure(update)[0]).flatten()]
        _, views, params, depth = unpack(update)
        if priors.inverse_depth is not None and priors.inverse_depth_weight is not None:
            change = (fitted + update[-2 * num_frames :]).reshape(num_frames, 2)
            value = change[:, :1] * priors.inverse_depth + change[:, 1:]
            rows.append((priors.inverse_depth_weight.double().sqrt() * (depth - value)).flatten())
            rows.append(((change - unbiased) / torch.where(own, sigmas, torch.inf)).flatten())
        if priors.log_focal is not None:
            log_focal = torch.tensor(priors.log_focal, dtype=torch.float64)
            rows.append((params[:, 0].log() - log_focal) / priors.log_focal_sigma)
        if priors.cam_from_rig is not None:
            rows.append(extrinsic_residual(views, priors).flatten())
        return torch.cat(rows)

    # At the depths given, they are where they cost least.
    unbiased = torch.tensor([1.0, 0.0], dtype=torch.float64)
    fitted = unbiased.repeat(num_frames)
    if own.any():
        theirs = torch.zeros(len(moving), dtype=torch.bool)
        theirs[-2 * num_frames :] = own.repeat(num_frames)
        slope = torch.func.jacfwd(weighted)(start)[:, theirs]
        fitted[own.repeat(num_frames)] -= torch.linalg.lstsq(slope, weighted(start)).solution
    jacobian = torch.func.jacfwd(weighted)(start)[:, moving]
    hessian = jacobian.T @ jacobian
    gradient = -jacobian.T @ weighted(start)

    depths = torch.zeros_like(moving)
    depths[num_shared:] = True
    depths = depths[moving]
    private = hessian[depths][:, depths] * (1 + damping)
    seen = private.diagonal() > 0
    q = torch.linalg.inv(private + torch.diag((~seen).double())) * seen
    coupling = hessian[~depths][:, depths]
    reduced = hessian[~depths][:, ~depths] - coupling @ q @ coupling.T
    damped = reduced + damping * torch.diag(reduced.diagonal())
    shared = torch.linalg.solve(damped, gradient[~depths] - coupling @ q @ gradient[depths])
    solution = torch.zeros_like(gradient)
    solution[~depths] = shared
    solution[depths] = q @ (gradient[depths] - coupling.T @ shared)

    update = start.clone()
    update[moving] = solution
    twists, extrinsics, log_focal, alpha, depth, _ = torch.split(update, sizes)
    pose = twists.reshape(num_poses, 6)[pose_of]
    if rig is not None:
        pose = (se3.adjoint(cam_from_rig)[view_of] @ pose[..., None])[..., 0]
    shape = state.intrinsics.shape[:-1]
    return Step(
        pose=pose,
        log_focal=log_focal.reshape(shape),
        alpha=alpha.reshape(shape),
        inverse_depth=depth.reshape(num_frames, num_cells),
        predicted_drop=gradient @ solution,
        factorised=torch.tensor(True),
        extrinsic=None if rig is None else extrinsics.reshape(num_views, 6),
    )
