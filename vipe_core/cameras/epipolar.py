"""How far matches lie from the epipolar geometry of two pictures, in pixels, whatever the camera.

The epipolar constraint is linear in the rays, y^T E x = 0. To first order its distance in pixels is its value over the
length of its gradient with respect to the four coordinates of the match (Sampson's error), with the derivatives of the
rays by the pixels: for a pinhole this is the formula with the fundamental matrix.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vipe_core.cameras.camera import Camera

Array = NDArray[Any]

_STEP_PX = 1.0


@dataclass(frozen=True, slots=True)
class RaySlopes:
    """Rays through pixels with their derivatives.

    Attributes:
        rays: (n, 3).
        slopes: (n, 3, 2) derivative by the pixel's coordinates.
    """

    rays: NDArray[np.float64]
    slopes: NDArray[np.float64]

    @classmethod
    def of(cls, camera: Camera, px: Array) -> RaySlopes:
        """For (n, 2) index coordinates; derivatives by central differences over two pixels."""
        at = np.asarray(px, dtype=np.float64)
        steps = _STEP_PX * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
        rays = camera.unproject(at + steps[:, None])
        slopes = np.stack((rays[1] - rays[2], rays[3] - rays[4]), axis=-1) / (2 * _STEP_PX)
        return cls(rays[0], slopes)


def essential_matrix(second_from_first: Array) -> NDArray[np.float64]:
    """(3, 3) E with y^T E x = 0 for rays x of the first and y of the second camera, from a (4, 4) pose."""
    x, y, z = second_from_first[:3, 3]
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(cross @ second_from_first[:3, :3])


def sampson_distances(essential: Array, first: RaySlopes, second: RaySlopes) -> NDArray[np.float64]:
    """(n,) signed Sampson distances of matches, pixels."""
    line, line_back = first.rays @ essential.T, second.rays @ essential
    value = (second.rays * line).sum(axis=1)
    by_second = (second.slopes * line[..., None]).sum(axis=1)
    by_first = (first.slopes * line_back[..., None]).sum(axis=1)
    gradient = np.square(by_first).sum(axis=1) + np.square(by_second).sum(axis=1)
    return np.asarray(value / np.sqrt(np.maximum(gradient, 1e-300)))
