"""Directories of images as a clip."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from video_clips import number_of, picture

from vipe_core.errors import CorruptMedia, EmptyMedia, MediaNotFound, MediaTooLarge
from vipe_core.video import ImageDirectorySource, Limits, open_source


def save(path: Path, rgb: NDArray[np.generic]) -> None:
    assert cv2.imwrite(str(path), rgb[..., ::-1] if rgb.ndim == 3 else rgb)


def test_images_come_in_plain_order_of_names(tmp_path: Path) -> None:
    folder = tmp_path / "my run.1"
    folder.mkdir()
    for number, name in enumerate(["10.png", "9.png", "A.JPG", "b.webp", "c.tiff", "d.bmp"]):
        save(folder / name, picture(number, 90, 60))
    (folder / "notes.txt").write_text("not an image")
    (folder / "._10.png").write_bytes(b"left by a file manager")
    source = open_source(folder)
    frames = list(source.frames())
    assert [number_of(frame.rgb) for frame in frames] == [0, 1, 2, 3, 4, 5]
    assert [frame.timestamp_s for frame in frames] == pytest.approx([index / 30 for index in range(6)])
    info = source.info
    assert (info.name, info.width, info.height, info.fps, info.num_frames_hint) == ("my-run-1", 90, 60, 30.0, 6)


def test_more_images_than_one_child_takes(tmp_path: Path) -> None:
    for number in range(140):
        save(tmp_path / f"{number:04d}.bmp", picture(number % 64, 24, 12))
    source = ImageDirectorySource(tmp_path, fps=10)
    frames = list(source.frames(start=120, stop=135))
    assert [frame.index for frame in frames] == list(range(120, 135))
    assert [number_of(frame.rgb) for frame in frames] == [number % 64 for number in range(120, 135)]
    assert frames[0].timestamp_s == pytest.approx(12.0)
    assert [frame.index for frame in source.frames()] == list(range(140))


def test_resize_is_by_area(tmp_path: Path) -> None:
    save(tmp_path / "a.png", picture(5, 96, 64))
    (frame,) = open_source(tmp_path).frames((40, 30))
    assert np.array_equal(frame.rgb, cv2.resize(picture(5, 96, 64), (40, 30), interpolation=cv2.INTER_AREA))


def test_grey_and_sixteen_bit_become_eight_bit_rgb(tmp_path: Path) -> None:
    grey = picture(3, 96, 64)[..., 0]
    save(tmp_path / "a.png", grey)
    save(tmp_path / "b.png", grey.astype(np.uint16) * 257)
    save(
        tmp_path / "c.png",
        np.dstack([picture(3, 96, 64), np.full((64, 96), 7, np.uint8)])[..., [2, 1, 0, 3]][..., ::-1],
    )
    frames = list(open_source(tmp_path).frames())
    assert all(frame.rgb.dtype == np.uint8 and frame.rgb.shape == (64, 96, 3) for frame in frames)
    for frame in frames[:2]:
        assert np.abs(frame.rgb.astype(int) - grey[..., None]).max() <= 1


def test_exif_orientation_is_applied(tmp_path: Path) -> None:
    rgb = picture(2, 96, 64)
    data = cv2.imencode(".jpg", rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()
    tiff = b"II*\0" + struct.pack("<IHHHIHHI", 8, 1, 0x0112, 3, 1, 6, 0, 0)
    segment = b"Exif\0\0" + tiff
    exif = b"\xff\xe1" + struct.pack(">H", len(segment) + 2) + segment
    (tmp_path / "a.jpg").write_bytes(data[:2] + exif + data[2:])
    source = open_source(tmp_path)
    (frame,) = source.frames()
    assert (source.info.width, source.info.height) == (64, 96)
    assert np.abs(frame.rgb.astype(float) - np.rot90(rgb, -1)).mean() < 5


def test_a_broken_image_is_named(tmp_path: Path) -> None:
    save(tmp_path / "a.png", picture(0, 96, 64))
    (tmp_path / "b.png").write_bytes((tmp_path / "a.png").read_bytes()[:60])
    with pytest.raises(CorruptMedia, match=r"b\.png"):
        list(open_source(tmp_path).frames())
    (tmp_path / "a.png").write_bytes(b"")
    with pytest.raises(CorruptMedia, match=r"a\.png"):
        open_source(tmp_path)


@pytest.mark.parametrize("size", [None, (32, 32)])
def test_an_image_of_another_size_is_named(tmp_path: Path, size: tuple[int, int] | None) -> None:
    save(tmp_path / "a.png", picture(0, 96, 64))
    save(tmp_path / "b.png", picture(0, 64, 96))
    with pytest.raises(CorruptMedia, match=r"b\.png.*64x96.*96x64"):
        list(open_source(tmp_path).frames(size))


def test_no_images_no_directory_and_limits(tmp_path: Path) -> None:
    with pytest.raises(EmptyMedia):
        open_source(tmp_path)
    with pytest.raises(MediaNotFound):
        ImageDirectorySource(tmp_path / "none")
    save(tmp_path / "a.png", picture(0, 96, 64))
    save(tmp_path / "b.png", picture(1, 96, 64))
    with pytest.raises(MediaTooLarge):
        open_source(tmp_path, limits=Limits(max_frames=1))
    with pytest.raises(MediaTooLarge):
        open_source(tmp_path, limits=Limits(max_pixels=1000))


def test_links_out_of_the_directory_are_skipped(tmp_path: Path) -> None:
    folder, elsewhere = tmp_path / "frames", tmp_path / "elsewhere"
    folder.mkdir()
    elsewhere.mkdir()
    save(folder / "1.png", picture(1, 90, 60))
    save(elsewhere / "secret.png", picture(2, 90, 60))
    (folder / "2.png").symlink_to(elsewhere / "secret.png")
    (folder / "3.png").symlink_to("1.png")
    assert [number_of(frame.rgb) for frame in open_source(folder).frames()] == [1, 1]


def test_an_image_is_refused_by_its_header(tmp_path: Path) -> None:
    """Nothing of it is decoded: a few kilobytes can hold gigabytes of one colour."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", 30_000, 30_000, 1, 0, 0, 0, 0))
    (tmp_path / "bomb.png").write_bytes(b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", b"") + chunk(b"IEND", b""))
    with pytest.raises(MediaTooLarge, match=r"bomb\.png"):
        open_source(tmp_path)
