"""The tar writer: webdataset's bytes, without its habit of finishing a broken tar."""

from __future__ import annotations

import hashlib
import io
import os
import tarfile
from pathlib import Path

import pytest
import webdataset
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from services.commit import tar_writer
from services.commit.tar_writer import WrittenTar, write_tar
from services.commit.verify import index_tar, verify_tar
from services.domain.errors import IntegrityError


def _files(folder: Path, samples: dict[str, dict[str, bytes]]) -> list[list[tuple[str, Path]]]:
    listed = []
    for key, members in samples.items():
        rows = []
        for extension, data in members.items():
            path = folder / f"{key}.{extension}"
            path.write_bytes(data)
            rows.append((path.name, path))
        listed.append(rows)
    return listed


_KEY = st.text("abz09_-", min_size=1, max_size=12)
_SAMPLES = st.dictionaries(
    _KEY,
    st.dictionaries(st.sampled_from(["npz", "camera.txt", "zip"]), st.binary(max_size=2000), min_size=1),
    min_size=1,
    max_size=5,
)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(samples=_SAMPLES)
def test_the_bytes_are_those_of_the_webdataset_writer(
    tmp_path_factory: pytest.TempPathFactory, samples: dict[str, dict[str, bytes]]
) -> None:
    folder = tmp_path_factory.mktemp("tar")
    samples = {key: dict(sorted(members.items())) for key, members in samples.items()}
    tar = write_tar(folder / "x.tar", _files(folder, samples))

    stream = io.BytesIO()
    with webdataset.TarWriter(stream, encoder=False, mtime=0, user="vipe", group="vipe") as writer:
        for key, members in samples.items():
            writer.write({"__key__": key, **members})
    assert tar.path.read_bytes() == stream.getvalue()
    assert tar.sha256 == hashlib.sha256(stream.getvalue()).hexdigest()
    assert tar.size_bytes == len(stream.getvalue())

    read = [
        {k: v for k, v in sample.items() if not k.startswith("__") or k == "__key__"}
        for sample in webdataset.WebDataset(str(tar.path), shardshuffle=False, empty_check=False)
    ]
    assert read == [{"__key__": key, **members} for key, members in samples.items()]

    data = tar.path.read_bytes()
    for key, members in index_tar(tar.path).items():
        for name, (offset, size) in members.items():
            assert data[offset : offset + size] == samples[key][name[len(key) + 1 :]]


def test_headers_hold_nothing_of_this_machine(tmp_path: Path) -> None:
    tar = write_tar(tmp_path / "x.tar", _files(tmp_path, {"a": {"npz": b"1"}}))
    with tarfile.open(tar.path) as opened:
        (info,) = opened.getmembers()
    assert (info.mtime, info.uid, info.gid, info.uname, info.gname, info.mode) == (0, 0, 0, "vipe", "vipe", 0o444)
    assert info.pax_headers == {}


def test_a_member_above_eight_gib_gets_a_header_that_says_so(tmp_path: Path) -> None:
    size = (8 << 30) + 5
    big = tmp_path / "big.zip"
    big.touch()
    os.truncate(big, size)  # sparse
    written = bytearray()

    class FirstMegabyte(io.RawIOBase):
        def write(self, data: bytes) -> int:
            if len(written) > 1 << 20:
                raise OSError("that is enough")
            written.extend(data)
            return len(data)

    sink = tar_writer._Sink(FirstMegabyte())
    writer = tar_writer._FileTarWriter(sink)
    with pytest.raises(OSError, match="enough"):
        writer.write_member("k.zip", big)
    sink.abandon()
    writer.close()
    with tarfile.open(fileobj=io.BytesIO(written), mode="r|") as opened:
        info = opened.next()
    assert info is not None
    assert (info.name, info.size) == ("k.zip", size)


@pytest.mark.parametrize("fault", ["missing file", "generator raises"])
def test_an_error_in_the_middle_leaves_nothing(tmp_path: Path, fault: str) -> None:
    rows = _files(tmp_path, {"a": {"npz": b"1" * 30_000}, "b": {"npz": b"2"}})

    def samples():
        yield rows[0]
        if fault == "generator raises":
            raise RuntimeError("boom")
        rows[1][0][1].unlink()
        yield rows[1]

    out = tmp_path / "out"
    out.mkdir()
    with pytest.raises((OSError, RuntimeError)):
        write_tar(out / "x.tar", samples())
    assert list(out.iterdir()) == []


def test_a_full_disk_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = _files(tmp_path, {"a": {"npz": b"1"}})
    out = tmp_path / "out"
    out.mkdir()

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        write_tar(out / "x.tar", rows)
    assert list(out.iterdir()) == []


def test_an_existing_tar_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "x.tar").write_bytes(b"keep")
    with pytest.raises(FileExistsError):
        write_tar(tmp_path / "x.tar", [])
    assert (tmp_path / "x.tar").read_bytes() == b"keep"


@pytest.fixture
def tar(tmp_path: Path) -> WrittenTar:
    rows = _files(tmp_path, {"a": {"zip": b"1" * 700}, "b": {"zip": b"2" * 700}})
    return write_tar(tmp_path / "depth.tar", rows)


def test_verification_returns_the_index(tar: WrittenTar) -> None:
    assert verify_tar(tar, "depth", ["a", "b"]) == {"a": {"a.zip": (512, 700)}, "b": {"b.zip": (2048, 700)}}


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(position=st.integers(0, 10_239), bit=st.integers(0, 7))
def test_verification_sees_every_flipped_bit(tar: WrittenTar, position: int, bit: int) -> None:
    good = tar.path.read_bytes()
    bad = bytearray(good)
    bad[position] ^= 1 << bit
    tar.path.write_bytes(bad)
    try:
        with pytest.raises(IntegrityError, match="bytes that were written"):
            verify_tar(tar, "depth", ["a", "b"])
    finally:
        tar.path.write_bytes(good)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(size=st.integers(0, 2747))
def test_an_index_of_a_short_tar_is_refused_or_short(tar: WrittenTar, size: int) -> None:
    good = tar.path.read_bytes()
    tar.path.write_bytes(good[:size])
    try:
        assert list(index_tar(tar.path)) in ([], ["a"])
    except IntegrityError:
        pass
    finally:
        tar.path.write_bytes(good)


@pytest.mark.parametrize("keys", [["b", "a"], ["a"], ["a", "b", "c"]])
def test_verification_wants_the_keys_in_order(tar: WrittenTar, keys: list[str]) -> None:
    with pytest.raises(IntegrityError, match="order"):
        verify_tar(tar, "depth", keys)


def test_verification_wants_the_members_of_the_attribute(tar: WrittenTar) -> None:
    with pytest.raises(IntegrityError, match=r"pose\.tar holds"):
        verify_tar(tar, "pose", ["a", "b"])


@pytest.mark.parametrize(
    ("names", "reason"),
    [
        (["a.npz", "b.npz", "a.json"], "two places"),
        (["a.npz", "a.npz"], "twice"),
        (["../a.npz"], "not a member"),
        (["/a.npz"], "not a member"),
        (["d/a.npz"], "not a member"),
        (["noextension"], "not a member"),
        ([".npz"], "not a member"),
    ],
)
def test_an_index_refuses_what_webdataset_would_misread(tmp_path: Path, names: list[str], reason: str) -> None:
    path = tmp_path / "x.tar"
    with tarfile.open(path, "w") as tar:
        for name in names:
            info = tarfile.TarInfo(name)
            info.size = 1
            tar.addfile(info, io.BytesIO(b"1"))
    with pytest.raises(IntegrityError, match=reason):
        index_tar(path)


def test_an_index_refuses_links_and_what_is_no_tar(tmp_path: Path) -> None:
    path = tmp_path / "x.tar"
    with tarfile.open(path, "w") as tar:
        info = tarfile.TarInfo("a.npz")
        info.type, info.linkname = tarfile.SYMTYPE, "/etc/passwd"
        tar.addfile(info)
    with pytest.raises(IntegrityError, match="not a plain file"):
        index_tar(path)
    path.write_bytes(b"certainly not a tar" * 100)
    with pytest.raises(IntegrityError, match="not a readable tar"):
        index_tar(path)
