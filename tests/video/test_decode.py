"""What comes out of a decoder: numbers, times, orientation and colours of the pictures."""

from __future__ import annotations

from fractions import Fraction
from itertools import pairwise
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from video_clips import declare_panorama, number_of, picture, set_display_rotation, write_clip

from vipe_core.errors import UnsupportedMedia
from vipe_core.video import Limits, VideoFileSource, open_source, probe
from vipe_core.video.av_decode import Clock, Damage, decode
from vipe_core.video.opened import open_media


def test_every_frame_arrives_once_in_order_with_its_time(tmp_path: Path) -> None:
    source = open_source(write_clip(tmp_path / "a clip.mp4", 20))
    frames = list(source.frames())
    assert [frame.index for frame in frames] == list(range(20))
    assert [number_of(frame.rgb) for frame in frames] == list(range(20))
    assert [frame.timestamp_s for frame in frames] == pytest.approx([index / 25 for index in range(20)])
    assert source.info.name == "a-clip"
    assert (source.info.width, source.info.height, source.info.num_frames_hint) == (96, 64, 20)
    assert (source.info.fps, source.info.codec, source.info.duration_s) == (25.0, "h264", pytest.approx(0.8))


@pytest.mark.parametrize(
    ("start", "stop", "expected"),
    [
        (0, 4, range(4)),
        (7, 9, range(7, 9)),
        (10, None, range(10, 12)),
        (5, 5, range(0)),
        (11, 99, range(11, 12)),
        (50, None, range(0)),
    ],
)
def test_ranges_are_half_open_and_keep_frame_numbers(
    tmp_path: Path, start: int, stop: int | None, expected: range
) -> None:
    source = VideoFileSource(write_clip(tmp_path / "c.mp4", 12))
    frames = list(source.frames(start=start, stop=stop))
    assert [frame.index for frame in frames] == list(expected)
    assert [number_of(frame.rgb) for frame in frames] == list(expected)


def test_b_frames_come_in_presentation_order(tmp_path: Path) -> None:
    path = write_clip(tmp_path / "b.mp4", 30, options={"bf": "3", "x264-params": "b-adapt=0:bframes=3"})
    frames = list(VideoFileSource(path).frames((48, 32)))
    assert [number_of(frame.rgb) for frame in frames] == list(range(30))


def test_colours_survive(tmp_path: Path) -> None:
    path = write_clip(tmp_path / "c.mp4", 2, (192, 128), pixel_format="yuv444p", options={"qp": "1"})
    rgb = next(VideoFileSource(path).frames()).rgb.astype(float)
    error = rgb - picture(0, 192, 128)
    assert np.abs(error.mean((0, 1))).max() < 0.5
    assert np.abs(error).max() < 6


@pytest.mark.parametrize("size", [(48, 32), (64, 40), (31, 21)])
def test_resize_is_by_area(tmp_path: Path, size: tuple[int, int]) -> None:
    rng = np.random.default_rng(0)
    noise = cv2.GaussianBlur(rng.uniform(0, 255, (128, 192)), (0, 0), 1.5)
    path = tmp_path / "noise.mkv"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=25)
        stream.width, stream.height, stream.pix_fmt = 192, 128, "gray"
        container.mux(stream.encode(av.VideoFrame.from_ndarray(noise.astype(np.uint8), format="gray")))
        container.mux(stream.encode(None))
    source = VideoFileSource(path)
    whole = next(source.frames()).rgb
    small = next(source.frames(size)).rgb
    assert small.shape == (size[1], size[0], 3)
    expected = cv2.resize(whole.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    assert np.abs(small - expected).mean() < 1.0
    assert abs(float(small.mean()) - float(expected.mean())) < 0.7


@pytest.mark.parametrize(("width", "height"), [(97, 65), (33, 64), (64, 35)])
def test_odd_sizes(tmp_path: Path, width: int, height: int) -> None:
    path = write_clip(tmp_path / "odd.mp4", 3, (width, height), pixel_format="yuv444p", options={"qp": "4"})
    source = VideoFileSource(path)
    frame = list(source.frames())[2]
    assert frame.rgb.shape == (height, width, 3)
    assert (source.info.width, source.info.height) == (width, height)
    assert np.abs(frame.rgb.astype(float) - picture(2, width, height)).mean() < 4


@pytest.mark.parametrize(
    ("codec", "pixel_format", "options"),
    [
        ("libx264", "yuv420p10le", {"qp": "4"}),
        ("ffv1", "yuv444p10le", {}),
        ("libx265", "yuv420p10le", {"x265-params": "log-level=none:qp=4"}),
    ],
)
def test_ten_bit_becomes_eight(tmp_path: Path, codec: str, pixel_format: str, options: dict[str, str]) -> None:
    path = write_clip(tmp_path / "deep.mkv", 3, (192, 128), codec=codec, pixel_format=pixel_format, options=options)
    source = VideoFileSource(path)
    frame = list(source.frames())[1]
    assert source.info.pixel_format == pixel_format
    assert np.abs(frame.rgb.astype(float) - picture(1, 192, 128)).mean() < 3


@pytest.mark.parametrize("clockwise_deg", [0, 90, 180, 270])
def test_rotation_metadata_makes_the_picture_upright(tmp_path: Path, clockwise_deg: int) -> None:
    path = write_clip(tmp_path / "phone.mp4", 3, (96, 64), pixel_aspect=Fraction(4, 3))
    set_display_rotation(path, clockwise_deg)
    source = VideoFileSource(path)
    coded = picture(2, 96, 64)
    upright = np.rot90(coded, -clockwise_deg // 90)
    frame = list(source.frames())[2]
    assert source.info.rotation_deg == clockwise_deg
    # A coded pixel is wider than high; turned by a quarter it is higher than wide.
    assert source.info.pixel_aspect == pytest.approx(3 / 4 if clockwise_deg % 180 else 4 / 3)
    assert (source.info.height, source.info.width) == upright.shape[:2] == frame.rgb.shape[:2]
    assert np.abs(frame.rgb.astype(float) - upright).mean() < 8
    size = (upright.shape[1] // 2, upright.shape[0] // 2)
    small = list(source.frames(size))[2].rgb
    assert np.abs(small - cv2.resize(upright, size, interpolation=cv2.INTER_AREA).astype(float)).mean() < 8


def test_variable_frame_rate_keeps_the_real_times(tmp_path: Path) -> None:
    pts_ms = [0, 33, 50, 200, 210, 1000, 1033]
    for name in ("v.mp4", "v.mkv"):
        source = VideoFileSource(write_clip(tmp_path / name, len(pts_ms), pts_ms=pts_ms))
        times = [frame.timestamp_s for frame in source.frames()]
        assert np.diff(times) == pytest.approx(np.diff(pts_ms) / 1000, abs=1e-3)


def test_a_container_without_a_frame_count(tmp_path: Path) -> None:
    source = VideoFileSource(write_clip(tmp_path / "c.mkv", 9))
    assert source.info.num_frames_hint is None
    assert len(list(source.frames())) == 9


@pytest.mark.parametrize("value", [40, 128, 220])
@pytest.mark.parametrize(("pixel_format", "scale", "offset"), [("yuv420p", 219, 16), ("yuvj420p", 255, 0)])
def test_limited_and_full_range_are_told_apart(
    tmp_path: Path, value: int, pixel_format: str, scale: int, offset: int
) -> None:
    path = tmp_path / "grey.mkv"
    luma = round(offset + value * scale / 255)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mjpeg" if pixel_format == "yuvj420p" else "ffv1", rate=25)
        stream.width, stream.height, stream.pix_fmt = 64, 48, pixel_format
        if pixel_format == "yuvj420p":
            stream.codec_context.color_range = 2
        planes = np.full((72, 64), 128, np.uint8)
        planes[:48] = luma
        container.mux(stream.encode(av.VideoFrame.from_ndarray(planes, format=pixel_format)))
        container.mux(stream.encode(None))
    rgb = next(VideoFileSource(path).frames()).rgb
    assert np.abs(rgb.astype(int) - value).max() <= 2


@pytest.mark.parametrize("name", ["cut.mkv", "cut.mp4", "cut.ts"])
def test_a_file_cut_short_gives_the_frames_before_the_cut(
    tmp_path: Path, name: str, caplog: pytest.LogCaptureFixture
) -> None:
    path = write_clip(
        tmp_path / name,
        40,
        (192, 128),
        options={"g": "5", "qp": "10"},
        container_options={"movflags": "+faststart"} if name.endswith("mp4") else None,
    )
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 6 // 10])
    source = VideoFileSource(path)
    numbers = [number_of(frame.rgb) for frame in source.frames()]
    assert 5 < len(numbers) < 40
    assert numbers == list(range(len(numbers)))
    if name.endswith("mp4"):
        assert source.damage is not None
        assert "cut.mp4" in caplog.text


def test_bytes_damaged_in_the_middle_do_not_lose_the_clip(tmp_path: Path) -> None:
    path = write_clip(tmp_path / "hurt.mkv", 40, (192, 128), options={"g": "5", "qp": "10"})
    data = bytearray(path.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 400] = np.random.default_rng(1).bytes(400)
    path.write_bytes(data)
    source = VideoFileSource(path)
    numbers = [number_of(frame.rgb) for frame in source.frames()]
    assert len(numbers) >= 25
    assert numbers[:10] == list(range(10))
    assert numbers[-1] == 39


def test_a_size_change_within_the_clip_is_refused(tmp_path: Path) -> None:
    one = write_clip(tmp_path / "one.ts", 10, (96, 64))
    two = write_clip(tmp_path / "two.ts", 10, (64, 96))
    path = tmp_path / "both.ts"
    path.write_bytes(one.read_bytes() + two.read_bytes())
    with pytest.raises(UnsupportedMedia, match="changes from 96x64 to 64x96"):
        list(VideoFileSource(path).frames())


def test_two_passes_give_the_same_bytes(tmp_path: Path) -> None:
    source = VideoFileSource(write_clip(tmp_path / "c.mp4", 10, (160, 96)), threads=3)
    first = [frame.rgb.tobytes() for frame in source.frames((80, 48))]
    assert first == [frame.rgb.tobytes() for frame in source.frames((80, 48))]


def test_a_one_frame_video(tmp_path: Path) -> None:
    path = write_clip(tmp_path / "one.mp4", 1)
    assert probe(path).num_frames_hint == 1
    assert [frame.index for frame in open_source(path).frames()] == [0]


def test_a_file_name_cannot_be_taken_for_a_protocol_or_pattern(tmp_path: Path) -> None:
    for name in ("concat:a|b.mp4", "frame%03d.mp4", "é ü.mp4", "-y.mp4"):
        write_clip(tmp_path / "plain.mp4", 2).rename(tmp_path / name)
        assert len(list(decode(open_media(str(tmp_path / name), Limits()), Limits(), 1, Damage(), lambda: None))) == 2


@given(st.lists(st.one_of(st.none(), st.floats(-1e6, 1e6), st.just(float("nan"))), max_size=40))
def test_repaired_times_are_strictly_increasing(raw: list[float | None]) -> None:
    clock = Clock(0.04)
    times = [clock.repaired(value) for value in raw]
    assert all(later > earlier for earlier, later in pairwise(times))


@given(st.lists(st.integers(1, 500), min_size=1, max_size=40), st.floats(-10, 10))
def test_good_times_pass_unchanged(steps_ms: list[int], start_s: float) -> None:
    raw = start_s + np.cumsum(steps_ms) / 1000
    clock = Clock(0.04)
    assert [clock.repaired(float(value)) for value in raw] == raw.tolist()


def test_missing_repeated_and_reset_times() -> None:
    clock = Clock(0.1)
    repaired = [clock.repaired(value) for value in (None, 0.1, None, 0.2, 0.3, 10.0, 0.0, 0.1)]
    assert repaired == pytest.approx([0.0, 0.1, 0.2, 0.25, 0.3, 10.0, 10.1, 10.2])


GROUPS = {
    "closed.mp4": ("libx264", {"g": "12", "bf": "3", "sc_threshold": "0"}),
    "open.mkv": ("libx264", {"x264-params": "open-gop=1:bframes=3:keyint=12:scenecut=0"}),
    "refresh.mp4": ("libx264", {"x264-params": "intra-refresh=1:keyint=12"}),
    "vp9.mkv": ("libvpx-vp9", {"g": "12", "lag-in-frames": "8"}),
    "stream.ts": ("libx264", {"g": "12"}),
}


@pytest.mark.parametrize("name", GROUPS)
def test_a_range_is_the_same_part_of_the_whole_in_every_container(tmp_path: Path, name: str) -> None:
    codec, options = GROUPS[name]
    source = VideoFileSource(write_clip(tmp_path / name, 40, codec=codec, options=options))
    whole = list(source.frames())
    part = list(source.frames(start=26, stop=39))
    assert len(whole) == 40
    assert [(f.index, f.timestamp_s) for f in part] == [(f.index, f.timestamp_s) for f in whole[26:39]]
    assert all(np.array_equal(a.rgb, b.rgb) for a, b in zip(part, whole[26:39], strict=True))


def test_a_container_may_say_that_its_pictures_are_panoramas(tmp_path: Path) -> None:
    path = write_clip(tmp_path / "round.mp4", num_frames=2)
    assert not probe(path).spherical
    declare_panorama(path)
    assert probe(path).spherical
    other = write_clip(tmp_path / "cube.mp4", num_frames=2)
    declare_panorama(other, projection="cubemap")
    assert not probe(other).spherical
