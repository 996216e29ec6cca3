"""What fusion takes from one frame, and which of its pixels may be fused."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vipe_core.annotation import DepthKind
from vipe_core.cameras import Camera
from vipe_core.cameras.distortion import limit

Array = NDArray[Any]


@dataclass(frozen=True, slots=True)
class SurfaceView:
    """One frame.

    Attributes:
        world_from_cam: (4, 4) float64, OpenCV axes.
        rgb: (H, W, 3) uint8.
        depth: (H, W) float32; 0 is no value.
        weight: (H, W) float32, how much a pixel counts; 0 keeps it out.
    """

    world_from_cam: NDArray[np.float64]
    rgb: NDArray[np.uint8]
    depth: NDArray[np.float32]
    weight: NDArray[np.float32]

    def planes(self, rays: Array) -> tuple[Array, Array]:
        """Depth and weight as compiled code takes them.

        Args:
            rays: (H, W, 3) of the camera.

        Raises:
            ValueError: The view is not of the camera's size.
        """
        size = rays.shape[:2]
        if self.depth.shape != size or self.weight.shape != size or self.rgb.shape != (*size, 3):
            raise ValueError(f"a view must be of the camera's size {size}, got {self.depth.shape} and {self.rgb.shape}")
        return np.ascontiguousarray(self.depth, np.float32), np.ascontiguousarray(self.weight, np.float32)


def surface_weight(
    depth: Array,
    *,
    confidence: Array | None = None,
    mask: Array | None = None,
    min_confidence: float = 0.0,
) -> NDArray[np.float32]:
    """(H, W) float32 weight of each pixel: its confidence, or 1 where there is none, and 0 where it must stay out.

    What moves by itself stays out, because it is not where another frame saw it. So does a value without any
    confidence.

    Args:
        depth: (H, W); not finite or not positive is no value.
        confidence: (H, W) in 0..1.
        mask: (H, W) ids of what moves by itself; 0 is the static background.
        min_confidence: Below it a pixel stays out.
    """
    usable = np.isfinite(depth) & (depth > 0)
    if mask is not None:
        usable &= mask == 0
    if confidence is None:
        return usable.astype(np.float32)
    usable &= (confidence > 0) & (confidence >= min_confidence)
    return np.where(usable, confidence, 0).astype(np.float32)


def kernel_params(camera: Camera) -> NDArray[np.float64]:
    """Parameters of a camera as the compiled loops of fusion take them: with how far a distorted lens images."""
    params = camera.index_params()
    return np.append(params, limit(camera.model, params[4:])) if camera.distorted else params


def points_per_depth(camera: Camera, kind: DepthKind) -> NDArray[np.float32]:
    """(H, W, 3) float32: depth of `kind` times this is the point in the camera frame; 0 where there is no such depth.

    A pixel at or beyond 90 degrees has no depth along the axis.
    """
    rays = camera.rays()
    if camera.distorted:
        v, u = np.indices(rays.shape[:2])
        rays = np.where(camera.has_ray(np.stack((u, v), axis=-1))[..., None], rays, 0)
    if kind == "ray":
        rays = rays / np.maximum(np.linalg.norm(rays, axis=-1, keepdims=True), 1e-300)
    else:
        ahead = rays[..., 2:] > 1e-6
        rays = np.where(ahead, rays / np.where(ahead, rays[..., 2:], 1), 0)
    return np.ascontiguousarray(rays, np.float32)
