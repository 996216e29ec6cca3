"""Views of a frame source show exactly what they say, from videos as from images."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vipe_core.errors import EmptyMedia, MediaNotFound, UnsupportedMedia
from vipe_core.video import Frame, ImageDirectorySource, VideoInfo, views
from vipe_core.video.views import Crop, FrameView, ReversedView


@dataclass
class Ramp:
    """Frames whose every pixel tells its frame, row and column."""

    count: int
    width: int = 16
    height: int = 8
    decoded: int = 0

    @property
    def info(self) -> VideoInfo:
        return VideoInfo(
            "ramp", "ramp", self.width, self.height, 10.0, self.count, self.count / 10, 0, "raw", "rgb24", 0
        )

    def frames(self, size: tuple[int, int] | None = None, start: int = 0, stop: int | None = None) -> Iterator[Frame]:
        for k in range(start, min(self.count, self.count if stop is None else stop)):
            self.decoded += 1
            rgb = np.zeros((self.height, self.width, 3), np.uint8)
            rgb[..., 0] = k
            rgb[..., 1] = np.arange(self.height)[:, None]
            rgb[..., 2] = np.arange(self.width)
            if size is not None:
                rgb = np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), np.uint8)
            yield Frame(k, k / 10, rgb)


@given(count=st.integers(1, 12), block=st.integers(1, 5), start=st.integers(0, 12), stop=st.none() | st.integers(0, 14))
def test_reversed_is_the_list_backwards(count: int, block: int, start: int, stop: int | None) -> None:
    source = Ramp(count)
    times_s = [k / 10 for k in range(count)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(views, "_REVERSE_BYTES", block * 3 * 16 * 8)
        shown = list(ReversedView(source, times_s).frames(start=start, stop=stop))
    expected = list(range(count))[::-1][start:stop]
    assert [int(frame.rgb[0, 0, 0]) for frame in shown] == expected
    assert [frame.index for frame in shown] == list(range(count))[start:stop]
    assert [frame.timestamp_s for frame in shown] == pytest.approx([times_s[-1] - times_s[k] for k in expected])


def test_reversed_holds_one_block(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first frame is there after one block is decoded, not after the whole video."""
    monkeypatch.setattr(views, "_REVERSE_BYTES", 4 * 3 * 16 * 8)
    source = Ramp(40)
    next(ReversedView(source, [k / 10 for k in range(40)]).frames())
    assert source.decoded == 4


def test_a_view_is_short_cropped_and_timed() -> None:
    view = FrameView(Ramp(9), stop=4, crop=Crop(5, 2, 6, 4), timestamps_s=[0, 0.5, 1, 1.5])
    frames = list(view.frames())
    assert [frame.timestamp_s for frame in frames] == [0, 0.5, 1, 1.5]
    assert (view.info.width, view.info.height, view.info.num_frames_hint) == (6, 4, 4)
    assert view.info.fps == pytest.approx(2)
    np.testing.assert_array_equal(frames[3].rgb[..., 2], np.tile(np.arange(5, 11), (4, 1)))
    np.testing.assert_array_equal(frames[3].rgb[..., 1], np.tile(np.arange(2, 6)[:, None], (1, 6)))
    assert [frame.index for frame in view.frames(start=2, stop=9)] == [2, 3]
    assert next(view.frames((3, 2))).rgb.shape == (2, 3, 3)


def test_a_crop_beyond_the_picture_is_refused() -> None:
    with pytest.raises(UnsupportedMedia, match="ramp: a crop of 20x4"):
        FrameView(Ramp(2), crop=Crop(0, 0, 20, 4))


def test_chosen_images_of_a_directory(tmp_path: Path) -> None:
    for k in range(4):
        cv2.imwrite(str(tmp_path / f"{k}.png"), np.full((8, 8, 3), 10 * k, np.uint8))
    source = ImageDirectorySource(tmp_path, files=("3.png", "1.png"))
    assert [int(frame.rgb[0, 0, 0]) for frame in source.frames()] == [30, 10]
    assert source.info.num_frames_hint == 2
    with pytest.raises(MediaNotFound, match=r"7\.png"):
        ImageDirectorySource(tmp_path, files=("3.png", "7.png"))
    with pytest.raises(EmptyMedia):
        ImageDirectorySource(tmp_path, files=())
