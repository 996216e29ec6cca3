"""The measurement model outside of the solvers: rays through cells, and where a state sees them in a target frame."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from vipe_core.ba.problem import Grid, Options, Points, Problem, Rig, State
from vipe_core.cameras import CameraModel, projection
from vipe_core.errors import ConfigError
from vipe_core.geometry import se3

# Edge cells per batch, to bound the temporaries.
_BATCH_CELLS = 1 << 20
_MIN_DEPTH_RATIO = Options().min_depth_ratio


def require_supported(camera_model: CameraModel) -> None:
    """Raises ConfigError for a camera model that bundle adjustment has no derivatives for."""
    if camera_model not in ("pinhole", "mei"):
        raise ConfigError(f"bundle adjustment takes pinhole and mei cameras, not {camera_model!r}")


class Rays(NamedTuple):
    """Rays through cells in float64: T tables, one for each camera, or for each frame where it has its own points.

    Attributes:
        of_frame: (N,) int64 which table a frame has.
        params: (K, T, 1) intrinsics, as `projection` takes them for all tables at once.
        px: (P, 2) or (T, P, 2) index coordinates of the cells.
        rays: (T, P, 3).
        min_s: (T, P) smallest s = z + alpha |X| at which a transformed point still counts; infinite where a cell has no
            ray. For a pinhole camera s starts at one and this is `Options.min_depth_ratio` itself.
    """

    of_frame: Tensor
    params: Tensor
    px: Tensor
    rays: Tensor
    min_s: Tensor


def rays_of(camera_model: CameraModel, px: Tensor, cameras: Tensor, camera_of: Tensor, min_depth_ratio: float) -> Rays:
    """Rays through the cells of every frame.

    Args:
        px: `Grid.sample_px` or `Points.sample_px`.
        cameras, camera_of: As from `cameras_of`.
    """
    of_frame = camera_of
    if px.ndim == 3:
        cameras, of_frame = cameras[camera_of], torch.arange(len(px), device=px.device)
    params = cameras.T[..., None]
    rays = projection.unproject(camera_model, params, px)
    s, _ = projection.depth_factor(camera_model, params, rays)
    on_disk = projection.on_image_disk(camera_model, params, px) & (s > 0)
    return Rays(of_frame, params, px, rays, torch.where(on_disk, min_depth_ratio * s, torch.inf))


def median_inverse_depth(grid: Grid | Points, inverse_depth: Tensor) -> Tensor:
    """0-dim median of (N, P) inverse depths but for those that fill up."""
    if isinstance(grid, Grid):
        return inverse_depth.median()
    return torch.where(grid.real(inverse_depth.device), inverse_depth, torch.nan).nanmedian()


def cameras_of(intrinsics: Tensor, rig: Rig | None, num_frames: int) -> tuple[Tensor, Tensor]:
    """(C, K) different intrinsics of a problem, and (N,) int64 which of them each frame has."""
    if intrinsics.ndim == 1 or rig is None:
        return intrinsics.reshape(1, -1), torch.zeros(num_frames, dtype=torch.int64, device=intrinsics.device)
    return intrinsics, rig.view_of_frame.to(intrinsics.device)


def reproject(
    camera_model: CameraModel,
    grid: Grid | Points,
    state: State,
    source: Tensor,
    target: Tensor,
    min_depth_ratio: float = _MIN_DEPTH_RATIO,
    rig: Rig | None = None,
) -> tuple[Tensor, Tensor]:
    """Where every source cell is seen in the target frame.

    Args:
        camera_model: `pinhole` or `mei`.
        grid: The cells, or the points of each frame.
        state: Poses, inverse depths and intrinsics.
        source: (E,) int64 source frames.
        target: (E,) int64 target frames.
        min_depth_ratio: See `Options`.
        rig: Says which intrinsics are of which frame where each view has its own.

    Returns:
        px (E, P, 2) index coordinates in the dtype of the inverse depths, finite everywhere, and valid (E, P) bool.
        A pixel outside of the image is valid.

    Raises:
        ConfigError: A camera model without a projection here.
    """
    require_supported(camera_model)
    dtype, device = state.inverse_depth.dtype, state.inverse_depth.device
    cameras, camera_of = cameras_of(state.intrinsics.to(device), rig, len(state.cam_from_world))
    through = rays_of(camera_model, grid.sample_px(device=device), cameras, camera_of, min_depth_ratio)
    tables, floors, params_of = through.rays.to(dtype), through.min_s.to(dtype), cameras.to(dtype)
    target_from_source = se3.relative(state.cam_from_world[target], state.cam_from_world[source]).to(dtype)
    alone, one_table = len(cameras) == 1, len(tables) == 1

    cells = grid.num_cells
    px = torch.empty(len(source), cells, 2, dtype=dtype, device=device)
    valid = torch.empty(len(source), cells, dtype=torch.bool, device=device)
    batch = max(_BATCH_CELLS // max(cells, 1), 1)
    for start in range(0, len(source), batch):
        edges = slice(start, start + batch)
        transform = target_from_source[edges]
        seen_from, seen_in = through.of_frame[source[edges]], camera_of[target[edges]]
        rays = tables[0] if one_table else tables[seen_from]
        floor = floors[0] if one_table else floors[seen_from]
        # One column per edge, so that the camera functions take them as numbers.
        params = params_of[0] if alone else params_of[seen_in].T[..., None]
        points = rays @ transform[:, :3, :3].mT
        points = torch.addcmul(points, state.inverse_depth[source[edges]][..., None], transform[:, None, :3, 3])
        px[edges], imaged = projection.project(camera_model, params, points)
        valid[edges] = imaged & (projection.depth_factor(camera_model, params, points)[0] > floor)
    return px, valid


def residuals(problem: Problem, state: State, min_depth_ratio: float = _MIN_DEPTH_RATIO) -> tuple[Tensor, Tensor]:
    """Reprojection minus measurement of every edge.

    Returns:
        residual (E, P, 2) px, zero where not valid, and valid (E, P) bool: measured (a positive weight in u or v) and
        projected.
    """
    edges = problem.edges
    px, projected = reproject(
        problem.camera_model, problem.grid, state, edges.source, edges.target, min_depth_ratio, problem.rig
    )
    valid = projected & (edges.weight.to(px.device) > 0).any(-1)
    return torch.where(valid[..., None], px - edges.target_px.to(px), 0), valid
