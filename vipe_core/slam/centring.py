"""Where the optical axis meets the image: the principal point, probed with whole adjustments.

Video carries no calibration, so the centre of the image stands in for the principal point. Real cameras are a per cent
or two off, and where the camera turns that bends the path. Each probe adjusts half of a stretch of the map with the
point moved along one axis; a parabola through the costs gives the least one. A lens has one principal point: only as
much of a move as both halves ask for is made, since what else a pinhole leaves out, such as distortion, pulls it
elsewhere in every part. And it is made only where it lowers the cost visibly: a point that hardly matters to the
measurements is not determined by them.
"""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vipe_core.slam.adjustment import PROBED_SHARE, Adjuster, Step
from vipe_core.slam.graph import Graph
from vipe_core.slam.keyframes import KeyframeMap

logger = logging.getLogger(__name__)

Array = NDArray[Any]

_PROBE = (Step("geman_mcclure", 1.0, 12, 1e-4),)
_MIN_KEYFRAMES = 8
# More keyframes than this tell no more, and the probes' price is bounded.
_STRETCH = 32
# Step of the probes and prior of the offset, shares of the image width.
_PROBE_RATIO = 0.01
_SIGMA_RATIO = 0.015
# Least share of the cost that a move must save.
_MIN_GAIN = 0.005


def refine_principal_point(keyframes: KeyframeMap, graph: Graph, adjuster: Adjuster) -> bool:
    """Move the principal point of an adjusted map; poses and depths stay, for the next adjustment to follow.

    Returns:
        Whether it moved.
    """
    if len(keyframes) < _MIN_KEYFRAMES:
        return False
    frames = _turning_stretch(keyframes.poses())
    middle = len(frames) // 2
    halves = [_Probe(keyframes, graph, adjuster, part) for part in (frames[: middle + 1], frames[middle - 1 :])]
    offset = _common(*(half.best_offset_px() for half in halves))
    before = sum(half.cost_at_centre for half in halves)
    gain = 1 - sum(half.cost(offset) for half in halves) / before if before > 0 else 0.0
    logger.debug("principal point: (%.1f, %.1f) px from where it was saves %.4f of the cost", *offset, gain)
    if not gain > _MIN_GAIN:
        return False
    keyframes.intrinsics = _moved(keyframes.intrinsics, offset)
    return True


class _Probe:
    """The cost of one part of the map as a function of the principal point."""

    def __init__(self, keyframes: KeyframeMap, graph: Graph, adjuster: Adjuster, frames: range) -> None:
        self._keyframes = keyframes
        self._graph = graph
        self._adjuster = adjuster
        self._frames = frames
        self._weight = 0.0
        self.cost_at_centre = self.cost(np.zeros(2))

    def cost(self, offset_px: Array) -> float:
        """Mean robust cost of a measurement, px^2, and so the variance of one where the map is right; NaN if none."""
        keyframes = self._keyframes
        start = keyframes.intrinsics
        keyframes.intrinsics = _moved(start, offset_px)
        result = self._adjuster.probe(keyframes, self._graph, self._frames, (self._frames[0],), _PROBE)
        keyframes.intrinsics = start
        if result is None or not result.weight_sum > 0:
            return float("nan")
        self._weight = result.weight_sum / PROBED_SHARE
        return result.cost / result.weight_sum

    def best_offset_px(self) -> NDArray[np.float64]:
        """(2,) where the cost and a prior at the present point are least together."""
        width = self._keyframes.grid.width * self._keyframes.grid.stride
        step, centre = _PROBE_RATIO * width, self.cost_at_centre
        offset = np.zeros(2)
        if not self._weight > 0:
            return offset
        # Errors of dense measurements are correlated: their information counts for less, here as for the focal length.
        inflation = self._adjuster.settings.focal_sigma_inflation
        prior = 2 * centre / self._weight * (inflation / (_SIGMA_RATIO * width)) ** 2
        for axis in range(2):
            move = step * np.eye(2)[axis]
            above, below = self.cost(move), self.cost(-move)
            curvature = (above + below - 2 * centre) / step**2
            if curvature > 0:
                offset[axis] = -(above - below) / (2 * step) / (curvature + prior)
        return offset


def _common(first: Array, second: Array) -> NDArray[np.float64]:
    """Per axis the smaller of two offsets where they have the same sign, 0 where they do not."""
    smaller = np.where(np.abs(first) < np.abs(second), first, second)
    return np.where(first * second > 0, smaller, 0.0)


def _moved(intrinsics: Array, offset_px: Array) -> NDArray[np.float64]:
    return np.concatenate([intrinsics[:2], intrinsics[2:4] + offset_px, intrinsics[4:]])


def _turning_stretch(cam_from_world: NDArray[np.float64]) -> range:
    """The successive keyframes, at most `_STRETCH`, over which the camera turns most."""
    count = len(cam_from_world)
    if count <= _STRETCH:
        return range(count)
    rotation = cam_from_world[1:, :3, :3] @ cam_from_world[:-1, :3, :3].transpose(0, 2, 1)
    cosine = np.clip((np.trace(rotation, axis1=1, axis2=2) - 1) / 2, -1, 1)
    turned = np.concatenate([[0.0], np.cumsum(np.arccos(cosine))])
    first = int(np.argmax(turned[_STRETCH - 1 :] - turned[: count - _STRETCH + 1]))
    return range(first, first + _STRETCH)
