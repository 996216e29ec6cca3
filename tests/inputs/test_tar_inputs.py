"""Videos in tars: listed by the headers, fetched by their bytes alone, on a disk and in S3."""

from __future__ import annotations

import io
import tarfile
from pathlib import Path

import boto3
import pytest

from services.domain.errors import InputTooLarge, InputUnavailable
from services.domain.models import VideoRef
from services.inputs.fetching import fetched
from services.inputs.rules import InputRules
from services.inputs.tars import Member, as_member
from services.planner.listing import expand

CLIPS = {"indoor/a.mp4": b"first" * 300, "b.webm": b"second" * 500, "long" * 40 + "/c.mov": b"third"}


def write_tar(path: Path, contents: dict[str, bytes], *, form: int = tarfile.PAX_FORMAT) -> Path:
    with tarfile.open(path, "w", format=form) as tar:
        folder = tarfile.TarInfo("indoor")
        folder.type = tarfile.DIRTYPE
        tar.addfile(folder)
        for name, data in contents.items():
            info = tarfile.TarInfo(name)
            info.size = len(data)
            tar.addfile(info, io.BytesIO(data))
            note = tarfile.TarInfo(str(Path(name).with_suffix(".json")))
            note.size = 2
            tar.addfile(note, io.BytesIO(b"{}"))
        link = tarfile.TarInfo("link.mp4")
        link.type, link.linkname = tarfile.SYMTYPE, "/etc/passwd"
        tar.addfile(link)
    return path


def fetch(uri: str, size_bytes: int, folder: Path, rules: InputRules | None = None, **others: str) -> bytes:
    ref = VideoRef("key", uri, size_bytes, others.pop("etag", None))
    where = folder / "fetched"
    with fetched(ref, rules or InputRules(), lambda suffix: where.with_suffix(suffix), **others) as local:
        assert local.path.suffix == Path(as_member(uri).name).suffix
        data = local.path.read_bytes()
    assert not local.path.exists()
    return data


@pytest.mark.parametrize("form", [tarfile.USTAR_FORMAT, tarfile.GNU_FORMAT, tarfile.PAX_FORMAT])
def test_every_video_of_a_tar_is_an_input(tmp_path: Path, form: int) -> None:
    clips = {"a" * 90 + "/c.mov" if form == tarfile.USTAR_FORMAT and len(k) > 99 else k: v for k, v in CLIPS.items()}
    tar = write_tar(tmp_path / "clips.tar", clips, form=form)
    found = list(expand(str(tar)))
    assert [as_member(video.uri).name for video in found] == list(clips)
    assert [video.size_bytes for video in found] == [len(data) for data in clips.values()]
    assert [fetch(v.uri, v.size_bytes, tmp_path) for v in found] == list(clips.values())


def test_tars_below_a_directory_count_and_one_that_is_broken_fails_alone(tmp_path: Path) -> None:
    folder = tmp_path / "in"
    folder.mkdir()
    (folder / "a.mp4").write_bytes(b"alone")
    whole = write_tar(folder / "b.tar", CLIPS).read_bytes()
    (folder / "c.tar").write_bytes(whole[:700])
    (folder / "d.txt").write_text("no video")
    uris = [video.uri for video in expand(str(folder))]
    assert uris[0] == str(folder / "a.mp4")
    assert [uri.partition("!")[0] for uri in uris[1:4]] == [str(folder / "b.tar")] * 3
    assert uris[4:] == [str(folder / "c.tar")]
    broken = VideoRef("key", uris[4], 700)
    with pytest.raises(InputUnavailable, match="not a readable tar"), fetched(broken, InputRules(), lambda _: tmp_path):
        pass


def test_a_row_may_leave_out_the_place(tmp_path: Path) -> None:
    tar = write_tar(tmp_path / "clips.tar", CLIPS)
    rows = tmp_path / "rows.csv"
    rows.write_text(f"uri\n{tar}!/b.webm\n{tar}!/missing.mp4\n")
    there, missing = expand(str(rows))
    assert fetch(there.uri, there.size_bytes, tmp_path) == CLIPS["b.webm"]
    with pytest.raises(InputUnavailable, match=r"no missing\.mp4 in"):
        fetch(missing.uri, missing.size_bytes, tmp_path)


def test_what_cannot_be_is_refused(tmp_path: Path) -> None:
    empty = write_tar(tmp_path / "empty.tar", {})
    with pytest.raises(InputUnavailable, match="no videos found"):
        list(expand(str(empty)))
    (tmp_path / "zipped.tar").write_bytes(b"\x1f\x8b" + bytes(2000))
    with pytest.raises(InputUnavailable, match="compressed tars are not read"):
        list(expand(str(tmp_path / "zipped.tar")))
    tar = write_tar(tmp_path / "clips.tar", CLIPS)
    first = next(expand(str(tar)))
    with pytest.raises(InputTooLarge):
        fetch(first.uri, first.size_bytes, tmp_path, InputRules(max_file_bytes=100))
    with pytest.raises(InputUnavailable, match="outside"):
        fetch(first.uri, first.size_bytes, tmp_path, InputRules(roots=(tmp_path / "elsewhere",)))
    tar.write_bytes(tar.read_bytes()[:1200])
    with pytest.raises(InputUnavailable, match="ends before"):
        fetch(first.uri, first.size_bytes, tmp_path)


def test_addresses_are_read_back() -> None:
    for member in (
        Member("s3://b/x.tar", "a/b #2.mp4", 512),
        Member("/x.tar", "c!.mp4"),
        Member("/x.tar", "d#e.mp4", 0),
    ):
        assert as_member(member.uri) == member
    assert as_member("s3://b/x.tar") is None


def test_a_tar_in_s3_is_read_in_parts(tmp_path: Path, s3_endpoint: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.setenv(name, "test")
    tar = write_tar(tmp_path / "clips.tar", {**CLIPS, "big.mp4": bytes(3 << 20)})
    client = boto3.client("s3", endpoint_url=s3_endpoint)
    client.create_bucket(Bucket="tars")
    client.upload_file(str(tar), "tars", "in/clips.tar")
    found = list(expand("s3://tars/in/", s3_endpoint_url=s3_endpoint))
    assert len(found) == 4
    second = found[1]
    assert second.etag
    got = fetch(second.uri, second.size_bytes, tmp_path, etag=second.etag, s3_endpoint_url=s3_endpoint)
    assert got == CLIPS["b.webm"]
    client.put_object(Bucket="tars", Key="in/clips.tar", Body=b"another")
    with pytest.raises(InputUnavailable, match="not what it was"):
        fetch(second.uri, second.size_bytes, tmp_path, etag=second.etag, s3_endpoint_url=s3_endpoint)
