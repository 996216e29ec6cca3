"""Synthetic bundle adjustment problems with a known answer."""

from __future__ import annotations

from dataclasses import replace

import torch

from vipe_core.ba import Edges, Free, Grid, Points, Priors, Problem, State, reproject
from vipe_core.cameras import CameraModel
from vipe_core.geometry import se3


def scene(
    camera_model: CameraModel = "pinhole",
    num_frames: int = 5,
    height: int = 5,
    width: int = 7,
    reach: int = 2,
    seed: int = 0,
    alpha: float = 0.6,
    focal_free: bool = True,
    distortion_free: bool = False,
) -> tuple[Problem, State]:
    """A camera that moves sideways and turns a little before a rough wall; exact measurements.

    Returns:
        The problem (pose 0 and the inverse depths free but for the gauge) and the true state, float64.
    """
    rng = torch.Generator().manual_seed(seed)
    grid = Grid(height, width)
    focal = 0.9 * width * grid.stride
    intrinsics = [focal, focal, width * grid.stride / 2 - 0.5, height * grid.stride / 2 - 0.5]
    if camera_model == "mei":
        intrinsics = [focal * (1 + alpha), focal * (1 + alpha), *intrinsics[2:], alpha]
    twists = torch.randn(num_frames, 6, generator=rng, dtype=torch.float64) * 0.03
    twists[:, 0] += 0.25 * torch.arange(num_frames, dtype=torch.float64)
    twists[:, 2] += 0.1 * torch.arange(num_frames, dtype=torch.float64)
    inverse_depth = 0.3 + 0.7 * torch.rand(num_frames, grid.num_cells, generator=rng, dtype=torch.float64)
    state = State(se3.exp(twists), inverse_depth, torch.tensor(intrinsics, dtype=torch.float64))
    pairs = [(i, j) for i in range(num_frames) for j in range(num_frames) if i != j and abs(i - j) <= reach]
    source, target = torch.tensor(pairs).T.contiguous()
    target_px, valid = reproject(camera_model, grid, state, source, target)
    weight = 0.2 + torch.rand(len(pairs), grid.num_cells, 2, generator=rng, dtype=torch.float64)
    edges = Edges(source, target, target_px, weight * valid[..., None])
    poses = torch.ones(num_frames, dtype=torch.bool)
    poses[0] = False
    free = Free(poses, torch.ones(num_frames, dtype=torch.bool), focal_free, distortion_free)
    return Problem(camera_model, grid, edges, free), state


def disturbed(state: State, seed: int = 1, twist: float = 0.02, depth: float = 0.1, log_focal: float = 0.05) -> State:
    """The state with noise on everything but pose 0."""
    rng = torch.Generator().manual_seed(seed)
    noise = twist * torch.randn(len(state.cam_from_world), 6, generator=rng, dtype=torch.float64)
    noise[0] = 0
    factor = 1 + depth * (2 * torch.rand(state.inverse_depth.shape, generator=rng, dtype=torch.float64) - 1)
    intrinsics = state.intrinsics.clone()
    intrinsics[:2] *= torch.tensor(log_focal, dtype=torch.float64).exp()
    return State(se3.exp(noise) @ state.cam_from_world, state.inverse_depth * factor, intrinsics)


def with_noise(problem: Problem, sigma_px: float, seed: int = 2) -> Problem:
    """Gaussian noise on the measurements."""
    rng = torch.Generator().manual_seed(seed)
    noise = sigma_px * torch.randn(problem.edges.target_px.shape, generator=rng, dtype=torch.float64)
    return replace(problem, edges=replace(problem.edges, target_px=problem.edges.target_px + noise))


def with_depth_prior(problem: Problem, value: torch.Tensor, weight: float) -> Problem:
    information = torch.full_like(value, weight)
    if isinstance(problem.grid, Points):
        information *= problem.grid.real()
    return replace(problem, priors=replace(problem.priors, inverse_depth=value, inverse_depth_weight=information))


def with_tracks(
    problem: Problem, truth: State, most: int = 9, seed: int = 5, *, alone: bool = False
) -> tuple[Problem, State]:
    """Exactly measured tracks beside the cells of the grid, or alone: up to `most` in a frame, none in its first.

    A third of the tracks is not seen by an edge. What fills up has inverse depths far from all others.
    """
    rng = torch.Generator().manual_seed(seed)
    grid, edges, frames = problem.grid, problem.edges, len(truth.cam_from_world)
    assert isinstance(grid, Grid)
    count = torch.randint(0, most + 1, (frames,), generator=rng)
    count[0], count[-1] = 0, most
    size = torch.tensor([grid.width, grid.height], dtype=torch.float64) * grid.stride
    px = torch.rand(frames, most, 2, generator=rng, dtype=torch.float64) * size - 0.5
    real = torch.arange(most) < count[:, None]
    depth = 0.3 + 0.7 * torch.rand(frames, most, generator=rng, dtype=torch.float64)
    tracks = replace(truth, inverse_depth=torch.where(real, depth, 1e7))
    target_px, valid = reproject(
        problem.camera_model, Points(px, count), tracks, edges.source, edges.target, rig=problem.rig
    )
    seen = valid & real[edges.source] & (torch.rand(valid.shape, generator=rng) < 0.7)
    weight = 0.2 + torch.rand(target_px.shape, generator=rng, dtype=torch.float64)
    measured = replace(edges, target_px=target_px, weight=weight * seen[..., None])
    if alone:
        return replace(problem, grid=Points(px, count), edges=measured), tracks
    measured = replace(
        edges,
        target_px=torch.cat((edges.target_px, measured.target_px), dim=1),
        weight=torch.cat((edges.weight, measured.weight), dim=1),
    )
    both = torch.cat((truth.inverse_depth, tracks.inverse_depth), dim=1)
    return replace(problem, grid=Points.beside(grid, px, count), edges=measured), replace(truth, inverse_depth=both)


def float32(problem: Problem, state: State) -> tuple[Problem, State]:
    """Measurements and inverse depths in single precision."""
    edges = replace(problem.edges, target_px=problem.edges.target_px.float(), weight=problem.edges.weight.float())
    return replace(problem, edges=edges), replace(state, inverse_depth=state.inverse_depth.float())


__all__ = ["Priors", "disturbed", "float32", "scene", "with_depth_prior", "with_noise", "with_tracks"]
