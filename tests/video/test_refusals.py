"""Inputs that are not a usable video: each one gives its own typed error, quickly, and opens nothing else."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from video_clips import write_audio, write_clip

from vipe_core.errors import (
    CorruptMedia,
    DecodeTimeout,
    EmptyMedia,
    InputError,
    MediaNotFound,
    MediaTooLarge,
    NoVideoStream,
    UnsupportedMedia,
)
from vipe_core.video import Limits, VideoFileSource, open_source, probe


def refusal(path: Path) -> InputError:
    with pytest.raises(InputError) as caught:
        open_source(path)
    assert path.name in str(caught.value)
    assert "\n" not in str(caught.value)
    return caught.value


def test_missing(tmp_path: Path) -> None:
    assert isinstance(refusal(tmp_path / "none.mp4"), MediaNotFound)


def test_zero_bytes(tmp_path: Path) -> None:
    (tmp_path / "zero.mp4").touch()
    assert isinstance(refusal(tmp_path / "zero.mp4"), EmptyMedia)


@pytest.mark.parametrize(
    "content", [b"this is not a video\n" * 50, b"\0" * 5000, b"x", b"<html><body>404</body></html>"]
)
def test_text_and_garbage(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "fake.mp4").write_bytes(content)
    assert isinstance(refusal(tmp_path / "fake.mp4"), CorruptMedia)


@pytest.mark.parametrize("seed", range(3))
def test_random_bytes(tmp_path: Path, seed: int) -> None:
    (tmp_path / "fake.mp4").write_bytes(np.random.default_rng(seed).bytes(100_000))
    assert refusal(tmp_path / "fake.mp4").code in {"media_corrupt", "media_empty"}


def test_an_mp4_whose_index_was_never_written(tmp_path: Path) -> None:
    path = write_clip(tmp_path / "cut.mp4", 30)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    assert isinstance(refusal(path), CorruptMedia)


@pytest.mark.parametrize(
    ("name", "codec"), [("a.wav", "pcm_s16le"), ("a.m4a", "aac"), ("a.mp4", "aac"), ("a.mp3", "libmp3lame")]
)
def test_audio_only(tmp_path: Path, name: str, codec: str) -> None:
    assert isinstance(refusal(write_audio(tmp_path / name, codec)), NoVideoStream)


@pytest.mark.parametrize("name", ["list.m3u8", "list.mp4"])
def test_a_playlist_of_a_local_file_is_not_followed(tmp_path: Path, name: str) -> None:
    write_clip(tmp_path / "real.ts", 25)
    text = "#EXTM3U\n#EXT-X-VERSION:3\n#EXT-X-TARGETDURATION:2\n#EXTINF:1.0,\nreal.ts\n#EXT-X-ENDLIST\n"
    (tmp_path / name).write_text(text)
    assert isinstance(refusal(tmp_path / name), UnsupportedMedia)


def test_other_lists_are_not_followed(tmp_path: Path) -> None:
    write_clip(tmp_path / "real.mp4", 5)
    (tmp_path / "a.mp4").write_text("ffconcat version 1.0\nfile real.mp4\n")
    (tmp_path / "b.mpd").write_text('<?xml version="1.0"?>\n<MPD><Period/></MPD>\n')
    (tmp_path / "c.sdp").write_text("v=0\no=- 0 0 IN IP4 127.0.0.1\nc=IN IP4 127.0.0.1\nm=video 5004 RTP/AVP 96\n")
    for name in ("a.mp4", "b.mpd", "c.sdp"):
        assert isinstance(refusal(tmp_path / name), UnsupportedMedia)


def test_a_single_image_is_named_as_such(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "photo.png"), np.zeros((20, 30, 3), np.uint8))
    error = refusal(tmp_path / "photo.png")
    assert isinstance(error, UnsupportedMedia)
    assert "directory of images" in str(error)


def test_a_named_pipe_is_refused_without_waiting_for_a_writer(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.mp4")
    assert isinstance(refusal(tmp_path / "pipe.mp4"), UnsupportedMedia)


@pytest.mark.parametrize(
    "limits",
    [Limits(max_pixels=96 * 64 - 1), Limits(max_dimension_px=95), Limits(max_frames=11), Limits(max_duration_s=0.4)],
)
def test_limits_are_checked_before_decoding(tmp_path: Path, limits: Limits) -> None:
    path = write_clip(tmp_path / "big.mp4", 12)
    with pytest.raises(MediaTooLarge, match=r"big\.mp4"):
        open_source(path, limits=limits)


def test_the_frame_limit_holds_where_the_container_does_not_say(tmp_path: Path) -> None:
    source = VideoFileSource(write_clip(tmp_path / "big.mkv", 12), limits=Limits(max_frames=5))
    with pytest.raises(MediaTooLarge):
        list(source.frames())


def test_a_probe_has_a_wall_budget(tmp_path: Path) -> None:
    path = write_clip(tmp_path / "c.mp4", 2)
    with pytest.raises(DecodeTimeout, match=r"c\.mp4"):
        probe(path, budget_s=0.001)


@pytest.mark.parametrize("name", ["x" * 300 + ".mp4", "nul\0byte.mp4"], ids=["too long", "nul"])
def test_a_name_that_no_file_can_have(tmp_path: Path, name: str) -> None:
    assert isinstance(refusal(tmp_path / name), MediaNotFound)


def test_a_path_through_a_file(tmp_path: Path) -> None:
    (tmp_path / "clip.mp4").write_bytes(b"x")
    assert isinstance(refusal(tmp_path / "clip.mp4" / "inner.mp4"), MediaNotFound)
