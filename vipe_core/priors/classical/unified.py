"""Focal length and shape of a wide lens from pairs of frames: a sweep over unified cameras.

For every candidate (field of view, alpha) each pair is given its best essential matrix, and judged by how far the
correspondences lie from the epipolar curves that follow, in pixels of the picture. A bent lens makes these curves bent,
so that even one pair tells alpha; alpha = 0 is the pinhole, which is judged by the same measure.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import poselib

from vipe_core.ba.problem import Grid
from vipe_core.cameras import Camera
from vipe_core.cameras.epipolar import RaySlopes, essential_matrix, sampson_distances
from vipe_core.cameras.ideal import ideal_camera, ideal_px
from vipe_core.priors.classical.pairs import FramePair, PairPicker
from vipe_core.priors.protocols import IntrinsicsEstimate, IntrinsicsInit, WorkingFrame

logger = logging.getLogger(__name__)

# Candidates are even in 1 / (1 + alpha), which the bend of a lens follows: 1 is a pinhole, 1/2 stereographic,
# 1/3 the f theta of most fisheyes, 1/4 equisolid.
_STRAIGHTNESS = (1.0, 0.875, 0.75, 0.625, 0.5, 0.375, 0.25)
_FOVS_DEG = tuple(float(fov) for fov in np.geomspace(40, 220, 14))
_MAX_PINHOLE_FOV_DEG = 130.0
# Second round, around the best of the first: half a step to either side, and fields of view by these factors.
_FINE_STRAIGHTNESS = (-0.0625, 0.0, 0.0625)
_FINE_FOVS = (0.92, 0.96, 1.0, 1.04, 1.08)
# Distance from the epipolar curve from which on it does not matter how far, px.
_CUT_PX = 1.0
_MIN_POINTS = 50
# What a sweep finds is unsure by about this much, and the adjustment knows better.
_LOG_SIGMA = 0.2
# A lens is bent when that saves this share of what the best pinhole leaves.
_BENT_GAIN = 0.15
_DEFAULT_FOV_DEG, _DEFAULT_ALPHA, _DEFAULT_LOG_SIGMA = 100.0, 0.5, 0.3


@dataclass(frozen=True, slots=True)
class SweepResult:
    """The best of all candidates and of those without a bend, with their costs, 0..1."""

    camera: Camera
    cost: float
    pinhole_cost: float

    @property
    def gain(self) -> float:
        """Share of what the best pinhole leaves unexplained that a bent lens explains."""
        return 1 - self.cost / self.pinhole_cost if self.pinhole_cost > 0 else 0.0


class UnifiedInit:
    """`IntrinsicsInit` of the unified model.

    Args:
        pinhole: With it, the lens is a pinhole unless a bent one explains the pairs clearly better, and this one then
            finds the focal length.
        picker: Where the pairs come from.
    """

    def __init__(self, pinhole: IntrinsicsInit | None = None, picker: PairPicker | None = None) -> None:
        self._pinhole = pinhole
        self._picker = picker or PairPicker(num_anchors=8, motion_ratio=50 / 640, max_points=400)

    def estimate(self, frames: Sequence[WorkingFrame], grid: Grid) -> IntrinsicsEstimate:
        """A centred camera with square pixels; the default with a wide sigma when no pair shows parallax."""
        height, width = frames[0].gray.shape
        pairs = self._picker.pairs(frames)
        found = sweep(pairs, width, height)
        if found is not None:
            logger.debug("unified sweep: %s, cost %.4f, gain %.3f", found.camera.params, found.cost, found.gain)
        if self._pinhole is not None and (found is None or found.gain < _BENT_GAIN):
            return self._pinhole.estimate(frames, grid)
        if found is None:
            default = _camera(_DEFAULT_FOV_DEG, _DEFAULT_ALPHA, width, height)
            assert default is not None
            return IntrinsicsEstimate(default, _DEFAULT_LOG_SIGMA, 0)
        return IntrinsicsEstimate(found.camera, _LOG_SIGMA, len(pairs))


def sweep(pairs: Sequence[FramePair], width: int, height: int) -> SweepResult | None:
    """The unified camera that explains the pairs best; None without a pair that could be judged."""
    usable = [pair for pair in pairs if len(pair.source_px) >= _MIN_POINTS]
    if not usable:
        return None
    tried: dict[tuple[float, float], tuple[float, Camera]] = {}

    def judge(fov_deg: float, straightness: float) -> None:
        camera = _camera(fov_deg, 1 / straightness - 1, width, height)
        if camera is not None and (fov_deg, straightness) not in tried:
            tried[fov_deg, straightness] = float(np.mean([_cost(camera, pair) for pair in usable])), camera

    for straightness in _STRAIGHTNESS:
        for fov_deg in _FOVS_DEG:
            judge(fov_deg, straightness)
    fov_deg, straightness = min(tried, key=lambda key: tried[key][0])
    pinhole_fov_deg = min((key for key in tried if key[1] == 1), key=lambda key: tried[key][0])[0]
    for factor in _FINE_FOVS:
        judge(pinhole_fov_deg * factor, 1.0)
        for change in _FINE_STRAIGHTNESS:
            judge(fov_deg * factor, min(1.0, straightness + change))
    cost, camera = min(tried.values(), key=lambda value: value[0])
    return SweepResult(camera, cost, min(value[0] for key, value in tried.items() if key[1] == 1))


def _camera(fov_deg: float, alpha: float, width: int, height: int) -> Camera | None:
    """Centred, with this field of view; None where there is no such camera."""
    half = math.radians(fov_deg) / 2
    scale = math.cos(half) + alpha
    # With alpha > 1 the picture ends where rays become tangent to the sphere.
    if scale <= 0.02 or (alpha == 0 and fov_deg > _MAX_PINHOLE_FOV_DEG) or 1 + alpha * math.cos(half) <= 0:
        return None
    focal_px = width / 2 * scale / math.sin(half)
    return Camera("mei", (focal_px, focal_px, width / 2, height / 2, alpha), width, height)


def _cost(camera: Camera, pair: FramePair) -> float:
    """Mean truncated squared distance of the pair's points from the epipolar curves of its best pose, 0..1."""
    first, ahead = ideal_px(camera, pair.source_px)
    second, seen = ideal_px(camera, pair.target_px)
    both = ahead & seen
    if both.sum() < _MIN_POINTS:
        return 1.0
    ideal = ideal_camera(camera)
    ransac = {"max_iterations": 200, "min_iterations": 50, "max_epipolar_error": _CUT_PX, "seed": 0}
    pose, _ = poselib.estimate_relative_pose(first[both], second[both], ideal, ideal, ransac, {})
    rotation, direction = np.asarray(pose.R, np.float64), np.asarray(pose.t, np.float64)
    if not np.isfinite(rotation).all() or not np.linalg.norm(direction) > 0:
        return 1.0
    relative = np.eye(4)
    relative[:3, :3], relative[:3, 3] = rotation, direction / np.linalg.norm(direction)
    rays = (RaySlopes.of(camera, px) for px in (pair.source_px, pair.target_px))
    away_px = sampson_distances(essential_matrix(relative), *rays)
    return float(np.minimum(np.square(away_px / _CUT_PX), 1).mean())
