"""A frame source whose pictures are resampled into another camera, and maps of them taken back to its own pixels."""

from __future__ import annotations

import dataclasses
from contextlib import closing
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from vipe_core.cameras.resampling import Resampling
from vipe_core.video.source import Frame, FrameSource, FrameStream, VideoInfo

Array = NDArray[Any]
Sample = TypeVar("Sample", bound=np.generic)

# Depths that differ by more than this over a pixel lie on two surfaces, and there is nothing between them.
_SAME_SURFACE = 0.03


class ResampledView:
    """The pictures of a lens as the ideal camera of a `Resampling` sees them.

    Pixels that the lens does not see are masked, and continue the picture's border. Masks of the pictures go along:
    `MaskedView` goes inside of this one.

    Args:
        source: Pictures of the resampling's lens, at its size.
    """

    def __init__(self, source: FrameSource, resampling: Resampling) -> None:
        self.source = source
        self.resampling = resampling
        ideal = resampling.ideal
        self._info = dataclasses.replace(source.info, width=ideal.width, height=ideal.height)

    @property
    def info(self) -> VideoInfo:
        return self._info

    def frames(self, size: tuple[int, int] | None = None, start: int = 0, stop: int | None = None) -> FrameStream:
        """See `FrameSource.frames`. Every picture is sampled once, at the source's size."""
        map_x, map_y = self.resampling.ideal_map
        outside = self.resampling.outside
        with closing(self.source.frames(None, start, stop)) as frames:
            for frame in frames:
                rgb = cv2.remap(frame.rgb, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
                masked = outside
                if frame.masked is not None:
                    masked = masked | (self._nearest(frame.masked.astype(np.uint8), 0, map_x, map_y) > 0)
                if size is not None and size != (rgb.shape[1], rgb.shape[0]):
                    rgb = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
                    share = cv2.resize(masked.astype(np.float32), size, interpolation=cv2.INTER_AREA)
                    masked = np.asarray(share > 1e-6)
                yield Frame(frame.index, frame.timestamp_s, np.asarray(rgb, np.uint8), masked)

    def seen_at(self, x: float, y: float) -> tuple[float, float] | None:
        """Where a point of the source's picture is in the resampled one, half-pixel centres; None if nowhere."""
        u, v = self.resampling.ideal_px(np.array([x - 0.5, y - 0.5]))
        inside = 0 <= u + 0.5 <= self._info.width and 0 <= v + 0.5 <= self._info.height
        return (float(u) + 0.5, float(v) + 0.5) if inside else None

    def back(self, picture: NDArray[Sample], nothing: float = 0) -> NDArray[Sample]:
        """(h, w) of the resampled picture -> (H, W) of the source's, each pixel from the nearest.

        Args:
            nothing: For pixels that the resampled picture does not show.
        """
        return self._nearest(picture, nothing, *self.resampling.lens_map)

    def depth_back(self, depth: NDArray[np.float32]) -> NDArray[np.float32]:
        """(h, w) depth -> (H, W), between pixels of one surface linear in inverse depth; 0 is no value."""
        map_x, map_y = self.resampling.lens_map
        inverse = np.where(depth > 0, 1 / np.where(depth > 0, depth, 1), 0).astype(np.float32)
        nearest = self.back(inverse)
        between = np.asarray(cv2.remap(inverse, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
        value = np.where(np.abs(between - nearest) < _SAME_SURFACE * nearest, between, nearest)
        return np.where(nearest > 0, 1 / np.where(nearest > 0, value, 1), 0).astype(np.float32)

    @staticmethod
    def _nearest(picture: NDArray[Sample], nothing: float, map_x: Array, map_y: Array) -> NDArray[Sample]:
        found = cv2.remap(picture, map_x, map_y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=nothing)
        return np.asarray(found, dtype=picture.dtype)
