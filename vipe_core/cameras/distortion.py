"""Lenses with measured distortion: OpenCV's radial-tangential model and Kannala and Brandt's fisheye (numpy, batched).

They describe the pictures that come in. Bundle adjustment has no derivatives of them: pictures of such a lens are
resampled once into a model that it has (`resampling`).

`opencv` (Brown 1966 with the rational radial part of OpenCV): with x = X / Z, y = Y / Z, r^2 = x^2 + y^2,

    g = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6)
    u = fx (g x + 2 p1 x y + p2 (r^2 + 2 x^2)) + cx,      v = fy (g y + p1 (r^2 + 2 y^2) + 2 p2 x y) + cy

`opencv_fisheye` (Kannala and Brandt 2006): with the angle t from the axis and its direction (c, s) in the picture,

    d = t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8),      u = fx d c + cx,      v = fy d s + cy

A polynomial that fits a lens inside of its picture turns round somewhere outside: only what lies before that point is
imaged, and a pixel that it never reaches has no ray.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

# Radial profiles are tabulated this finely, up to this slope from the axis; the table only starts Newton's method.
_SAMPLES = 4096
_MAX_SLOPE = 20.0
_ITERATIONS = 12
_PRECISE = 1e-14
# How far from the pixel that was asked for the ray's own pixel may lie, in focal lengths.
_CONVERGED = 1e-9


def limit(model: str, coefficients: Array) -> float:
    """How far from the axis the lens images: a slope r for `opencv`, an angle for `opencv_fisheye`."""
    far = _MAX_SLOPE if model == "opencv" else math.pi
    at = np.linspace(0, far, _SAMPLES)
    radius = _profile(model, coefficients, at)
    falls = np.flatnonzero(~(np.diff(radius) > 0))
    return float(at[falls[0]]) if len(falls) else far


def project(model: str, params: Array, points: Array) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Pixels of points.

    Args:
        params: (fx, fy, cx, cy, coefficients...), index coordinates.
        points: (..., 3) in the camera frame, any scale.

    Returns:
        (..., 2) index coordinates, finite everywhere, and (...) whether the lens images the direction.
    """
    xyz = np.asarray(points, dtype=np.float64)
    coefficients, reach = params[4:], limit(model, params[4:])
    across = np.hypot(xyz[..., 0], xyz[..., 1])
    if model == "opencv":
        valid = xyz[..., 2] > 1e-9 * np.abs(xyz).max(axis=-1)
        slope = xyz[..., :2] / np.where(valid, xyz[..., 2], 1)[..., None]
        valid &= np.hypot(slope[..., 0], slope[..., 1]) <= reach
        seen, _ = _distorted(coefficients, np.where(valid[..., None], slope, 0))
    else:
        angle = np.arctan2(across, xyz[..., 2])
        valid = (angle <= reach) & (np.abs(xyz).max(axis=-1) > 0)
        direction = xyz[..., :2] / np.where(across > 0, across, 1)[..., None]
        seen = direction * np.where(valid, _profile(model, coefficients, angle), 0)[..., None]
    return seen * params[:2] + params[2:4], np.asarray(valid, dtype=np.bool_)


def unproject(model: str, params: Array, px: Array) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Rays through pixels.

    Args:
        params: As `project` takes them.
        px: (..., 2) index coordinates.

    Returns:
        (..., 3) rays, z = 1 for `opencv` and unit length for `opencv_fisheye`, and (...) whether the pixel has one;
        where it has none, the ray of the nearest pixel towards the centre that does.
    """
    coefficients = np.asarray(params[4:], dtype=np.float64)
    seen = (np.asarray(px, dtype=np.float64) - params[2:4]) / params[:2]
    radius = np.hypot(seen[..., 0], seen[..., 1])
    reach = limit(model, coefficients)
    at = np.linspace(0, reach, _SAMPLES)
    # Starts from the radial profile by itself: where it is monotone that is near enough for Newton's method.
    start = np.interp(radius, _profile(model, coefficients, at), at)
    direction = seen / np.where(radius > 0, radius, 1)[..., None]
    if model == "opencv":
        slope = _undistorted(coefficients, seen, direction * start[..., None])
        miss = np.abs(_distorted(coefficients, slope)[0] - seen).max(axis=-1)
        out = np.hypot(slope[..., 0], slope[..., 1])
        valid = (miss < _CONVERGED * (1 + radius)) & (out <= reach)
        slope = np.where(valid[..., None], slope, direction * start[..., None])
        return np.concatenate((slope, np.ones_like(radius)[..., None]), axis=-1), np.asarray(valid, dtype=np.bool_)
    angle = start
    for _ in range(_ITERATIONS):
        error = _profile(model, coefficients, angle) - radius
        if np.abs(error).max(initial=0) < _PRECISE:
            break
        step = error / _fisheye_slope(coefficients, angle)
        angle = np.clip(angle - np.where(np.isfinite(step), step, 0), 0, reach)
    valid = np.abs(_profile(model, coefficients, angle) - radius) < _CONVERGED * (1 + radius)
    ray = np.concatenate((direction * np.sin(angle)[..., None], np.cos(angle)[..., None]), axis=-1)
    return ray, np.asarray(valid, dtype=np.bool_)


def _profile(model: str, coefficients: Array, at: Array) -> NDArray[np.float64]:
    """Radius in the picture, in focal lengths, at a slope or an angle from the axis."""
    square = np.square(at)
    if model == "opencv":
        return np.asarray(at * _radial(coefficients, square)[0])
    k1, k2, k3, k4 = coefficients
    return np.asarray(at * (1 + square * (k1 + square * (k2 + square * (k3 + square * k4)))))


def _fisheye_slope(coefficients: Array, angle: Array) -> Array:
    k1, k2, k3, k4 = coefficients
    square = np.square(angle)
    return np.asarray(1 + square * (3 * k1 + square * (5 * k2 + square * (7 * k3 + square * 9 * k4))))


def _radial(coefficients: Array, r2: Array) -> tuple[Array, Array]:
    """g and its derivative by r^2."""
    k1, k2, _, _, k3, k4, k5, k6 = coefficients
    above = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    below = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    # A denominator that vanishes ends the picture: the profile is not finite there, so not rising either.
    below = np.where(below > 1e-12, below, np.nan)
    slope = ((k1 + r2 * (2 * k2 + 3 * r2 * k3)) * below - above * (k4 + r2 * (2 * k5 + 3 * r2 * k6))) / below**2
    return above / below, slope


def _distorted(coefficients: Array, slope: Array) -> tuple[Array, Array]:
    """(..., 2) where the slopes (..., 2) are seen, in focal lengths, and (..., 2, 2) the derivative."""
    _, _, p1, p2, *_ = coefficients
    x, y = slope[..., 0], slope[..., 1]
    g, by_r2 = _radial(coefficients, x * x + y * y)
    seen = np.stack(
        (g * x + 2 * p1 * x * y + p2 * (3 * x * x + y * y), g * y + p1 * (x * x + 3 * y * y) + 2 * p2 * x * y), -1
    )
    across = 2 * by_r2 * x * y + 2 * p1 * x + 2 * p2 * y
    by_slope = np.stack(
        (
            np.stack((g + 2 * by_r2 * x * x + 2 * p1 * y + 6 * p2 * x, across), axis=-1),
            np.stack((across, g + 2 * by_r2 * y * y + 6 * p1 * y + 2 * p2 * x), axis=-1),
        ),
        axis=-2,
    )
    return seen, by_slope


def _undistorted(coefficients: Array, seen: Array, start: Array) -> Array:
    """Newton's method for `_distorted(slope) = seen`; what has no solution is left wherever it got."""
    slope = start
    for _ in range(_ITERATIONS):
        now, by_slope = _distorted(coefficients, slope)
        a, b, c, d = by_slope[..., 0, 0], by_slope[..., 0, 1], by_slope[..., 1, 0], by_slope[..., 1, 1]
        error = now - seen
        if np.abs(error).max(initial=0) < _PRECISE:
            break
        determinant = a * d - b * c
        step = np.stack((d * error[..., 0] - b * error[..., 1], a * error[..., 1] - c * error[..., 0]), axis=-1)
        step = step / np.where(np.abs(determinant) > 1e-12, determinant, np.nan)[..., None]
        slope = slope - np.where(np.isfinite(step), np.clip(step, -1, 1), 0)
    return slope
