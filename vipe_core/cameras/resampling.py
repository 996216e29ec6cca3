"""Pictures of a lens with measured distortion as a camera sees them that bundle adjustment has derivatives of.

The other camera has the same centre and the same axes, so that a pose, and the depth of what a ray hits, are the same
in both. It is a pinhole where that makes no picture's corner huge, else the unified model with the bend that comes
nearest to the lens; its picture is as large as it takes to hold all that the lens sees.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vipe_core.cameras.camera import Camera
from vipe_core.cameras.pixel_map import PixelMap

Array = NDArray[Any]

# A pinhole magnifies this far from the axis by the square of 1 / cos: threefold along the radius at 55 degrees.
_PINHOLE_ANGLE_DEG = 55.0
# The resampled picture is at most this many times as wide and as high: what a polynomial makes of the last pixels in
# the corners is not worth more.
_LARGEST = 2.0
_GRID = 49
# Most bent of the unified models, and how near the end of its own picture the lens may see.
_MAX_ALPHA, _WITHIN = 4.0, 0.95


@dataclass(frozen=True)
class Resampling:
    """The two cameras and the way between their pictures.

    Attributes:
        lens: `opencv` or `opencv_fisheye`, of the pictures as they are.
        ideal: `pinhole` or `mei`, of the resampled ones.
    """

    lens: Camera
    ideal: Camera

    @classmethod
    def of(cls, lens: Camera) -> Resampling:
        """The resampling of the pictures of a lens."""
        rays = _rays_over(lens)
        angle = np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2])
        fx, fy, cx, cy = lens.params[:4]
        if angle.max() < math.radians(_PINHOLE_ANGLE_DEG):
            ideal = Camera("pinhole", (fx, fy, cx, cy), lens.width, lens.height)
        else:
            focal, alpha = _nearest_unified(lens, angle)
            ideal = Camera("mei", (focal * fx, focal * fy, cx, cy, alpha), lens.width, lens.height)
        px, seen = ideal.project(rays)
        low = np.minimum(px[seen].min(axis=0) + 0.5, 0)
        high = px[seen].max(axis=0) + 0.5
        low = np.maximum(np.floor(low), -0.5 * (_LARGEST - 1) * np.array([lens.width, lens.height]))
        size = np.minimum(np.ceil(high - low), _LARGEST * np.array([lens.width, lens.height])).astype(int)
        params = (*ideal.params[:2], cx - float(low[0]), cy - float(low[1]), *ideal.params[4:])
        return cls(lens, Camera(ideal.model, params, int(size[0]), int(size[1])))

    @cached_property
    def forward(self) -> PixelMap:
        """From the lens's pictures to the ideal ones."""
        return PixelMap(self.lens, self.ideal)

    @cached_property
    def back(self) -> PixelMap:
        """From the ideal pictures, and maps of them, to the lens's."""
        return PixelMap(self.ideal, self.lens)

    def ideal_px(self, px: Array) -> NDArray[np.float64]:
        """(..., 2) index coordinates in the lens's picture -> (..., 2) in the ideal one, NaN where there are none."""
        found, seen = self.ideal.project(self.lens.unproject(px))
        return np.where((seen & self.lens.has_ray(px))[..., None], found, np.nan)

    def refined(self, ideal: Camera) -> Camera:
        """The lens whose rays are those that `ideal` finds in the resampled pictures, a little other than `self.ideal`.

        Another focal length changes what the polynomial has to be; it is fitted again, from what it was.
        """
        from scipy.optimize import least_squares

        u, v = np.meshgrid(
            np.linspace(0, self.lens.width - 1, _GRID // 2), np.linspace(0, self.lens.height - 1, _GRID // 2)
        )
        px = np.stack((u, v), axis=-1).reshape(-1, 2)
        px = px[self.lens.has_ray(px)]
        points = ideal.resized(self.ideal.width, self.ideal.height).unproject(self.ideal_px(px))
        start = np.array(self.lens.params)
        free = np.flatnonzero((start != 0) | (np.arange(len(start)) < 6))
        scale = np.where(free < 4, self.lens.width, 1.0)

        def lens(values: Array) -> Camera:
            params = start.copy()
            params[free] = values * scale
            return replace(self.lens, params=tuple(float(value) for value in params))

        def error(values: Array) -> Array:
            found, seen = lens(values).project(points)
            return np.where(seen[:, None], found - px, 1.0).reshape(-1)

        return lens(least_squares(error, start[free] / scale, xtol=1e-12, ftol=1e-12, gtol=1e-12).x)


def _rays_over(lens: Camera) -> NDArray[np.float64]:
    """(n, 3) rays of a grid over the picture, its border among them; pixels without a ray are left out."""
    u, v = np.meshgrid(
        np.linspace(-0.5, lens.width - 0.5, _GRID), np.linspace(-0.5, lens.height - 0.5, _GRID), indexing="xy"
    )
    px = np.stack((u, v), axis=-1).reshape(-1, 2)
    return lens.unproject(px[lens.has_ray(px)])


def _nearest_unified(lens: Camera, angle: Array) -> tuple[float, float]:
    """Focal length, in units of the lens's, and alpha of the unified camera that sees each angle nearest to the same
    radius r: r (cos + alpha) = f sin is linear in both."""
    fx, _, cx, _ = lens.index_params()[:4]
    at = np.linspace(0.02, float(angle.max()), 200)
    px, seen = lens.project(np.stack((np.sin(at), np.zeros_like(at), np.cos(at)), axis=-1))
    radius, at = (px[seen, 0] - cx) / fx, at[seen]
    design = np.stack((np.sin(at), -radius), axis=-1)
    # A unified picture with alpha > 1 ends where the cosine is -1 / alpha.
    outermost = math.cos(at[-1])
    most = _MAX_ALPHA if outermost >= 0 else min(_MAX_ALPHA, -_WITHIN / outermost)
    alpha = float(np.clip(np.linalg.lstsq(design, radius * np.cos(at), rcond=None)[0][1], 0.0, most))
    sine = np.sin(at)
    return float((radius * (np.cos(at) + alpha) * sine).sum() / (sine * sine).sum()), alpha
