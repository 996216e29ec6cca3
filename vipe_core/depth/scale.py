"""The scale of a reconstruction: metres per unit of the map, from what is known, and the map in those units.

Every shot of a video is a map of its own with a scale of its own.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vipe_core.annotation import DepthKind
from vipe_core.cameras.along import inverse_along
from vipe_core.depth.types import SceneMap
from vipe_core.errors import ScaleUnobservable
from vipe_core.geometry.arrays import inverse
from vipe_core.priors.protocols import MetricEstimate
from vipe_core.statistics import consensus, weighted_median, weighted_spread

Array = NDArray[Any]

# Inverse depths whose confidence is above this are known to some 15 %.
CONFIDENT = 0.3
# The least number of cells of a keyframe that say something about its scale, and the least share of its cells.
_MIN_CELLS, _MIN_SHARE = 30, 0.02
# Logarithms of ratios closer together than this are never told apart.
_SAME_LOG = 0.02
# Cells around a known pixel that are asked, nearest first.
_REACH_CELLS = (1.0, 2.0, 3.0)


@dataclass(frozen=True, slots=True)
class ScaleEstimate:
    """Metres per unit.

    Attributes:
        metres_per_unit: Positive.
        sigma_ratio: Standard deviation of its logarithm.
        support: Frames that it rests on.
    """

    metres_per_unit: float
    sigma_ratio: float
    support: int = 1

    @property
    def interval(self) -> tuple[float, float]:
        """Lower and upper end of the metres per unit that are 95 % likely."""
        half = math.exp(1.96 * self.sigma_ratio)
        return self.metres_per_unit / half, self.metres_per_unit * half


@dataclass(frozen=True, slots=True)
class FrameRatio:
    """What one frame says about the scale.

    Attributes:
        log_ratio: Logarithm of metres per unit.
        sigma: Spread of it over the frame.
        weight: How much the frame is to be believed: confidence times the share of the picture that was compared.
    """

    log_ratio: float
    sigma: float
    weight: float


def believed_cells(scene: SceneMap, shot: tuple[int, int]) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """The keyframes of a shot, as numbers into the map, and their cells (n, h8, w8) that the scale is taken from.

    The confident ones; all that have a value in a shot without any, such as one that a camera at rest took.
    """
    numbers = np.flatnonzero((scene.keyframes >= shot[0]) & (scene.keyframes < shot[1]))
    values = scene.inverse_depth[numbers]
    cells = np.isfinite(values) & (values > 0)
    confident = cells & (scene.confidence[numbers] > CONFIDENT)
    return numbers, confident if confident.any() else cells


def shots_of(scene: SceneMap) -> list[tuple[int, int]]:
    """First frame, and one past the last, of every shot."""
    ends = [0, *scene.cuts, len(scene.world_from_cam)]
    return list(itertools.pairwise(ends))


def rescaled(scene: SceneMap, metres_per_unit: Sequence[float]) -> SceneMap:
    """The same map in other units: poses and inverse depth together, one factor per shot.

    The first camera stays where it is, and so does each shot's beginning relative to the end of the one before it.
    """
    world_from_cam = scene.world_from_cam.copy()
    inverse_depth = scene.inverse_depth.astype(np.float32, copy=True)
    previous: Array | None = None
    for (start, stop), factor in zip(shots_of(scene), metres_per_unit, strict=True):
        before = scene.world_from_cam[start:stop]
        local = inverse(before[:1]) @ before
        local[:, :3, 3] *= factor
        # Nothing measures the step over a cut; it is kept as it was, in the units of the shot before it.
        if previous is None:
            anchor = before[0]
        else:
            anchor = world_from_cam[start - 1] @ previous
        world_from_cam[start:stop] = anchor @ local
        numbers = np.flatnonzero((scene.keyframes >= start) & (scene.keyframes < stop))
        inverse_depth[numbers] /= np.float32(factor)
        if stop < len(world_from_cam):
            step = inverse(scene.world_from_cam[stop - 1]) @ scene.world_from_cam[stop]
            step[:3, 3] *= factor
            previous = step
    return dataclasses.replace(scene, world_from_cam=world_from_cam, inverse_depth=inverse_depth)


def normalised(scene: SceneMap) -> SceneMap:
    """The map in units in which the median inverse depth of the believed cells of every shot is 1."""
    factors = []
    for shot in shots_of(scene):
        numbers, cells = believed_cells(scene, shot)
        values = scene.inverse_depth[numbers][cells]
        factors.append(float(np.median(values)) if len(values) else 1.0)
    return rescaled(scene, factors)


def scale_from_ratios(ratios: Sequence[FrameRatio], shared_sigma: float = 0.0) -> ScaleEstimate | None:
    """Weighted median over frames without those far from it, and its standard error.

    Args:
        shared_sigma: Error of the logarithm that all frames of a video have in common, which no number of them shows.

    Returns:
        None where no frame says anything.
    """
    heard = [ratio for ratio in ratios if ratio.weight > 0 and math.isfinite(ratio.log_ratio)]
    if not heard:
        return None
    weights = np.array([ratio.weight for ratio in heard])
    value, error, support = consensus(np.array([ratio.log_ratio for ratio in heard]), weights, _SAME_LOG)
    # Few frames can agree by chance: the spread within them bounds the error from below.
    within = weighted_median(np.array([ratio.sigma for ratio in heard]), weights) / math.sqrt(support)
    return ScaleEstimate(math.exp(value), math.hypot(max(error, within), shared_sigma), support)


def ratio_to_prior(
    scene: SceneMap, number: int, cells: NDArray[np.bool_], prior: MetricEstimate, kind: DepthKind
) -> FrameRatio | None:
    """Compares the map of a keyframe with metric depth of its picture.

    Args:
        number: Of the keyframe.
        cells: (h8, w8) of it that are believed.
        prior: At any size.
        kind: Of the prior's depth.

    Returns:
        None where there is too little to compare.
    """
    height, width = cells.shape
    rows = ((np.arange(height) + 0.5) * prior.depth_m.shape[0] / height).astype(np.int64)
    columns = ((np.arange(width) + 0.5) * prior.depth_m.shape[1] / width).astype(np.int64)
    depth_m = prior.depth_m[np.ix_(rows, columns)].astype(np.float64)
    along = inverse_along(scene.camera.resized(width, height), kind)
    # Inverse depth along the rays, times this, is inverse depth of the prior's kind.
    weight = np.asarray(prior.confidence[np.ix_(rows, columns)], np.float64) * scene.confidence[number]
    if not (scene.confidence[number] > 0).any():
        weight = np.asarray(prior.confidence[np.ix_(rows, columns)], np.float64)
    use = cells & np.isfinite(depth_m) & (depth_m > 0) & (weight > 0) & (along > 0)
    if use.sum() < max(_MIN_CELLS, _MIN_SHARE * cells.size):
        return None
    values = np.log(depth_m[use] * scene.inverse_depth[number][use] * along[use])
    value = weighted_median(values, weight[use])
    return FrameRatio(value, weighted_spread(values, weight[use], value), float(weight[use].sum()) / cells.size)


def scale_from_path(scene: SceneMap, path_m: float) -> ScaleEstimate:
    """From the length of the camera's path. The standard deviation is the share of it that is jitter of the poses.

    Raises:
        ScaleUnobservable: The camera does not move, or the video has cuts: each shot has a scale of its own.
    """
    _need_one_shot(scene, "a path")
    centres = scene.world_from_cam[:, :3, 3]
    length = float(np.linalg.norm(np.diff(centres, axis=0), axis=1).sum())
    numbers, cells = believed_cells(scene, (0, len(centres)))
    values = scene.inverse_depth[numbers][cells]
    unit = 1 / float(np.median(values)) if len(values) else 1.0
    if not length > 1e-3 * unit:
        raise ScaleUnobservable("the camera does not move, so the length of its path tells no scale")
    smooth = centres.copy()
    smooth[1:-1] = (centres[:-2] + centres[1:-1] + centres[2:]) / 3
    jitter = 1 - float(np.linalg.norm(np.diff(smooth, axis=0), axis=1).sum()) / length
    return ScaleEstimate(path_m / length, max(jitter, 1e-3), len(centres))


def scale_from_pixel(
    scene: SceneMap, pixel: tuple[float, float], frame: int, distance_m: float, source_size: tuple[int, int]
) -> ScaleEstimate:
    """From the known distance between the camera and what a pixel shows.

    Args:
        pixel: (x, y) in the source video, half-pixel centres.
        distance_m: Along the straight line from the camera, whatever the camera model.
        source_size: (width, height) of the source video.

    Raises:
        ScaleUnobservable: There is no such pixel or frame, the map knows nothing there, or the video has cuts.
    """
    from vipe_core.depth.projection import MapProjector

    _need_one_shot(scene, "one pixel")
    count, (width, height) = len(scene.world_from_cam), source_size
    if not 0 <= frame < count:
        raise ScaleUnobservable(f"there is no frame {frame}: the video has {count}, the first is 0")
    if not (0 <= pixel[0] <= width and 0 <= pixel[1] <= height):
        raise ScaleUnobservable(f"pixel ({pixel[0]:g}, {pixel[1]:g}) is not in the picture, {width}x{height}")
    found = MapProjector(scene).of(frame)
    camera = scene.camera
    at = np.array([pixel[0] * camera.width / width - 0.5, pixel[1] * camera.height / height - 0.5])
    away = np.linalg.norm(found.px - at, axis=1) / 8
    for reach in _REACH_CELLS:
        near = (away <= reach) & (found.weight > 0)
        if near.sum() >= 3:
            values = -np.log(found.inverse_depth[near])
            value = weighted_median(values, found.weight[near])
            sigma = weighted_spread(values, found.weight[near], value)
            ray = camera.unproject(at)
            metres_per_unit = distance_m / (math.exp(value) * float(np.linalg.norm(ray)))
            return ScaleEstimate(metres_per_unit, max(sigma, _SAME_LOG), int(near.sum()))
    raise ScaleUnobservable(
        f"nothing was measured around pixel ({pixel[0]:g}, {pixel[1]:g}) of frame {frame}; take one on a static, "
        "textured surface"
    )


def _need_one_shot(scene: SceneMap, what: str) -> None:
    if scene.cuts:
        raise ScaleUnobservable(
            f"the video has cuts and each shot has a scale of its own, which {what} cannot tell; annotate one shot"
        )
