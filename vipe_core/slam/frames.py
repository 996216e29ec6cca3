"""The frames of a video as the SLAM stage reads them: decoded and encoded once when they fit in memory."""

from __future__ import annotations

from collections.abc import Generator, Iterable, Iterator
from contextlib import closing
from itertools import islice
from typing import Any

from vipe_core.errors import EmptyMedia
from vipe_core.priors.protocols import BatchEncoder, DenseMatcher, WorkingFrame
from vipe_core.slam.working import WorkingSize, working_frame
from vipe_core.video.source import Frame, FrameSource

# A gray picture with what is computed from it, and which pixels of it are usable where not all are; bytes per pixel.
_BYTES_PER_PX = 1.5
_MASK_BYTES_PER_PX = 2.0


def bytes_per_px(matcher: DenseMatcher, work: WorkingFrame) -> float:
    """What keeping the features of a frame takes."""
    features = matcher.bytes_per_px if isinstance(matcher, BatchEncoder) else _BYTES_PER_PX
    return features + (0 if work.valid is None else _MASK_BYTES_PER_PX)


class EncodedFrames:
    """Features of every frame, in order, as often as they are asked for.

    A clip whose pictures fit in `cache_bytes` is kept after the first pass. A longer one is decoded and encoded again
    each time, in memory that does not grow with it.

    Attributes:
        matcher: Encodes them.
        total_hint: Their number as the container states it, or None.
        times_s: Presentation times of the frames of the first pass so far.
    """

    def __init__(self, source: FrameSource, size: WorkingSize, matcher: DenseMatcher, cache_bytes: int) -> None:
        self._source = source
        self._size = size
        self.matcher = matcher
        self.total_hint = source.info.num_frames_hint
        self._free_px_bytes = cache_bytes / (size.width * size.height)
        self._kept: list[Any] = []
        self.times_s: list[float] = []

    def __len__(self) -> int:
        return len(self.times_s)

    @property
    def cached(self) -> bool:
        """Whether every frame that has been read is in memory."""
        return len(self._kept) == len(self.times_s)

    def first_pass(self) -> Generator[tuple[WorkingFrame, Any], None, None]:
        """Every frame of the video with its features.

        Raises:
            EmptyMedia: The video holds no frame.
            InputError, DecodeError: From the source.
        """
        with closing(self._source.frames(self._size.size)) as frames:
            for time_s, work, features in self._encoded(frames):
                if self.cached:
                    self._kept.append(features)
                self._free_px_bytes -= bytes_per_px(self.matcher, work)
                if self._free_px_bytes < 0:
                    self._kept = []
                self.times_s.append(time_s)
                yield work, features
        if not self.times_s:
            raise EmptyMedia(f"{self._source.info.name}: the video holds no frame; check the recording")

    def again(self, start: int = 0, stop: int | None = None) -> Generator[tuple[int, Any], None, None]:
        """Index and features of the frames [start, stop), after the first pass.

        Raises:
            InputError, DecodeError: From the source.
        """
        stop = len(self) if stop is None else stop
        if self.cached:
            yield from ((index, self._kept[index]) for index in range(start, stop))
            return
        with closing(self._source.frames(self._size.size, start=start, stop=stop)) as frames:
            for _, work, features in self._encoded(frames):
                yield work.index, features

    def _encoded(self, frames: Iterable[Frame]) -> Iterator[tuple[float, WorkingFrame, Any]]:
        """Time, working frame and features; read ahead by a batch where the matcher encodes several at once."""
        several = self.matcher if isinstance(self.matcher, BatchEncoder) else None
        if several is None or several.batch_frames < 2:
            for frame in frames:
                work = working_frame(frame)
                yield frame.timestamp_s, work, self.matcher.encode(work)
            return
        reading = iter(frames)
        while batch := list(islice(reading, several.batch_frames)):
            work_batch = [working_frame(frame) for frame in batch]
            found = several.encode_batch(work_batch)
            for frame, work, features in zip(batch, work_batch, found, strict=True):
                yield frame.timestamp_s, work, features

    def release(self) -> None:
        """Forget the pictures; nothing asks for them any more."""
        self._kept = []
