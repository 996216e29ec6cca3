"""Rays of a camera, and what the renderer precomputes from them once per clip.

The projection formulas are written out here a second time, apart from `vipe_core.cameras`: a renderer that shared them
could not show that they are right.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vipe_core.cameras import Camera

_TILE_PX = 16


def unit_rays(camera: Camera, u: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit directions in camera axes of image points `u`, `v` (half-pixel centres): (..., 3)."""
    if camera.model == "equirect":
        theta = (u / camera.width - 0.5) * (2 * math.pi)
        phi = v / camera.height * math.pi
        return np.stack([np.sin(phi) * np.sin(theta), -np.cos(phi), np.sin(phi) * np.cos(theta)], axis=-1)
    a = (u - camera.params[2]) / camera.params[0]
    b = (v - camera.params[3]) / camera.params[1]
    rho2 = a * a + b * b
    if camera.model == "pinhole":
        return np.stack([a, b, np.ones_like(a)], axis=-1) / np.sqrt(1 + rho2)[..., None]
    alpha = camera.params[4]
    # On the unit sphere the point is (a s, b s, s - alpha); beyond the image circle of alpha > 1 the root is clamped.
    scale = (alpha + np.sqrt(np.maximum(0.0, 1 + (1 - alpha * alpha) * rho2))) / (1 + rho2)
    rays = np.stack([a * scale, b * scale, scale - alpha], axis=-1)
    unit: NDArray[np.float64] = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    return unit


@dataclass(frozen=True, slots=True)
class RayGrid:
    """The rays through all pixel centres of a camera, in camera axes; R = height * width, row-major.

    Attributes:
        directions: (R, 3) unit.
        pixel_angle: (R,) the larger angle to the next pixel, radians.
        tile: (R,) int64 tile of each ray.
        tile_axis: (T, 3) unit axis of the cone around each tile's rays.
        tile_half_angle: (T,) half angle of that cone with a margin of a pixel, radians.
    """

    camera: Camera
    directions: NDArray[np.float64]
    pixel_angle: NDArray[np.float64]
    tile: NDArray[np.int64]
    tile_axis: NDArray[np.float64]
    tile_half_angle: NDArray[np.float64]

    @classmethod
    def of(cls, camera: Camera) -> RayGrid:
        width, height = camera.width, camera.height
        u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        rays = unit_rays(camera, u, v)
        right = np.linalg.norm(unit_rays(camera, u + 0.5, v) - unit_rays(camera, u - 0.5, v), axis=-1)
        down = np.linalg.norm(unit_rays(camera, u, v + 0.5) - unit_rays(camera, u, v - 0.5), axis=-1)
        angle = np.maximum(right, down)
        columns = -(-width // _TILE_PX)
        rows, cols = np.mgrid[0:height, 0:width] // _TILE_PX
        tile = (rows * columns + cols).astype(np.int64).ravel()
        directions = np.ascontiguousarray(rays.reshape(-1, 3))
        num_tiles = int(tile[-1]) + 1
        axis = np.zeros((num_tiles, 3))
        np.add.at(axis, tile, directions)
        axis /= np.maximum(np.linalg.norm(axis, axis=-1, keepdims=True), 1e-12)
        apart = np.arccos(np.clip(np.einsum("rk,rk->r", directions, axis[tile]), -1.0, 1.0)) + angle.ravel()
        half_angle = np.zeros(num_tiles)
        np.maximum.at(half_angle, tile, apart)
        return cls(camera, directions, angle.ravel(), tile, axis, half_angle)
