"""Synchronised videos: instants with one time, and typed errors where they do not belong together."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from vipe_core.errors import ConfigError, ViewsNotSynchronised
from vipe_core.video.source import Frame, FrameStream, VideoInfo
from vipe_core.video.synchronised import SynchronisedSource

INFO = VideoInfo("clip", "clip", 4, 3, 25.0, None, None, 0, "none", "rgb24", 0)


@dataclass
class Numbered:
    """Frames whose colour is their number."""

    times_s: list[float]
    info: VideoInfo = INFO
    closed: int = 0

    def frames(self, size: tuple[int, int] | None = None, start: int = 0, stop: int | None = None) -> FrameStream:
        try:
            for index, time_s in list(enumerate(self.times_s))[start:stop]:
                yield Frame(index, time_s, np.full((3, 4, 3), index, np.uint8))
        finally:
            self.closed += 1


def times(count: int, begin: float = 0.0) -> list[float]:
    return [begin + k / 25 for k in range(count)]


def test_views_of_an_instant_come_together_with_one_time() -> None:
    left, right = Numbered(times(5)), Numbered(times(5, begin=12.0))
    instants = list(SynchronisedSource([left, right], ["left", "right"]).frames(start=1, stop=4))
    assert [instant[0].index for instant in instants] == [1, 2, 3]
    for first, second in instants:
        assert first.timestamp_s == second.timestamp_s
        assert first.rgb[0, 0, 0] == second.rgb[0, 0, 0]


def test_a_shorter_view_is_named_and_all_decoders_end() -> None:
    left, right = Numbered(times(5)), Numbered(times(3))
    with pytest.raises(ViewsNotSynchronised, match="right ends after 3 frames"):
        list(SynchronisedSource([left, right], ["left", "right"]).frames())
    assert (left.closed, right.closed) == (1, 1)


def test_a_view_that_drops_a_frame_is_named() -> None:
    dropped = times(6)
    del dropped[2]
    with pytest.raises(ViewsNotSynchronised, match="frame 2 of view right"):
        list(SynchronisedSource([Numbered(times(5)), Numbered(dropped)], ["left", "right"]).frames())


def test_other_rates_and_missing_videos_are_refused() -> None:
    with pytest.raises(ViewsNotSynchronised, match="30 frames per second"):
        SynchronisedSource([Numbered(times(3)), Numbered(times(3), replace(INFO, fps=30.0))], ["left", "right"])
    with pytest.raises(ConfigError, match="2 views"):
        SynchronisedSource([Numbered(times(3))], ["left", "right"])
