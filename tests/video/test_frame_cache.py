"""Random access to frames in bounded memory."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from video_clips import number_of, picture, write_clip

from vipe_core.video import Frame, FrameCache, FrameStream, VideoFileSource, VideoInfo

FRAME_BYTES = 24 * 12 * 3


class ListedSource:
    """A source in memory that counts how often a decoder is started and a frame decoded."""

    def __init__(self, count: int) -> None:
        self.count, self.starts, self.decoded = count, 0, 0

    @property
    def info(self) -> VideoInfo:
        return VideoInfo("listed", "listed", 24, 12, 25.0, self.count, None, 0, "raw", "rgb24", 0)

    def frames(self, size: tuple[int, int] | None = None, start: int = 0, stop: int | None = None) -> FrameStream:
        self.starts += 1
        for index in range(start, self.count if stop is None else min(stop, self.count)):
            self.decoded += 1
            yield Frame(index, index / 25, picture(index, *(size or (24, 12))))


@settings(max_examples=40, deadline=None)
@given(st.lists(st.integers(0, 19), max_size=60), st.integers(1, 8))
def test_any_order_gives_the_right_frames_within_the_bound(order: list[int], capacity: int) -> None:
    with FrameCache(ListedSource(20), max_bytes=capacity * FRAME_BYTES) as cache:
        for index in order:
            assert number_of(cache.get(index)) == index
            assert cache.held_bytes <= capacity * FRAME_BYTES


def test_going_forward_decodes_each_frame_once() -> None:
    source = ListedSource(20)
    with FrameCache(source, max_bytes=4 * FRAME_BYTES) as cache:
        for index in (0, 1, 2, 1, 3, 2, 5, 4, 8, 7, 8):
            cache.get(index)
    assert (source.starts, source.decoded) == (1, 9)


def test_frames_are_read_only_and_the_end_is_an_index_error() -> None:
    with FrameCache(ListedSource(3), size=(12, 6)) as cache:
        assert cache.get(2).shape == (6, 12, 3)
        with pytest.raises(ValueError, match="read-only"):
            cache.get(2)[0, 0] = 1
        with pytest.raises(IndexError):
            cache.get(3)
        with pytest.raises(IndexError):
            cache.get(-1)
        assert number_of(cache.get(1)) == 1


def test_over_a_real_clip(tmp_path: Path) -> None:
    source = VideoFileSource(write_clip(tmp_path / "c.mp4", 20))
    with FrameCache(source, (48, 32), max_bytes=5 * 48 * 32 * 3) as cache:
        for index in (0, 3, 2, 19, 4, 5, 0):
            assert number_of(cache.get(index)) == index
            assert cache.frame(index).timestamp_s == pytest.approx(index / 25)
    assert np.array_equal(cache.get(4), next(iter(source.frames((48, 32), 4, 5))).rgb)
    cache.close()
