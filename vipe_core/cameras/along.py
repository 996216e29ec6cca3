"""Depth along the optical axis and along the ray, and what a camera's own rays make of them."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from vipe_core.cameras.camera import Camera

# Directions closer to the plane of the lens than some 3 degrees have no useful z.
_MIN_FORWARD = 0.05


def inverse_along(camera: Camera, kind: Literal["z", "ray"]) -> NDArray[np.float64]:
    """(h, w) what turns inverse depth along the camera's rays into inverse depth of a kind, by multiplication.

    0 where the pixel has no depth of that kind: z behind a wide lens.
    """
    if kind == "ray":
        if camera.model != "pinhole":
            return np.ones((camera.height, camera.width))
        return np.asarray(1 / np.linalg.norm(camera.rays(), axis=-1))
    if camera.model == "pinhole":
        return np.ones((camera.height, camera.width))
    forward = camera.rays()[..., 2]
    return np.where(forward > _MIN_FORWARD, 1 / np.maximum(forward, _MIN_FORWARD), 0.0)
