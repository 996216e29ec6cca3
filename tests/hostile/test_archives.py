"""Tars and zips that mean harm."""

from __future__ import annotations

import io
import struct
import tarfile
import zipfile
from pathlib import Path

import numpy as np
import pytest

from services.commit.tar_reader import read_members
from services.commit.verify import index_tar
from services.domain.errors import IntegrityError
from vipe_core.errors import FormatError
from vipe_core.formats import DepthZipReader
from vipe_core.formats.exr import decode_depth, encode_depth
from vipe_core.formats.reading import read_npz

NAMES = [
    "../evil.npz", "/etc/evil.npz", "a/../../evil.npz", "a/b.npz", "..\\evil.npz", "noextension", ".npz", "a\nb.npz",
    "a\u202eb.npz", "C:\\x.npz",
]  # fmt: skip


def tar_of(*members: tarfile.TarInfo, kind: int = tarfile.GNU_FORMAT) -> bytes:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w", format=kind) as tar:
        for info in members:
            tar.addfile(info, io.BytesIO(bytes(info.size)) if info.type == tarfile.REGTYPE else None)
    return buffer.getvalue()


def member(name: str, kind: bytes = tarfile.REGTYPE, **fields: object) -> tarfile.TarInfo:
    info = tarfile.TarInfo(name)
    info.type = kind
    for field, value in fields.items():
        setattr(info, field, value)
    return info


def refused(data: bytes, tmp_path: Path) -> str:
    """Both readers of tars refuse it."""
    with pytest.raises(IntegrityError) as caught:
        [contents.read() for _, _, _, contents in read_members(io.BytesIO(data), "shard.tar")]
    (tmp_path / "shard.tar").write_bytes(data)
    with pytest.raises(IntegrityError):
        index_tar(tmp_path / "shard.tar")
    assert "shard.tar" in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("name", NAMES)
def test_names_that_lead_elsewhere(tmp_path: Path, name: str) -> None:
    assert "shard.tar holds" in refused(tar_of(member("a.npz"), member(name)), tmp_path)


@pytest.mark.parametrize(
    "kind",
    [tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.CHRTYPE, tarfile.BLKTYPE, tarfile.FIFOTYPE, tarfile.DIRTYPE],
)  # fmt: skip
def test_what_is_no_plain_file(tmp_path: Path, kind: bytes) -> None:
    assert "not a plain file" in refused(tar_of(member("a.npz", kind, linkname="/etc/passwd")), tmp_path)


def test_a_file_with_holes_that_claims_a_terabyte(tmp_path: Path) -> None:
    header = member("a.npz", size=1024, pax_headers={"GNU.sparse.size": str(1 << 40), "GNU.sparse.map": "0,512"})
    assert "not a plain file" in refused(tar_of(header, kind=tarfile.PAX_FORMAT), tmp_path)


def test_an_absurd_size(tmp_path: Path) -> None:
    info = member("a.npz")
    info.size = 1 << 45
    refused(info.tobuf(tarfile.GNU_FORMAT) + bytes(1024), tmp_path)
    info.size = 1 << 20
    assert "unexpected end" in refused(info.tobuf(tarfile.GNU_FORMAT) + bytes(1024), tmp_path)


@pytest.mark.parametrize("mode", ["w:gz", "w:xz", "w:bz2"])
def test_compressed_tars_are_not_unpacked(tmp_path: Path, mode: str) -> None:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode=mode) as tar:
        tar.addfile(member("a.npz", size=1 << 20), io.BytesIO(bytes(1 << 20)))
    refused(buffer.getvalue(), tmp_path)


def zip_of(path: Path, name: str, content: bytes, claimed: int | None = None) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(name, content)
    if claimed is not None:
        data = bytearray(path.read_bytes())
        at = data.index(b"PK\x01\x02")
        data[at + 24 : at + 28] = struct.pack("<I", claimed)
        path.write_bytes(data)
    return path


def first_of(path: Path) -> None:
    with DepthZipReader(path) as reader:
        reader.read(0)


def test_a_zip_bomb(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="are no depth map"):
        first_of(zip_of(tmp_path / "a.zip", "00000.exr", b"", claimed=(1 << 31)))
    with pytest.raises(FormatError, match="damaged"):
        first_of(zip_of(tmp_path / "b.zip", "00000.exr", bytes(1 << 24), claimed=100))


@pytest.mark.parametrize("name", ["../00000.exr", "/00000.exr", "00000.exr/", "a/00000.exr", "00000.EXR", "\u0660.exr"])
def test_names_in_a_zip(tmp_path: Path, name: str) -> None:
    with pytest.raises(FormatError):
        first_of(zip_of(tmp_path / "a.zip", name, encode_depth(np.ones((2, 2), np.float32))))


@pytest.mark.parametrize("last", [100_000, 2**31 - 2, -5])
def test_a_picture_that_claims_more_than_it_holds(last: int) -> None:
    data = bytearray(encode_depth(np.ones((4, 6), np.float32)))
    at = data.index(b"dataWindow\0box2i\0") + len(b"dataWindow\0box2i\0") + 4
    data[at : at + 16] = struct.pack("<4i", 0, 0, last, last)
    with pytest.raises(FormatError):
        decode_depth(bytes(data))


def npz(path: Path, header: bytes, body: bytes = b"") -> Path:
    content = b"\x93NUMPY\x01\0" + struct.pack("<H", len(header)) + header + body
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("data.npy", content)
        archive.writestr("inds.npy", content)
    return path


@pytest.mark.parametrize(
    "header",
    [
        b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000, 4, 4)}\n",
        b"{'descr': '|O', 'fortran_order': False, 'shape': (1,)}\n",
        b"{'descr': '<f8', 'fortran_order': False, 'shape': (-1,)}\n",
        b"__import__('os').system('true')\n",
    ],
    ids=["huge", "objects", "negative", "code"],
)
def test_arrays_that_are_none(tmp_path: Path, header: bytes) -> None:
    with pytest.raises(FormatError, match=r"npz"):
        read_npz(npz(tmp_path / "pose.npz", header, b"\x80\x04K\x01."))


def test_an_array_that_unpacks_to_gigabytes(tmp_path: Path) -> None:
    path = npz(tmp_path / "pose.npz", b"{'descr': '<f8', 'fortran_order': False, 'shape': (1,)}\n", bytes(8))
    data = bytearray(path.read_bytes())
    at = data.index(b"PK\x01\x02")
    data[at + 24 : at + 28] = struct.pack("<I", 0xF0000000)
    path.write_bytes(data)
    with pytest.raises(FormatError, match="no list of frames"):
        read_npz(path)
