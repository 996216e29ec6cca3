"""The mp4 that we write: size, count, rate, colours, bytes, and nothing half-written."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from video_clips import number_of, picture

from vipe_core.video import VideoFileSource
from vipe_core.video.encode import VideoWriter


def write(path: Path, count: int, size: tuple[int, int], fps: float | Fraction = 25, **options: int) -> Path:
    with VideoWriter(path, fps, **options) as writer:
        for index in range(count):
            writer.write(picture(index, *size))
    return path


@pytest.mark.parametrize(
    ("size", "pixel_format"),
    [((96, 64), "yuv420p"), ((97, 64), "yuv444p"), ((96, 65), "yuv444p"), ((33, 31), "yuv444p")],
)
def test_size_count_and_order_survive(tmp_path: Path, size: tuple[int, int], pixel_format: str) -> None:
    source = VideoFileSource(write(tmp_path / "o.mp4", 17, size))
    frames = list(source.frames())
    assert [number_of(frame.rgb) for frame in frames] == list(range(17))
    assert (source.info.width, source.info.height, source.info.num_frames_hint) == (*size, 17)
    assert source.info.pixel_format == pixel_format
    assert source.info.codec == "h264"
    assert np.abs(frames[4].rgb.astype(float) - picture(4, *size)).mean() < 8


@pytest.mark.parametrize(
    ("fps", "expected"),
    [
        (29.97002997, Fraction(30000, 1001)),
        (30, Fraction(30)),
        (Fraction(24000, 1001), Fraction(24000, 1001)),
        (7.5, Fraction(15, 2)),
        (1 / 3600, Fraction(1, 3600)),
    ],
)
def test_the_rate_is_exact(tmp_path: Path, fps: float | Fraction, expected: Fraction) -> None:
    path = write(tmp_path / "o.mp4", 12, (64, 48), fps)
    with av.open(str(path)) as container:
        assert container.streams.video[0].average_rate == expected
    assert [frame.timestamp_s for frame in VideoFileSource(path).frames()] == pytest.approx(
        [index / float(expected) for index in range(12)], abs=1e-4
    )


def test_colours_are_not_shifted(tmp_path: Path) -> None:
    path = write(tmp_path / "o.mp4", 3, (192, 128), crf=4)
    rgb = next(VideoFileSource(path).frames()).rgb.astype(float)
    assert np.abs((rgb - picture(0, 192, 128)).mean((0, 1))).max() < 0.6


def test_same_pictures_same_bytes(tmp_path: Path) -> None:
    assert write(tmp_path / "a.mp4", 9, (96, 64)).read_bytes() == write(tmp_path / "b.mp4", 9, (96, 64)).read_bytes()


def test_an_interrupted_write_leaves_nothing(tmp_path: Path) -> None:
    def interrupted() -> None:
        with VideoWriter(tmp_path / "o.mp4", 25) as writer:
            writer.write(picture(0, 96, 64))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert list(tmp_path.iterdir()) == []


def test_misuse_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="at least one picture"), VideoWriter(tmp_path / "o.mp4", 25):
        pass
    writer = VideoWriter(tmp_path / "o.mp4", 25)
    writer.write(picture(0, 96, 64))
    with pytest.raises(ValueError, match="every picture must be 96x64"):
        writer.write(picture(0, 64, 96))
    writer.abort()
    with pytest.raises(ValueError, match="fps"):
        VideoWriter(tmp_path / "o.mp4", 0)
    assert list(tmp_path.iterdir()) == []
