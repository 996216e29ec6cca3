"""The measurement model outside of the solver: where a state sees the cells of a source frame in a target frame."""

from __future__ import annotations

import torch
from torch import Tensor

from vipe_core.ba.problem import Grid, Options, Problem, Rig, State
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


def min_depth_factor(
    camera_model: CameraModel, intrinsics: Tensor, sample_px: Tensor, rays: Tensor, min_depth_ratio: float
) -> Tensor:
    """(P,) smallest s = z + alpha |X| at which a transformed point still counts; infinite where a cell has no ray.

    For a pinhole camera s starts at one and this is the ratio itself.
    """
    s, _ = projection.depth_factor(camera_model, intrinsics, rays)
    on_disk = projection.on_image_disk(camera_model, intrinsics, sample_px) & (s > 0)
    return torch.where(on_disk, min_depth_ratio * s, torch.inf)


def cameras_of(intrinsics: Tensor, rig: Rig | None, num_frames: int) -> tuple[Tensor, Tensor]:
    """(C, K) different intrinsics of a problem, and (N,) int64 which of them each frame has."""
    if intrinsics.ndim == 1 or rig is None:
        return intrinsics.reshape(1, -1), torch.zeros(num_frames, dtype=torch.int64, device=intrinsics.device)
    return intrinsics, rig.view_of_frame.to(intrinsics.device)


def reproject(
    camera_model: CameraModel,
    grid: Grid,
    state: State,
    source: Tensor,
    target: Tensor,
    min_depth_ratio: float = _MIN_DEPTH_RATIO,
    rig: Rig | None = None,
) -> tuple[Tensor, Tensor]:
    """Where every source cell is seen in the target frame.

    Args:
        camera_model: `pinhole` or `mei`.
        grid: The cells.
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
    sample_px = grid.sample_px(device=device)
    tables = [projection.unproject(camera_model, camera, sample_px) for camera in cameras]
    floors = [
        min_depth_factor(camera_model, camera, sample_px, rays, min_depth_ratio).to(dtype)
        for camera, rays in zip(cameras, tables, strict=True)
    ]
    target_from_source = se3.relative(state.cam_from_world[target], state.cam_from_world[source]).to(dtype)
    rays_of, floor_of, params_of = torch.stack(tables).to(dtype), torch.stack(floors), cameras.to(dtype)
    alone = len(cameras) == 1

    cells = grid.num_cells
    px = torch.empty(len(source), cells, 2, dtype=dtype, device=device)
    valid = torch.empty(len(source), cells, dtype=torch.bool, device=device)
    batch = max(_BATCH_CELLS // max(cells, 1), 1)
    for start in range(0, len(source), batch):
        edges = slice(start, start + batch)
        transform = target_from_source[edges]
        seen_from, seen_in = camera_of[source[edges]], camera_of[target[edges]]
        rays = rays_of[0] if alone else rays_of[seen_from]
        floor = floor_of[0] if alone else floor_of[seen_from]
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
