"""The EXR depth codec and the zip around it."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from vipe_core.errors import FormatError
from vipe_core.formats import DepthZipReader, DepthZipWriter, decode_depth, encode_depth

SHAPES = hnp.array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=40)


@settings(max_examples=60, deadline=None)
@given(hnp.arrays(np.float32, SHAPES, elements=st.floats(0, 60000, width=16)))
def test_half_values_come_back_exactly(depth: np.ndarray) -> None:
    decoded = decode_depth(encode_depth(depth))
    assert decoded.dtype == np.float32
    assert np.array_equal(decoded, np.abs(depth))


@settings(max_examples=60, deadline=None)
@given(hnp.arrays(np.float32, SHAPES, elements=st.floats(allow_nan=True, allow_infinity=True, width=32)))
def test_any_float_becomes_no_value_or_a_half_close_to_it(depth: np.ndarray) -> None:
    decoded = decode_depth(encode_depth(depth))
    no_value = ~(np.isfinite(depth) & (depth > 0))
    assert np.array_equal(decoded == 0, no_value)
    assert np.isfinite(decoded).all()
    usual = ~no_value & (depth > 1e-4) & (depth < 65504)
    assert np.allclose(decoded[usual], depth[usual], rtol=2**-11)
    assert (decoded[~no_value & (depth >= 65504)] == 65504).all()


def test_the_header_is_the_one_of_vipe(tmp_path: Path) -> None:
    path = tmp_path / "d.exr"
    path.write_bytes(encode_depth(np.ones((33, 50), np.float32)))
    image = OpenEXR.File(str(path))
    header = image.header()
    assert [channel.name for channel in header["channels"]] == ["Z"]
    assert image.channels()["Z"].type() == OpenEXR.HALF
    assert header["compression"] == OpenEXR.ZIP_COMPRESSION
    assert header["type"] == OpenEXR.scanlineimage
    assert header["lineOrder"] == OpenEXR.INCREASING_Y
    assert header["pixelAspectRatio"] == 1
    for window in ("dataWindow", "displayWindow"):
        assert [corner.tolist() for corner in header[window]] == [[0, 0], [49, 32]]


def test_same_values_same_bytes() -> None:
    depth = np.random.default_rng(0).uniform(0, 9, (48, 64)).astype(np.float32)
    assert encode_depth(depth) == encode_depth(depth.copy())
    for other in (depth.astype(np.float64), np.asfortranarray(depth), np.repeat(depth, 2, axis=1)[:, ::2]):
        assert encode_depth(depth) == encode_depth(other)


def test_what_is_no_depth_image_is_refused(tmp_path: Path) -> None:
    good = encode_depth(np.ones((20, 20), np.float32))
    path = tmp_path / "rgb.exr"
    OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION}, {"Y": np.ones((4, 4), np.float32)}).write(str(path))
    for data in (b"", b"no image", good[:100], good[: len(good) - 5], path.read_bytes()):
        with pytest.raises(FormatError, match="frame 7"):
            decode_depth(data, "frame 7")
    with pytest.raises(ValueError, match="two dimensions"):
        encode_depth(np.ones((2, 3, 4), np.float32))


def write_zip(path: Path, count: int) -> Path:
    with DepthZipWriter(path) as writer:
        for index in range(count):
            writer.append(np.full((6, 9), 1 + index, np.float32))
    return path


def test_members_are_named_dated_and_deflated_as_vipe_does(tmp_path: Path) -> None:
    with zipfile.ZipFile(write_zip(tmp_path / "d.zip", 12)) as archive:
        members = archive.infolist()
        assert archive.testzip() is None
    assert [member.filename for member in members] == [f"{index:05d}.exr" for index in range(12)]
    assert {member.compress_type for member in members} == {zipfile.ZIP_DEFLATED}
    assert {member.date_time for member in members} == {(1980, 1, 1, 0, 0, 0)}


def test_zip_round_trip_and_same_bytes(tmp_path: Path) -> None:
    path = write_zip(tmp_path / "d.zip", 12)
    with DepthZipReader(path) as reader:
        assert len(reader) == 12
        assert [float(depth.max()) for depth in reader] == list(range(1, 13))
        assert reader.read(7).shape == (6, 9)
        for index in (12, -1):
            with pytest.raises(IndexError):
                reader.read(index)
    assert path.read_bytes() == write_zip(tmp_path / "e.zip", 12).read_bytes()


def test_damaged_archives_are_refused(tmp_path: Path) -> None:
    path = write_zip(tmp_path / "d.zip", 3)
    data = bytearray(path.read_bytes())
    with pytest.raises(FormatError, match="no such"):
        DepthZipReader(tmp_path / "none.zip")
    path.write_bytes(data[:-30])
    with pytest.raises(FormatError, match="not a readable zip"):
        DepthZipReader(path)
    data[60] ^= 0xFF
    path.write_bytes(data)
    with DepthZipReader(path) as reader, pytest.raises(FormatError, match=r"00000\.exr"):
        reader.read(0)


@pytest.mark.parametrize(
    "names", [["00000.exr", "00002.exr"], ["00001.exr"], ["00000.exr", "notes.txt"], ["a/00000.exr"], ["0.exr"]]
)
def test_wrong_member_names_are_refused(tmp_path: Path, names: list[str]) -> None:
    with zipfile.ZipFile(tmp_path / "d.zip", "w") as archive:
        for name in names:
            archive.writestr(name, encode_depth(np.ones((2, 2), np.float32)))
    with pytest.raises(FormatError, match=r"d\.zip"):
        DepthZipReader(tmp_path / "d.zip")
