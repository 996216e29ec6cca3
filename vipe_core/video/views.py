"""Other ways to look at a frame source: a part of it, cropped, as another camera sees it, or backwards in time.

Every view decodes what it needs when it is asked: nothing is copied to disk, and memory is bounded.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vipe_core.cameras.pixel_map import PixelMap
from vipe_core.errors import UnsupportedMedia
from vipe_core.video.source import Frame, FrameSource, FrameStream, VideoInfo

Array = NDArray[Any]

# What the reversed view holds of the video at a time.
_REVERSE_BYTES = 256 << 20


@dataclass(frozen=True, slots=True)
class Crop:
    """A rectangle of the picture in pixels."""

    left: int
    top: int
    width: int
    height: int

    @classmethod
    def centred(cls, width: int, height: int, picture: tuple[int, int]) -> Crop:
        """The middle `width` x `height` pixels of a picture of size (width, height)."""
        return cls((picture[0] - width) // 2, (picture[1] - height) // 2, width, height)


class FrameView:
    """A part of a frame source, with its pictures seen by another camera, then cropped.

    Masks belong to the pictures that are seen: `MaskedView` goes around this one.

    Args:
        source: What is looked at.
        start: Frames before this one are left out, and it is number 0; all keep their times.
        stop: Frames from this one on, in the numbers of the source, are left out; all are seen if None.
        seen_by: The camera that sees every picture in place of its own, which has the source's full size.
        crop: Part of the picture, as that camera has it, that is seen.
        timestamps_s: Times of the frames seen where the source knows none (images of a dataset), in increasing order.

    Raises:
        UnsupportedMedia: The crop reaches beyond the picture.
        ValueError: `stop` is not behind `start`.
    """

    def __init__(
        self,
        source: FrameSource,
        *,
        start: int = 0,
        stop: int | None = None,
        seen_by: PixelMap | None = None,
        crop: Crop | None = None,
        timestamps_s: Sequence[float] | None = None,
    ) -> None:
        info = source.info
        if start < 0 or (stop is not None and stop <= start):
            raise ValueError(f"a view needs at least one frame, got [{start}, {stop})")
        if seen_by is not None:
            info = dataclasses.replace(info, width=seen_by.target.width, height=seen_by.target.height)
        if crop is not None:
            inside = crop.left >= 0 and crop.top >= 0 and crop.width > 0 and crop.height > 0
            if not inside or crop.left + crop.width > info.width or crop.top + crop.height > info.height:
                raise UnsupportedMedia(
                    f"{info.name}: a crop of {crop.width}x{crop.height} does not fit into {info.width}x{info.height}"
                )
        self._source = source
        self._start = start
        self._stop = stop
        self._crop = crop
        self._timestamps_s = timestamps_s
        self._seen_by = seen_by
        self._info = _shortened(info, start, stop, timestamps_s, crop)

    @property
    def info(self) -> VideoInfo:
        return self._info

    def frames(self, size: tuple[int, int] | None = None, start: int = 0, stop: int | None = None) -> FrameStream:
        """See `FrameSource.frames`."""
        ends = [end for end in (None if stop is None else self._start + stop, self._stop) if end is not None]
        whole = self._crop is None and self._seen_by is None
        first, last = self._start + start, min(ends, default=None)
        with closing(self._source.frames(size if whole else None, first, last)) as frames:
            for frame in frames:
                index = frame.index - self._start
                rgb = frame.rgb if whole else self._picture(frame.rgb, size)
                time_s = frame.timestamp_s if self._timestamps_s is None else self._timestamps_s[index]
                yield Frame(index, float(time_s), rgb, frame.masked if whole else None)

    def _picture(self, rgb: NDArray[np.uint8], size: tuple[int, int] | None) -> NDArray[np.uint8]:
        import cv2

        if self._seen_by is not None:
            rgb = self._seen_by.colours(rgb)
        if self._crop is not None:
            rows = slice(self._crop.top, self._crop.top + self._crop.height)
            rgb = rgb[rows, self._crop.left : self._crop.left + self._crop.width]
        if size is not None and size != (rgb.shape[1], rgb.shape[0]):
            rgb = np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
        return np.ascontiguousarray(rgb)


class ReversedView:
    """A frame source backwards: the last frame first, at time 0.

    Blocks of frames are decoded from the end to the beginning, each as long as the memory for it allows; all but the
    first of them decode again what lies before, as nothing else numbers frames exactly.

    Args:
        source: What is looked at.
        timestamps_s: Times of all its frames, as a run over it has found them.
    """

    def __init__(self, source: FrameSource, timestamps_s: Sequence[float] | Array) -> None:
        self._source = source
        self._times_s = np.asarray(timestamps_s, dtype=np.float64)
        info = source.info
        self._info = dataclasses.replace(
            info, num_frames_hint=len(self._times_s), frame_names=tuple(reversed(info.frame_names))
        )

    @property
    def info(self) -> VideoInfo:
        return self._info

    def frames(self, size: tuple[int, int] | None = None, start: int = 0, stop: int | None = None) -> FrameStream:
        """See `FrameSource.frames`."""
        count = len(self._times_s)
        width, height = size or (self._info.width, self._info.height)
        block = max(1, _REVERSE_BYTES // (3 * width * height))
        # In the source's numbers, from `end` down to `first`.
        end, first = count - start, count - min(count, count if stop is None else stop)
        while end > first:
            begin = max(first, end - block)
            with closing(self._source.frames(size, begin, end)) as frames:
                held = list(frames)
            for frame in reversed(held):
                time_s = float(self._times_s[-1] - self._times_s[frame.index])
                yield Frame(count - 1 - frame.index, time_s, frame.rgb, frame.masked)
            end = begin


def _shortened(
    info: VideoInfo, start: int, stop: int | None, timestamps_s: Sequence[float] | None, crop: Crop | None
) -> VideoInfo:
    count, fps, duration_s = info.num_frames_hint, info.fps, info.duration_s
    if count is not None and (start or (stop is not None and stop < count)):
        seen = max(0, min(count, count if stop is None else stop) - start)
        duration_s = None if duration_s is None else duration_s * seen / count
        count = seen
    if timestamps_s is not None and len(timestamps_s) > 1:
        span_s = float(timestamps_s[-1]) - float(timestamps_s[0])
        fps = (len(timestamps_s) - 1) / span_s if span_s > 0 else fps
        duration_s = span_s + 1 / fps
    width, height = (info.width, info.height) if crop is None else (crop.width, crop.height)
    return dataclasses.replace(
        info,
        width=width,
        height=height,
        num_frames_hint=count,
        fps=fps,
        duration_s=duration_s,
        frame_names=info.frame_names[start:stop],
    )
