"""Accuracy against ground truth: trajectory, field of view and depth, as in the paper's tables.

An estimate is defined up to a similarity transform of the world, so trajectories are compared after the least-squares
Sim(3) alignment of the camera centres, and depth after one alignment for the whole sequence: the median scale unless
told otherwise. The paper's depth table follows the protocol of CUT3R, which has all of `DepthAlignment`, without saying
which; so a report names the one it used.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from vipe_core.annotation import DepthKind
from vipe_core.cameras import Camera
from vipe_core.geometry import Sim3, umeyama

DepthAlignment = Literal["metric", "scale", "scale_shift"]
"""`metric`: none. `scale`: the median of truth / estimate. `scale_shift`: scale and offset with the least absolute
error. One for all frames of a sequence, never per frame."""
DEPTH_ALIGNMENTS: tuple[DepthAlignment, ...] = ("metric", "scale", "scale_shift")

_MAX_FITTED = 1_000_000  # values that scale and shift are fitted to; more say nothing new
_MOVES = 1e-6  # metres: below this path length or spread a trajectory counts as standing still


@dataclass(frozen=True, slots=True)
class TrajectoryErrors:
    """Errors of camera poses. None where the truth does not move and the figure means nothing.

    Attributes:
        ate_rmse: RMS distance of the aligned camera centres, units of the truth.
        ate_percent: The same in percent of the true path length.
        rte_rmse: RMS translation error of the motion between consecutive frames, units of the truth.
        rte_percent: The same in percent of the mean true step.
        rre_rmse_deg: RMS rotation error of the motion between consecutive frames, degrees; None without such a pair.
        rotation_rmse_deg: RMS rotation error after the best constant rotation, degrees. Meaningful without parallax.
        scale: Truth units per unit of the estimate; None where it cannot be found.
        path_length: Length of the true path.
    """

    ate_rmse: float | None
    ate_percent: float | None
    rte_rmse: float | None
    rte_percent: float | None
    rre_rmse_deg: float | None
    rotation_rmse_deg: float
    scale: float | None
    path_length: float


@dataclass(frozen=True, slots=True)
class DepthErrors:
    """Errors of depth after one alignment of the whole sequence.

    Attributes:
        abs_rel: Mean of |estimate - truth| / truth (RelAbs in the paper).
        log_rmse: RMS of log(estimate / truth).
        delta125: Share of values within a factor of 1.25 of the truth.
        scale: The factor that was applied; 1 for depth that is metric and right.
        density: Share of the true values that have an estimate.
        shift: What was added after scaling, units of the truth.
    """

    abs_rel: float
    log_rmse: float
    delta125: float
    scale: float
    density: float
    shift: float = 0.0


@dataclass(frozen=True, slots=True)
class CameraErrors:
    """Absolute errors of the horizontal and vertical field of view in degrees, and of the focal length in percent."""

    fov_x_deg: float
    fov_y_deg: float
    focal_percent: float


@dataclass(frozen=True, slots=True)
class MaskErrors:
    """How well masks of moving things match the truth, over all pixels of all frames.

    Attributes:
        iou: Pixels in both masks over pixels in either; None where nothing moves.
        recall: Share of the moving pixels that are masked; None where nothing moves.
        false_alarms: Share of the static pixels that are masked; None where everything moves.
    """

    iou: float | None
    recall: float | None
    false_alarms: float | None


def trajectory_errors(
    estimate: NDArray[np.float64],
    truth: NDArray[np.float64],
    frame_index: NDArray[np.int64] | None = None,
    *,
    with_scale: bool = True,
) -> TrajectoryErrors:
    """Compares `estimate` with `truth`, both world_from_cam (N, 4, 4) of the same frames.

    Args:
        frame_index: (N,) frame numbers; only pairs one apart count as consecutive. Default: all are.
        with_scale: Align by a similarity; otherwise rigidly, where both are in the same units.

    Raises:
        ValueError: Shapes disagree or there are fewer than two poses.
    """
    if estimate.shape != truth.shape or estimate.shape[1:] != (4, 4) or len(estimate) < 2:
        raise ValueError(f"two (N, 4, 4) arrays with N >= 2 are needed, got {estimate.shape} and {truth.shape}")
    true_centres, centres = truth[:, :3, 3], estimate[:, :3, 3]
    path_length = float(np.linalg.norm(np.diff(true_centres, axis=0), axis=1).sum())
    moves = path_length > _MOVES and _spread(true_centres) > _MOVES

    world = mean_rotation(estimate, truth)
    apart = np.einsum("nji,jk,nkl->nil", truth[:, :3, :3], world, estimate[:, :3, :3])
    rotation_rmse_deg = _rms(rotation_angle_deg(apart))

    scale: float | None = None
    ate: float | None = None
    if moves and _spread(centres) > 1e-12:
        truth_from_estimate = align_centres(estimate, truth, with_scale=with_scale)
        scale = truth_from_estimate.scale
        ate = _rms(np.linalg.norm(truth_from_estimate.apply(centres) - true_centres, axis=1))
    elif moves:
        # An estimate that stands still has no scale; the best it can be is the centre of the true path.
        ate = _spread(true_centres)

    numbers = np.arange(len(truth)) if frame_index is None else np.asarray(frame_index)
    pairs = np.flatnonzero(np.diff(numbers) == 1)
    rte = rte_percent = rre = None
    if len(pairs):
        # Without a common scale only rotations can be compared when nothing moves.
        scaled = estimate.copy()
        scaled[:, :3, 3] *= scale if scale is not None else 0.0
        true_step = np.linalg.inv(truth[pairs]) @ truth[pairs + 1]
        error = np.linalg.inv(true_step) @ (np.linalg.inv(scaled[pairs]) @ scaled[pairs + 1])
        rre = _rms(rotation_angle_deg(error[:, :3, :3]))
        if moves:
            rte = _rms(np.linalg.norm(error[:, :3, 3], axis=1))
            rte_percent = 100 * rte / float(np.linalg.norm(true_step[:, :3, 3], axis=1).mean())
    return TrajectoryErrors(
        ate_rmse=ate,
        ate_percent=None if ate is None else 100 * ate / path_length,
        rte_rmse=rte,
        rte_percent=rte_percent,
        rre_rmse_deg=rre,
        rotation_rmse_deg=rotation_rmse_deg,
        scale=scale,
        path_length=path_length,
    )


def camera_errors(estimate: Camera, truth: Camera) -> CameraErrors | None:
    """Compares two cameras of the same image; None when either is a panorama, which has nothing to estimate.

    Raises:
        ValueError: The cameras belong to images of different sizes.
    """
    if (estimate.width, estimate.height) != (truth.width, truth.height):
        raise ValueError(
            f"cameras of different sizes: {estimate.width}x{estimate.height} and {truth.width}x{truth.height}"
        )
    if "equirect" in (estimate.model, truth.model):
        return None
    return CameraErrors(
        fov_x_deg=abs(estimate.fov_x_deg - truth.fov_x_deg),
        fov_y_deg=abs(estimate.fov_y_deg - truth.fov_y_deg),
        focal_percent=100 * abs(estimate.focal_px / truth.focal_px - 1),
    )


def depth_errors(
    pairs: Iterable[tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]],
    alignment: DepthAlignment = "scale",
    max_depth: float | None = None,
) -> DepthErrors | None:
    """Compares depth frame by frame with one alignment for the sequence; all pixels weigh the same.

    Args:
        pairs: (estimate, truth, use) per frame, each (h, w) and of the same kind of depth. Values <= 0 or not finite
            are missing; `use` selects pixels, e.g. the static ones.
        alignment: See `DepthAlignment`.
        max_depth: True values beyond are left out and aligned estimates cut to it (the sky of a rendered film has a
            depth, but no meaning). Units of the truth.

    Returns:
        None without a single pixel that has both values.

    Raises:
        ValueError: Shapes of a frame disagree.
    """
    farthest = math.inf if max_depth is None else max_depth
    estimates, truths, wanted = [], [], 0
    for estimate, truth, use in pairs:
        if not estimate.shape == truth.shape == use.shape:
            raise ValueError(f"frames of different shapes: {estimate.shape}, {truth.shape} and {use.shape}")
        valid = use & np.isfinite(truth) & (truth > _MOVES) & (truth < farthest)
        wanted += int(valid.sum())
        valid &= np.isfinite(estimate) & (estimate > 1e-9)
        estimates.append(estimate[valid])
        truths.append(truth[valid])
    if not sum(map(len, truths)):
        return None
    estimated = np.concatenate(estimates).astype(np.float64)
    true = np.concatenate(truths).astype(np.float64)
    scale, shift = _align_depth(estimated, true, alignment)
    estimated *= scale
    if alignment == "scale_shift" or max_depth is not None:
        # A shift may push near things behind the camera: they stay in the figures, as near as can be.
        estimated = np.clip(estimated + shift, 1e-3 * float(np.median(true)), farthest)
    log_ratio = np.log(estimated / true)
    return DepthErrors(
        abs_rel=float(np.mean(np.abs(estimated - true) / true)),
        log_rmse=_rms(log_ratio),
        delta125=float(np.mean(np.abs(log_ratio) < math.log(1.25))),
        scale=scale,
        density=len(true) / wanted,
        shift=shift,
    )


def mask_errors(pairs: Iterable[tuple[NDArray[Any], NDArray[np.bool_]]]) -> MaskErrors | None:
    """Compares masks with the truth; None without any frame.

    Args:
        pairs: For each frame the mask (H, W), non-zero where something moves, and the truth (h, w) at any size; the
            mask is read at the centres of the truth's pixels.
    """
    both = masked = moving = total = 0
    for mask, truth in pairs:
        found = sample_mask(mask, *truth.shape)
        both += int((found & truth).sum())
        masked += int(found.sum())
        moving += int(truth.sum())
        total += truth.size
    if not total:
        return None
    static = total - moving
    return MaskErrors(
        iou=both / (masked + moving - both) if moving else None,
        recall=both / moving if moving else None,
        false_alarms=(masked - both) / static if static else None,
    )


def sample_mask(mask: NDArray[Any], height: int, width: int) -> NDArray[np.bool_]:
    """(height, width) bool, what a mask (H, W) of the same picture says at the centres of the pixels of that size."""
    rows = ((np.arange(height) + 0.5) * mask.shape[0] / height).astype(np.int64)
    columns = ((np.arange(width) + 0.5) * mask.shape[1] / width).astype(np.int64)
    return np.asarray(mask[rows[:, None], columns] != 0)


def depth_pose_scale_ratio(depth: DepthErrors | None, trajectory: TrajectoryErrors) -> float | None:
    """Depth scale over pose scale: 1 when depth and poses of the estimate are in the same units."""
    if depth is None or not trajectory.scale:
        return None
    return depth.scale / trajectory.scale


def z_from_ray(camera: Camera, height: int, width: int) -> NDArray[np.float64]:
    """(height, width) z components of the unit rays of a grid over the whole image: z depth = ray depth * this."""
    u = (np.arange(width) + 0.5) * (camera.width / width)
    v = (np.arange(height) + 0.5) * (camera.height / height)
    if camera.model == "equirect":
        latitude = np.sin(v / camera.height * math.pi)[:, None]
        grid: NDArray[np.float64] = latitude * np.cos((u / camera.width - 0.5) * (2 * math.pi))
        return grid
    if camera.distorted:
        rays = camera.rays(height, width)
        toward: NDArray[np.float64] = rays[..., 2] / np.linalg.norm(rays, axis=-1)
        return toward
    fx, fy, cx, cy, *rest = camera.params
    rho2 = ((u - cx) / fx) ** 2 + (((v - cy) / fy) ** 2)[:, None]
    alpha = rest[0] if rest else 0.0
    z: NDArray[np.float64] = (alpha + np.sqrt(np.maximum(0.0, 1 + (1 - alpha * alpha) * rho2))) / (1 + rho2) - alpha
    return z


def convert_depth(
    depth: NDArray[np.float32], camera: Camera, source: DepthKind, target: DepthKind
) -> NDArray[np.float32]:
    """Depth (h, w) of kind `source` as kind `target`; where z is not positive the result is 0 (missing)."""
    if source == target:
        return depth
    factor = z_from_ray(camera, *depth.shape)
    if target == "ray":
        factor = np.where(factor > 1e-6, 1 / np.maximum(factor, 1e-6), 0.0)
    return np.maximum(depth * factor, 0.0).astype(np.float32)


def sample_depth(depth: NDArray[np.float32], height: int, width: int) -> NDArray[np.float32]:
    """Samples a depth map at the centres of a (height, width) grid over the same image.

    Bilinear in inverse depth, which is linear on planes; missing neighbours are left out, and the result is 0 where
    fewer than a quarter of the weight is there.
    """
    if depth.shape == (height, width):
        return depth
    rows, columns = depth.shape
    y = (np.arange(height) + 0.5) * rows / height - 0.5
    x = (np.arange(width) + 0.5) * columns / width - 0.5
    top, left = np.floor(y).astype(np.int64), np.floor(x).astype(np.int64)
    known = np.isfinite(depth) & (depth > 0)
    inverse = np.where(known, 1 / np.where(known, depth, 1.0), 0.0)
    total, weight = np.zeros((height, width)), np.zeros((height, width))
    for row, row_share in ((top, 1 - (y - top)), (top + 1, y - top)):
        for column, column_share in ((left, 1 - (x - left)), (left + 1, x - left)):
            at = np.ix_(np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1))
            share = row_share[:, None] * column_share * known[at]
            total += share * inverse[at]
            weight += share
    sampled = np.where(weight > 0.25, weight / np.maximum(total, 1e-12), 0.0)
    return sampled.astype(np.float32)


def rotation_angle_deg(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """(..., 3, 3) -> (...) angle in degrees; exact for small angles, where the arc cosine is not."""
    cosine = (np.trace(rotation, axis1=-2, axis2=-1) - 1) / 2
    axis = np.stack(
        [
            rotation[..., 2, 1] - rotation[..., 1, 2],
            rotation[..., 0, 2] - rotation[..., 2, 0],
            rotation[..., 1, 0] - rotation[..., 0, 1],
        ],
        axis=-1,
    )
    angle: NDArray[np.float64] = np.degrees(np.arctan2(np.linalg.norm(axis, axis=-1) / 2, cosine))
    return angle


def align_centres(estimate: NDArray[np.float64], truth: NDArray[np.float64], *, with_scale: bool = True) -> Sim3:
    """truth_from_estimate: the least-squares Sim(3) (or rigid motion) of the camera centres of (N, 4, 4) poses.

    On a straight path, where the centres do not determine the roll, with the rotation that the cameras agree on.

    Raises:
        ValueError: With scale: all centres of one trajectory coincide.
    """
    points, target = estimate[:, :3, 3], truth[:, :3, 3]
    singular = np.linalg.svd((target - target.mean(0)).T @ (points - points.mean(0)), compute_uv=False)
    if singular[1] > 1e-10 * singular[0]:
        return umeyama(points, target, with_scale)
    world = mean_rotation(estimate, truth)
    centred, centred_target = points - points.mean(0), target - target.mean(0)
    turned = centred @ world.T
    scale = 1.0
    if with_scale:
        size = float((centred**2).sum())
        if not size > 0:
            raise ValueError("no scale: all centres of the estimate coincide")
        scale = float((centred_target * turned).sum()) / size
    return Sim3(scale, world, target.mean(0) - scale * world @ points.mean(0))


def _align_depth(
    estimated: NDArray[np.float64], true: NDArray[np.float64], alignment: DepthAlignment
) -> tuple[float, float]:
    """Scale and shift that take `estimated` to `true`."""
    if alignment == "metric":
        return 1.0, 0.0
    scale, shift = float(np.median(true / estimated)), 0.0
    if alignment == "scale":
        return scale, shift
    step = -(-len(true) // _MAX_FITTED)
    x, y = estimated[::step], true[::step]
    floor = 1e-4 * float(np.median(y))
    # Least absolute deviations by iteratively reweighted least squares: each step solves a weighted 2x2 system.
    for _ in range(50):
        weight = 1 / np.maximum(np.abs(scale * x + shift - y), floor)
        total = weight.sum()
        mean_x, mean_y = (weight * x).sum() / total, (weight * y).sum() / total
        variance = (weight * np.square(x - mean_x)).sum()
        if not variance > 0:
            break
        before = scale, shift
        scale = float((weight * (x - mean_x) * (y - mean_y)).sum() / variance)
        shift = float(mean_y - scale * mean_x)
        if abs(scale - before[0]) < 1e-9 * abs(scale) and abs(shift - before[1]) < floor:
            break
    return scale, shift


def mean_rotation(estimate: NDArray[np.float64], truth: NDArray[np.float64]) -> NDArray[np.float64]:
    """The constant rotation of the world that makes the cameras of the two agree best."""
    return _nearest_rotation(np.einsum("nij,nkj->ik", truth[:, :3, :3], estimate[:, :3, :3]))


def _nearest_rotation(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    u, _, vt = np.linalg.svd(matrix)
    rotation: NDArray[np.float64] = (u * np.array([1.0, 1.0, np.linalg.det(u @ vt)])) @ vt
    return rotation


def _spread(points: NDArray[np.float64]) -> float:
    return _rms(np.linalg.norm(points - points.mean(axis=0), axis=1))


def _rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
