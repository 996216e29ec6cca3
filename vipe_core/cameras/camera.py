"""The camera as a value: a model's name, its parameters and the image size they belong to.

Pixel convention. `Camera` uses half-pixel centres: the image spans [0, W] x [0, H], the sample of pixel index (i, j)
lies at (i + 0.5, j + 0.5), and a centred principal point is (W/2, H/2). So a resize multiplies all four numbers by the
same ratios. Code that works with integer pixel indices (optical flow, the BA grid, remap) takes `index_params`, the
only place where the half pixel is subtracted. Disk formats store the half-pixel numbers, as the paper does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vipe_core.cameras import distortion
from vipe_core.errors import ConfigError

if TYPE_CHECKING:
    from torch import Tensor

CameraModel = Literal["pinhole", "mei", "equirect", "opencv", "opencv_fisheye"]

# Pixels this near to square, on a logarithmic scale, are taken for square ones: calibrated cameras are that far off.
SQUARE = 0.02

# How compiled code tells the models apart.
MODEL_CODE: dict[CameraModel, int] = {"pinhole": 0, "mei": 1, "equirect": 2, "opencv": 3, "opencv_fisheye": 4}

_NUM_PARAMS: dict[str, int] = {"pinhole": 4, "mei": 5, "equirect": 0, "opencv": 12, "opencv_fisheye": 8}


@dataclass(frozen=True, slots=True)
class Camera:
    """A camera model with its parameters.

    Attributes:
        model: `pinhole`, `mei` (the unified model), `equirect`, or one of a lens with measured distortion, `opencv` or
            `opencv_fisheye` (`distortion`), which is known and not estimated.
        params: `pinhole` (fx, fy, cx, cy); `mei` (fx, fy, cx, cy, alpha); `equirect` (); `opencv` (fx, fy, cx, cy, k1,
            k2, p1, p2, k3, k4, k5, k6); `opencv_fisheye` (fx, fy, cx, cy, k1, k2, k3, k4). Pixels, half-pixel centres.
        width: Image width that `params` belong to, pixels.
        height: Image height, pixels.

    Raises:
        ConfigError: Unknown model, wrong number of parameters, or a focal length that is not positive.
    """

    model: CameraModel
    params: tuple[float, ...]
    width: int
    height: int

    def __post_init__(self) -> None:
        expected = _NUM_PARAMS.get(self.model)
        if expected is None:
            raise ConfigError(f"unknown camera model {self.model!r}; known: {', '.join(_NUM_PARAMS)}")
        if len(self.params) != expected:
            raise ConfigError(f"camera {self.model!r} takes {expected} parameters, got {self.params!r}")
        if expected and not (self.params[0] > 0 and self.params[1] > 0 and all(map(math.isfinite, self.params))):
            raise ConfigError(f"camera parameters must be finite with a positive focal length, got {self.params!r}")

    @classmethod
    def pinhole_from_fov(cls, fov_x_deg: float, width: int, height: int) -> Camera:
        """Centred pinhole with square pixels and the given horizontal field of view."""
        focal_px = width / 2 / math.tan(math.radians(fov_x_deg) / 2)
        return cls("pinhole", (focal_px, focal_px, width / 2, height / 2), width, height)

    @property
    def focal_px(self) -> float:
        """Horizontal focal length in pixels; NaN for `equirect`."""
        return self.params[0] if self.params else math.nan

    @property
    def pixel_aspect(self) -> float:
        """Width of a pixel over its height, as the two focal lengths tell; exactly 1 where it is nearly square, and for
        `equirect`, whose pixels are angles."""
        if not self.params:
            return 1.0
        aspect = self.params[1] / self.params[0]
        return aspect if abs(math.log(aspect)) > SQUARE else 1.0

    @property
    def fov_x_deg(self) -> float:
        """Angle between the left and right edge rays through the row of the principal point, degrees."""
        if self.model == "equirect":
            return 360.0
        fx, cx = self.params[0], self.params[2]
        return math.degrees(self._angle((self.width - cx) / fx, 0) - self._angle(-cx / fx, 0))

    @property
    def fov_y_deg(self) -> float:
        """Angle between the upper and lower edge rays through the column of the principal point, degrees."""
        if self.model == "equirect":
            return 180.0
        fy, cy = self.params[1], self.params[3]
        return math.degrees(self._angle(0, (self.height - cy) / fy) - self._angle(0, -cy / fy))

    def _angle(self, mx: float, my: float) -> float:
        """Signed angle from the optical axis of a place on a line through the principal point, in focal lengths."""
        if self.distorted:
            fx, fy, cx, cy = self.index_params()[:4]
            x, y, z = self.unproject((cx + mx * fx, cy + my * fy))
            return math.atan2(float(x) if mx else float(y), float(z))
        alpha, m = self.params[4] if self.model == "mei" else 0.0, mx + my
        eta = (alpha + math.sqrt(max(0.0, 1 + (1 - alpha * alpha) * m * m))) / (1 + m * m)
        return math.atan2(eta * m, eta - alpha)

    @property
    def distorted(self) -> bool:
        """Whether this is a lens with measured distortion, whose pictures bundle adjustment sees resampled."""
        return self.model in ("opencv", "opencv_fisheye")

    def index_params(self) -> NDArray[np.float64]:
        """What `projection` takes, float64, for integer pixel indices.

        `params` with cx and cy half a pixel smaller; (width, height) for `equirect`, which has no others.
        """
        if self.model == "equirect":
            return np.array((self.width, self.height), dtype=np.float64)
        params = np.array(self.params, dtype=np.float64)
        params[2:4] -= 0.5
        return params

    @classmethod
    def from_index_params(cls, model: CameraModel, params: ArrayLike, width: int, height: int) -> Camera:
        """Inverse of `index_params`."""
        values = [float(value) for value in np.asarray(params, dtype=np.float64)]
        if model == "equirect":
            return cls(model, (), width, height)
        values[2] += 0.5
        values[3] += 0.5
        return cls(model, tuple(values), width, height)

    def unproject(self, px: ArrayLike) -> NDArray[np.float64]:
        """(..., 2) index coordinates -> (..., 3) float64 rays: z = 1 for `pinhole` and `opencv`, else unit length."""
        if self.distorted:
            return distortion.unproject(self.model, self.index_params(), np.array(px, dtype=np.float64))[0]
        from vipe_core.cameras import projection  # here, so that a camera without pixels needs no torch

        pixels = np.array(px, dtype=np.float64)
        rays = projection.unproject(self.model, self._tensor(self.index_params()), self._tensor(pixels))
        return np.asarray(rays.numpy())

    def project(self, points: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """(..., 3) points in the camera frame -> (..., 2) float64 index coordinates, (...) whether they are imaged.

        A pixel outside of the image is valid; one behind a pinhole camera is not, nor one beyond a measured distortion.
        """
        if self.distorted:
            return distortion.project(self.model, self.index_params(), np.array(points, dtype=np.float64))
        from vipe_core.cameras import projection

        xyz = np.array(points, dtype=np.float64)
        px, valid = projection.project(self.model, self._tensor(self.index_params()), self._tensor(xyz))
        return np.asarray(px.numpy()), np.asarray(valid.numpy())

    def has_ray(self, px: ArrayLike) -> NDArray[np.bool_]:
        """(..., 2) index coordinates -> (...) whether the model images anything there."""
        pixels = np.array(px, dtype=np.float64)
        if self.distorted:
            return distortion.unproject(self.model, self.index_params(), pixels)[1]
        from vipe_core.cameras import projection

        found = projection.on_image_disk(self.model, self._tensor(self.index_params()), self._tensor(pixels))
        return np.asarray(found.numpy())

    def rays(self, height: int | None = None, width: int | None = None) -> NDArray[np.float64]:
        """(height, width, 3) float64 rays of all pixels of the image resized to that size (default: its own size)."""
        camera = self.resized(width or self.width, height or self.height)
        v, u = np.meshgrid(np.arange(camera.height), np.arange(camera.width), indexing="ij")
        return camera.unproject(np.stack((u, v), axis=-1))

    @staticmethod
    def _tensor(values: NDArray[np.float64]) -> Tensor:
        import torch

        return torch.from_numpy(values)

    def zoomed(self, ratio: float) -> Camera:
        """The same camera with a focal length `ratio` times as long; `equirect` has none and stays."""
        if not self.params:
            return self
        fx, fy, *rest = self.params
        return Camera(self.model, (fx * ratio, fy * ratio, *rest), self.width, self.height)

    def resized(self, width: int, height: int) -> Camera:
        """The same camera for an image resized (not cropped) to `width` x `height`."""
        sx, sy = width / self.width, height / self.height
        if not self.params:
            return Camera(self.model, (), width, height)
        fx, fy, cx, cy, *rest = self.params
        return Camera(self.model, (fx * sx, fy * sy, cx * sx, cy * sy, *rest), width, height)
