"""The measurement model outside of the solver: where a state sees the cells of a source frame in a target frame."""

from __future__ import annotations

import torch
from torch import Tensor

from vipe_core.ba.problem import Grid, Options, Problem, State
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


def reproject(
    camera_model: CameraModel,
    grid: Grid,
    state: State,
    source: Tensor,
    target: Tensor,
    min_depth_ratio: float = _MIN_DEPTH_RATIO,
) -> tuple[Tensor, Tensor]:
    """Where every source cell is seen in the target frame.

    Args:
        camera_model: `pinhole` or `mei`.
        grid: The cells.
        state: Poses, inverse depths and intrinsics.
        source: (E,) int64 source frames.
        target: (E,) int64 target frames.
        min_depth_ratio: See `Options`.

    Returns:
        px (E, P, 2) index coordinates in the dtype of the inverse depths, finite everywhere, and valid (E, P) bool.
        A pixel outside of the image is valid.

    Raises:
        ConfigError: A camera model without a projection here.
    """
    require_supported(camera_model)
    dtype, device = state.inverse_depth.dtype, state.inverse_depth.device
    intrinsics = state.intrinsics.to(device)
    sample_px = grid.sample_px(device=device)
    rays = projection.unproject(camera_model, intrinsics, sample_px)
    floor = min_depth_factor(camera_model, intrinsics, sample_px, rays, min_depth_ratio).to(dtype)
    target_from_source = se3.relative(state.cam_from_world[target], state.cam_from_world[source]).to(dtype)
    rays, params = rays.to(dtype), intrinsics.to(dtype)

    px = torch.empty(len(source), len(rays), 2, dtype=dtype, device=device)
    valid = torch.empty(len(source), len(rays), dtype=torch.bool, device=device)
    batch = max(_BATCH_CELLS // max(len(rays), 1), 1)
    for start in range(0, len(source), batch):
        edges = slice(start, start + batch)
        transform = target_from_source[edges]
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
    px, projected = reproject(problem.camera_model, problem.grid, state, edges.source, edges.target, min_depth_ratio)
    valid = projected & (edges.weight.to(px.device) > 0).any(-1)
    return torch.where(valid[..., None], px - edges.target_px.to(px), 0), valid
