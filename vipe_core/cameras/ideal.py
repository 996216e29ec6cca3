"""What minimal solvers for pinholes are given of any camera: the pinhole with the same rays and the same scale at the
centre of the picture.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vipe_core.cameras import Camera

Array = NDArray[Any]

# Beyond this angle from the axis a pixel of the ideal camera covers less than an eighth of one at its centre, so that
# errors of matching would no longer compare.
_MAX_ANGLE_DEG = 70.0


def ideal_camera(camera: Camera) -> dict[str, Any]:
    """The ideal camera in the form that PoseLib takes, for index coordinates."""
    fx, fy, cx, cy, *alpha = (float(value) for value in camera.index_params())
    stretch = 1 + sum(alpha)  # of angles at the centre of a unified camera
    params = [fx / stretch, fy / stretch, cx, cy]
    return {"model": "PINHOLE", "width": camera.width, "height": camera.height, "params": params}


def ideal_px(camera: Camera, px: Array) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Where the ideal camera sees what `camera` sees.

    Args:
        px: (n, 2) index coordinates.

    Returns:
        (n, 2) index coordinates of the ideal camera, and (n,) bool, whether it can see that far from its axis.
    """
    measured = np.asarray(px, dtype=np.float64)
    if camera.model == "pinhole":
        return measured, np.ones(len(measured), dtype=np.bool_)
    rays = camera.unproject(measured)
    ahead = rays[:, 2] > math.cos(math.radians(_MAX_ANGLE_DEG)) * np.linalg.norm(rays, axis=1)
    fx, fy, cx, cy = ideal_camera(camera)["params"]
    slope = rays[:, :2] / np.where(ahead, rays[:, 2], 1)[:, None]
    return slope * (fx, fy) + (cx, cy), ahead
