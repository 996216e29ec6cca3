"""How well an adjustment knows the lens."""

from __future__ import annotations

import math
from dataclasses import replace

from vipe_core.ba.problem import Covariance
from vipe_core.cameras import Camera

_STEP = 1e-4
_MIN_FOV_DEG = 12.0
_MAX_FOV_DEG = {"pinhole": 150.0, "mei": 320.0}


def plausible(camera: Camera) -> bool:
    """Whether there are lenses with such a field of view."""
    return _MIN_FOV_DEG < camera.fov_x_deg < _MAX_FOV_DEG[camera.model]


def focal_sigma_ratio(camera: Camera, covariance: Covariance) -> float:
    """1-sigma of log f that leaves the field of view as unsure as log f and alpha do together.

    The two numbers of a unified camera can be unsure in such a way that the angle of view, which they make up between
    them, is not.

    Args:
        covariance: Of log f and alpha.

    Returns:
        NaN where the covariance is.
    """
    variance = covariance[0][0]
    if camera.model == "mei":
        by_focal = (camera.zoomed(math.exp(_STEP)).fov_x_deg - camera.zoomed(math.exp(-_STEP)).fov_x_deg) / (2 * _STEP)
        by_alpha = (_bent(camera, _STEP).fov_x_deg - _bent(camera, -_STEP).fov_x_deg) / (2 * _STEP)
        slope = by_alpha / by_focal
        variance += 2 * slope * covariance[0][1] + slope**2 * covariance[1][1]
    return math.sqrt(variance) if variance > 0 else math.nan


def _bent(camera: Camera, change: float) -> Camera:
    *others, alpha = camera.params
    return replace(camera, params=(*others, alpha + change))
