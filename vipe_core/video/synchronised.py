"""Several videos of one moment, frame by frame: the views of a rig."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from contextlib import ExitStack, closing
from dataclasses import replace

from vipe_core.errors import ConfigError, ViewsNotSynchronised
from vipe_core.video.source import Frame, FrameSource, VideoInfo

_SAME_RATE = 0.01


class SynchronisedSource:
    """The frames of synchronised videos, an instant at a time.

    Every video begins at the same moment, and frame n of one shows what frame n of the others shows. Times are counted
    from each video's first frame; they may be half a frame apart.

    Args:
        sources: The videos, view by view.
        names: Of the views, for messages.

    Raises:
        ViewsNotSynchronised: The videos have different frame rates.
    """

    def __init__(self, sources: Sequence[FrameSource], names: Sequence[str]) -> None:
        if len(sources) != len(names) or not sources:
            raise ConfigError(f"a rig of {len(names)} views needs as many videos, got {len(sources)}")
        self._sources, self._names = list(sources), list(names)
        first = sources[0].info
        for source, name in zip(sources, names, strict=True):
            if abs(source.info.fps / first.fps - 1) > _SAME_RATE:
                raise ViewsNotSynchronised(
                    f"view {name} has {source.info.fps:g} frames per second, view {names[0]} {first.fps:g}; "
                    "resample them to one rate"
                )

    @property
    def infos(self) -> Sequence[VideoInfo]:
        return [source.info for source in self._sources]

    def frames(
        self, size: tuple[int, int] | None = None, start: int = 0, stop: int | None = None
    ) -> Generator[tuple[Frame, ...], None, None]:
        """The views of the instants [start, stop), as `FrameSource.frames`; all have the time of view 0.

        Raises:
            InputError, DecodeError: From the videos.
            ViewsNotSynchronised: One ends before the others, or a frame is of another time than that of view 0.
        """
        with ExitStack() as stack:
            streams = [stack.enter_context(closing(source.frames(size, start, stop))) for source in self._sources]
            began: list[float] | None = None
            while True:
                instant = [next(stream, None) for stream in streams]
                present = [frame for frame in instant if frame is not None]
                if not present:
                    return
                if len(present) < len(instant):
                    ended, count = self._names[instant.index(None)], present[0].index
                    raise ViewsNotSynchronised(
                        f"view {ended} ends after {count} frames, before the others; cut the videos to one length"
                    )
                times_s = [frame.timestamp_s for frame in present]
                if began is None:
                    began = times_s
                self._check(present[0].index, times_s, began)
                yield tuple(replace(frame, timestamp_s=times_s[0]) for frame in present)

    def _check(self, index: int, times_s: Sequence[float], began: Sequence[float]) -> None:
        slack_s = 0.5 / self._sources[0].info.fps
        elapsed = [now - first for now, first in zip(times_s, began, strict=True)]
        for name, seconds in zip(self._names, elapsed, strict=True):
            if abs(seconds - elapsed[0]) > slack_s:
                raise ViewsNotSynchronised(
                    f"frame {index} of view {name} is {seconds:.3f} s after its first frame, that of view "
                    f"{self._names[0]} {elapsed[0]:.3f} s; the videos must show the same instants"
                )
