"""Networks that know only pinhole cameras, for pictures of other cameras too.

The picture is seen anew by the nearest pinhole, the one that agrees with the camera in the middle of the picture, and
z goes back along the same rays (the reference does so for its unified cameras). What the pinhole does not see has none.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from vipe_core.annotation import DepthKind
from vipe_core.cameras import Camera
from vipe_core.errors import ConfigError
from vipe_core.priors.protocols import MetricDepth, MetricEstimate

# The angle to the axis, in degrees, up to which a pinhole is made to see: beyond, its middle is a few pixels.
_WIDEST_DEG = 60.0


class Rectified:
    """`MetricDepth` for any perspective camera by one that wants pinholes and answers with z.

    Raises:
        ConfigError: The network answers with distance.
    """

    def __init__(self, network: MetricDepth) -> None:
        if network.depth_kind != "z":
            raise ConfigError("only z can be carried between cameras with one centre and one axis")
        self._network = network
        self._maps: tuple[Camera, Camera, NDArray[np.float32], NDArray[np.float32]] | None = None

    @property
    def depth_kind(self) -> DepthKind:
        return "z"

    @property
    def shared_sigma_ratio(self) -> float:
        return self._network.shared_sigma_ratio

    def input_size(self, width: int, height: int) -> tuple[int, int]:
        """See `MetricDepth.input_size`."""
        return self._network.input_size(width, height)

    def estimate(self, rgb: NDArray[np.uint8], camera: Camera) -> MetricEstimate:
        """See `MetricDepth.estimate`.

        Raises:
            ConfigError: The camera is a panorama.
        """
        if camera.model == "pinhole":
            return self._network.estimate(rgb, camera)
        if camera.model == "equirect":
            raise ConfigError("metric depth of a panorama needs a network that knows panoramas")
        if self._maps is None or self._maps[0] != camera:
            pinhole = nearest_pinhole(camera)
            self._maps = (camera, pinhole, *_maps(camera, pinhole))
        _, pinhole, there, back = self._maps
        seen = cv2.remap(rgb, there[..., 0], there[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        found = self._network.estimate(np.asarray(seen, np.uint8), pinhole)
        # Not between pixels: between a thing and what is behind it, there is nothing.
        depth_m, confidence = (
            cv2.remap(values, back[..., 0], back[..., 1], cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT)
            for values in (found.depth_m, found.confidence)
        )
        return MetricEstimate(np.asarray(depth_m, np.float32), np.asarray(confidence, np.float32))


def nearest_pinhole(camera: Camera) -> Camera:
    """The pinhole with the same axis and size that agrees with a camera around its principal point."""
    width, height = camera.width, camera.height
    aside = np.array([[1e-3, 0, 1.0], [0, 1e-3, 1.0], [0, 0, 1.0]])
    px, _ = camera.project(aside)
    fx, fy = float(px[0, 0] - px[2, 0]) / 1e-3, float(px[1, 1] - px[2, 1]) / 1e-3
    # Rather a smaller picture of the middle than one that is all rim.
    least = max(width, height) / 2 / np.tan(np.deg2rad(_WIDEST_DEG))
    scale = max(1.0, float(least) / min(fx, fy))
    return Camera("pinhole", (fx * scale, fy * scale, camera.params[2], camera.params[3]), width, height)


def _maps(camera: Camera, pinhole: Camera) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(h, w, 2) where each pixel of the pinhole is in the camera's picture, and the other way; -1 where it is not."""
    there, seen = camera.project(pinhole.rays())
    rays = camera.rays()
    back, ahead = pinhole.project(rays)
    there[~seen] = -1
    back[~ahead | ~np.isfinite(back).all(axis=-1)] = -1
    return there.astype(np.float32), np.clip(back, -1e6, 1e6).astype(np.float32)
