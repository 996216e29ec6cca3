"""Where the optical axis meets the image: the principal point, probed with whole adjustments.

Video carries no calibration, so the centre of the image stands in for the principal point. Real cameras are a per cent
or two off, and where the camera turns that bends the path. Each probe adjusts a stretch of the map with the point moved
along one axis; a parabola through the costs gives the least one. The move is kept only where it lowers the cost
visibly: a point that hardly matters to the measurements is not determined by them.
"""

from __future__ import annotations

import logging

import numpy as np
from numpy.typing import NDArray

from vipe_core.ba.problem import Result
from vipe_core.slam.adjustment import PROBED_SHARE, Adjuster, Step
from vipe_core.slam.graph import Graph
from vipe_core.slam.keyframes import KeyframeMap

logger = logging.getLogger(__name__)

_PROBE = (Step("geman_mcclure", 1.0, 12, 1e-4),)
_MIN_KEYFRAMES = 8
# More keyframes than this tell no more, and the probes' price is bounded.
_STRETCH = 32
# Step of the probes and prior of the offset, shares of the image width.
_PROBE_RATIO = 0.01
_SIGMA_RATIO = 0.015
# Lenses sit straighter than this. A fit that wants more pays for something else with it, such as lens distortion.
_MAX_RATIO = 0.025
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
    width = keyframes.grid.width * keyframes.grid.stride
    start = np.array(keyframes.intrinsics)
    measurements = 1.0

    def cost(offset_px: NDArray[np.float64]) -> float:
        """Mean robust cost of a measurement, px^2, and so the variance of one where the map is right."""
        keyframes.intrinsics = np.concatenate([start[:2], start[2:4] + offset_px, start[4:]])
        result: Result | None = adjuster.probe(keyframes, graph, frames, (frames[0],), _PROBE)
        keyframes.intrinsics = start
        nonlocal measurements
        if result is None or not result.weight_sum > 0:
            return float("nan")
        measurements = result.weight_sum / PROBED_SHARE
        return result.cost / result.weight_sum

    step = _PROBE_RATIO * width
    centre = cost(np.zeros(2))
    # Errors of dense measurements are correlated: their information counts for less, here as for the focal length.
    inflation = adjuster.settings.focal_sigma_inflation
    prior = 2 * centre / measurements * (inflation / (_SIGMA_RATIO * width)) ** 2
    offset = np.zeros(2)
    for axis in range(2):
        move = step * np.eye(2)[axis]
        above, below = cost(move), cost(-move)
        curvature = (above + below - 2 * centre) / step**2
        if curvature > 0:
            offset[axis] = -(above - below) / (2 * step) / (curvature + prior)
    size = keyframes.grid.stride * np.array([keyframes.grid.width, keyframes.grid.height])
    if np.abs(start[2:4] + offset - (size - 1) / 2).max() > _MAX_RATIO * width:
        logger.debug("principal point: (%.1f, %.1f) px from where it was is further than any lens", *offset)
        return False
    gain = 1 - cost(offset) / centre if centre > 0 else 0.0
    logger.debug("principal point: (%.1f, %.1f) px off the centre would save %.4f of the cost", *offset, gain)
    if not gain > _MIN_GAIN:
        return False
    keyframes.intrinsics = np.concatenate([start[:2], start[2:4] + offset, start[4:]])
    return True


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
