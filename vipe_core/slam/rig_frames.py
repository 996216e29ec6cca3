"""The synchronised frames of a rig as the SLAM stage reads them: an instant at a time, all views of it together."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from contextlib import closing
from typing import Any, Protocol

from vipe_core.errors import EmptyMedia
from vipe_core.priors.protocols import BatchEncoder, DenseMatcher, WorkingFrame
from vipe_core.slam.frames import bytes_per_px
from vipe_core.slam.working import WorkingSize, working_frame
from vipe_core.video.source import Frame, VideoInfo


class RigSource(Protocol):
    """Where the frames of a rig come from, read as often as they are needed.

    Attributes:
        infos: One per view.
    """

    @property
    def infos(self) -> Sequence[VideoInfo]: ...

    def frames(
        self, size: tuple[int, int] | None = None, start: int = 0, stop: int | None = None
    ) -> Generator[tuple[Frame, ...], None, None]:
        """The views of every instant, as `FrameSource.frames`; all have the time of view 0.

        Raises:
            InputError, DecodeError: A view cannot be read, or is not synchronised with the others.
        """


class EncodedRig:
    """Features of every view of every instant; the rig's `EncodedFrames`.

    Attributes:
        matcher: Encodes them.
        num_views: How many views there are.
        total_hint: Number of instants as the container of view 0 states it, or None.
        times_s: Presentation times of the instants of the first pass so far.
    """

    def __init__(self, source: RigSource, size: WorkingSize, matcher: DenseMatcher, cache_bytes: int) -> None:
        self._source = source
        self._size = size
        self.matcher = matcher
        self.num_views = len(source.infos)
        self.total_hint = source.infos[0].num_frames_hint
        self._free_px_bytes = cache_bytes / (size.width * size.height)
        self._kept: list[tuple[Any, ...]] = []
        self.times_s: list[float] = []

    def __len__(self) -> int:
        return len(self.times_s)

    @property
    def cached(self) -> bool:
        """Whether every instant that has been read is in memory."""
        return len(self._kept) == len(self.times_s)

    def first_pass(self) -> Generator[tuple[list[WorkingFrame], tuple[Any, ...]], None, None]:
        """Every instant with the working frames and features of its views.

        Raises:
            EmptyMedia: The videos hold no frame.
            InputError, DecodeError: From the source.
        """
        with closing(self._source.frames(self._size.size)) as instants:
            for instant in instants:
                works = [working_frame(frame) for frame in instant]
                features = self._encode(works)
                if self.cached:
                    self._kept.append(features)
                self._free_px_bytes -= sum(bytes_per_px(self.matcher, work) for work in works)
                if self._free_px_bytes < 0:
                    self._kept = []
                self.times_s.append(instant[0].timestamp_s)
                yield works, features
        if not self.times_s:
            raise EmptyMedia(f"{self._source.infos[0].name}: the video holds no frame; check the recording")

    def again(self, start: int = 0, stop: int | None = None) -> Generator[tuple[int, tuple[Any, ...]], None, None]:
        """Index and features of the instants [start, stop), after the first pass.

        Raises:
            InputError, DecodeError: From the source.
        """
        stop = len(self) if stop is None else stop
        if self.cached:
            yield from ((index, self._kept[index]) for index in range(start, stop))
            return
        with closing(self._source.frames(self._size.size, start=start, stop=stop)) as instants:
            for instant in instants:
                yield instant[0].index, self._encode([working_frame(frame) for frame in instant])

    def _encode(self, works: Sequence[WorkingFrame]) -> tuple[Any, ...]:
        """Features of the views, together where the matcher encodes several at once."""
        if isinstance(self.matcher, BatchEncoder):
            return tuple(self.matcher.encode_batch(works))
        return tuple(self.matcher.encode(work) for work in works)

    def release(self) -> None:
        """Forget the pictures; nothing asks for them any more."""
        self._kept = []
