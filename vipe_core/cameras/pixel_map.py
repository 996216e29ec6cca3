"""Pictures of one camera as another camera in the same place sees them, with the same axes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from vipe_core.cameras.camera import Camera

Array = NDArray[Any]
Sample = TypeVar("Sample", bound=np.generic)

_ROWS_AT_ONCE = 256
_NOWHERE = -1e6
# Depths that differ by more than this over a pixel lie on two surfaces, and there is nothing between them.
_SAME_SURFACE = 0.03


@dataclass(frozen=True)
class PixelMap:
    """Where each pixel of `target` finds what it sees in pictures of `source`.

    A pose, and the depth of what a ray hits, are the same for both cameras.
    """

    source: Camera
    target: Camera

    @cached_property
    def xy(self) -> NDArray[np.float32]:
        """(2, h, w) index coordinates (x, y) in the source's picture of every pixel of the target's; far outside of it
        where one of the two has no such ray."""
        width, height = self.target.width, self.target.height
        found = np.empty((2, height, width), np.float32)
        for top in range(0, height, _ROWS_AT_ONCE):
            v, u = np.meshgrid(np.arange(top, min(top + _ROWS_AT_ONCE, height)), np.arange(width), indexing="ij")
            px = np.stack((u, v), axis=-1)
            at, seen = self.source.project(self.target.unproject(px))
            at = np.where((seen & self.target.has_ray(px))[..., None], np.clip(at, _NOWHERE, -_NOWHERE), _NOWHERE)
            found[:, top : top + len(px)] = np.moveaxis(at, -1, 0)
        return found

    @cached_property
    def outside(self) -> NDArray[np.bool_]:
        """(h, w) pixels of the target that the source's picture does not show, but for a seam of a pixel."""
        x, y = self.xy
        return np.asarray(~((x > -1) & (y > -1) & (x < self.source.width) & (y < self.source.height)))

    def colours(self, rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """(H, W, 3) -> (h, w, 3), linear; what is outside continues the border."""
        return np.asarray(
            cv2.remap(rgb, self.xy[0], self.xy[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.uint8
        )

    def nearest(self, picture: NDArray[Sample], nothing: float = 0) -> NDArray[Sample]:
        """(H, W) -> (h, w), each pixel from the nearest.

        Args:
            nothing: For pixels that the source's picture does not show.
        """
        pixels: Any = picture
        found = cv2.remap(
            pixels, self.xy[0], self.xy[1], cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=(nothing,)
        )
        return np.asarray(found, dtype=picture.dtype)

    def depth(self, depth: NDArray[np.float32]) -> NDArray[np.float32]:
        """(H, W) -> (h, w) depth of the same kind, between pixels of one surface linear in inverse depth; 0 is no
        value."""
        known = depth > 0
        inverse = np.where(known, 1 / np.where(known, depth, 1), 0).astype(np.float32)
        nearest = self.nearest(inverse)
        between = np.asarray(
            cv2.remap(inverse, self.xy[0], self.xy[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        )
        value = np.where(np.abs(between - nearest) < _SAME_SURFACE * nearest, between, nearest)
        return np.where(nearest > 0, 1 / np.where(nearest > 0, value, 1), 0).astype(np.float32)
