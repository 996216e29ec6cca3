"""A frame source whose pictures are resampled into another camera."""

from __future__ import annotations

import dataclasses
from contextlib import closing

import cv2
import numpy as np

from vipe_core.cameras.resampling import Resampling
from vipe_core.video.source import Frame, FrameSource, FrameStream, VideoInfo


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
        forward = self.resampling.forward
        with closing(self.source.frames(None, start, stop)) as frames:
            for frame in frames:
                rgb, masked = forward.colours(frame.rgb), forward.outside
                if frame.masked is not None:
                    masked = masked | (forward.nearest(frame.masked.astype(np.uint8)) > 0)
                if size is not None and size != (rgb.shape[1], rgb.shape[0]):
                    rgb = np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), np.uint8)
                    share = cv2.resize(masked.astype(np.float32), size, interpolation=cv2.INTER_AREA)
                    masked = np.asarray(share > 1e-6)
                yield Frame(frame.index, frame.timestamp_s, rgb, masked)

    def seen_at(self, x: float, y: float) -> tuple[float, float] | None:
        """Where a point of the source's picture is in the resampled one, half-pixel centres; None if nowhere."""
        u, v = self.resampling.ideal_px(np.array([x - 0.5, y - 0.5]))
        inside = 0 <= u + 0.5 <= self._info.width and 0 <= v + 0.5 <= self._info.height
        return (float(u) + 0.5, float(v) + 0.5) if inside else None
