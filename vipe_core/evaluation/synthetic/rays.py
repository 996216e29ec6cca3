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
_FIXED_POINT_STEPS = 100
_BISECTIONS = 52


def unit_rays(camera: Camera, u: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit directions in camera axes of image points `u`, `v` (half-pixel centres): (..., 3)."""
    if camera.model == "equirect":
        theta = (u / camera.width - 0.5) * (2 * math.pi)
        phi = v / camera.height * math.pi
        return np.stack([np.sin(phi) * np.sin(theta), -np.cos(phi), np.sin(phi) * np.cos(theta)], axis=-1)
    a = (u - camera.params[2]) / camera.params[0]
    b = (v - camera.params[3]) / camera.params[1]
    if camera.model == "opencv":
        a, b = _straight(camera.params[4:], a, b)
    elif camera.model == "opencv_fisheye":
        angle = _angles(camera.params[4:], np.hypot(a, b))
        turn = np.arctan2(b, a)
        return np.stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)], axis=-1)
    rho2 = a * a + b * b
    if camera.model in ("pinhole", "opencv"):
        return np.stack([a, b, np.ones_like(a)], axis=-1) / np.sqrt(1 + rho2)[..., None]
    alpha = camera.params[4]
    # On the unit sphere the point is (a s, b s, s - alpha); beyond the image circle of alpha > 1 the root is clamped.
    scale = (alpha + np.sqrt(np.maximum(0.0, 1 + (1 - alpha * alpha) * rho2))) / (1 + rho2)
    rays = np.stack([a * scale, b * scale, scale - alpha], axis=-1)
    unit: NDArray[np.float64] = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    return unit


def _straight(
    coefficients: tuple[float, ...], u: NDArray[np.float64], v: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Slopes that radial-tangential distortion shows at `u`, `v` (focal lengths), by fixed-point iteration.

    It converges wherever the distortion is mild enough for a lens that somebody would sell.
    """
    k1, k2, p1, p2, k3, k4, k5, k6 = coefficients
    a, b = u, v
    for _ in range(_FIXED_POINT_STEPS):
        q = a * a + b * b
        stretch = (1 + k1 * q + k2 * q**2 + k3 * q**3) / (1 + k4 * q + k5 * q**2 + k6 * q**3)
        da, db = 2 * p1 * a * b + p2 * (q + 2 * a * a), p1 * (q + 2 * b * b) + 2 * p2 * a * b
        a, b = (u - da) / stretch, (v - db) / stretch
    return a, b


def _angles(coefficients: tuple[float, ...], radius: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angles from the axis that a Kannala-Brandt lens shows at a radius (focal lengths), by bisection."""
    low, high = np.zeros_like(radius), np.full_like(radius, math.pi)
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        powers = sum(k * middle ** (2 * n + 3) for n, k in enumerate(coefficients))
        beyond = middle + powers > radius
        low, high = np.where(beyond, low, middle), np.where(beyond, middle, high)
    return 0.5 * (low + high)


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
