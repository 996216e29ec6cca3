"""Shards to directories and nothing outside of them."""

from __future__ import annotations

import io
import tarfile
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from shard_factory import ATTRIBUTES, JOB, commit_shard, make_lease, success, write_artifacts

from services.dataset import finalise, unpack
from services.domain.errors import IntegrityError, ObjectMissing
from services.domain.models import JobSpec, VideoResult
from services.storage import DirectoryStore, ObjectStore


def _tree(root: Path) -> dict[str, bytes]:
    return {str(p.relative_to(root)): p.read_bytes() for p in sorted(root.rglob("*")) if p.is_file()}


def test_unpacking_gives_back_the_artifacts(any_finished: ObjectStore, tmp_path: Path) -> None:
    result = unpack(any_finished, tmp_path / "u")
    assert _tree(tmp_path / "u") == _tree(tmp_path / "artifacts")
    assert (result.files, result.size_bytes) == (18, sum(map(len, _tree(tmp_path / "u").values())))
    assert unpack(any_finished, tmp_path / "u").files == 18  # again, over what is there


def test_some_sequences_come_by_ranges(any_finished: ObjectStore, tmp_path: Path) -> None:
    result = unpack(any_finished, tmp_path / "u", ["cat-1"])
    expected = {path: data for path, data in _tree(tmp_path / "artifacts").items() if "cat-1" in path}
    assert _tree(tmp_path / "u") == expected
    assert result.names == {"cat-1": "cat-1"}
    assert len(_tree(tmp_path / "u")) == 6


def test_attributes_can_be_chosen(finished: DirectoryStore, tmp_path: Path) -> None:
    unpack(finished.uri, tmp_path / "u", attributes=["depth"])
    assert sorted(_tree(tmp_path / "u")) == ["depth/ant-2.zip", "depth/cat-1.zip", "depth/dog-3.zip"]
    with pytest.raises(ObjectMissing, match="mask"):
        unpack(finished, tmp_path / "u", attributes=["mask"])


def test_an_unknown_sequence_is_named_before_anything_is_written(finished: DirectoryStore, tmp_path: Path) -> None:
    with pytest.raises(ObjectMissing, match="bad-1"):
        unpack(finished, tmp_path / "u", ["cat-1", "bad-1"])
    assert not (tmp_path / "u").exists()


def test_stems_are_used_where_they_are_free(tmp_path: Path) -> None:
    store = DirectoryStore(tmp_path / "out")
    uris = {"clip-1": "/a/My Clip.mp4", "x-2": "s3://b/x.mp4", "x-3": "/c/X.mov"}
    results = []
    for key, uri in uris.items():
        write_artifacts(tmp_path / "a", key)
        results.append(VideoResult(**{**_fields(success(key)), "uri": uri}))
    commit_shard(make_lease(list(uris)), results, tmp_path / "a", tmp_path / "s", store, lambda: True)
    finalise(store, JOB, JobSpec(inputs=("/in",), output="/out", attributes=ATTRIBUTES), num_shards=1)
    result = unpack(store, tmp_path / "u", names="stem")
    assert result.names == {"clip-1": "My-Clip", "x-2": "x-2", "x-3": "x-3"}
    assert (tmp_path / "u" / "intrinsics" / "My-Clip_camera.txt").is_file()


def _fields(result: VideoResult) -> dict:
    return {name: getattr(result, name) for name in result.__slots__}


@pytest.mark.parametrize(
    "name", ["../../evil.npz", "/tmp/evil.npz", "d/cat-1.npz", "cat-1.exe", "cat-1", "..\\cat-1.npz", "link"]
)
def test_a_hostile_tar_writes_nothing_outside(tmp_path: Path, name: str) -> None:
    root = tmp_path / "hub"
    for attribute in ("pose", "intrinsics"):
        path = root / "payload" / "x-00000000" / f"{attribute}.tar"
        path.parent.mkdir(parents=True, exist_ok=True)
        with tarfile.open(path, "w") as tar:
            info = tarfile.TarInfo("cat-1.npz" if name == "link" else name)
            if name == "link":
                info.type, info.linkname = tarfile.SYMTYPE, "/etc/passwd"
                tar.addfile(info)
            else:
                info.size = 3
                tar.addfile(info, io.BytesIO(b"bad"))
    pq.write_table(
        pa.table({"sequence": ["cat-1"], "num_frames": [1], "tar_name": ["x-00000000"]}), root / "meta.parquet"
    )
    for keys in (None, ["cat-1"]):
        with pytest.raises(IntegrityError, match=r"does not belong|not a member|not a plain file"):
            unpack(DirectoryStore(root), tmp_path / "u", keys)
    assert not (tmp_path / "u").exists() or _tree(tmp_path / "u") == {}
    assert not list(tmp_path.glob("evil*"))


@pytest.mark.parametrize(("column", "error"), [("sequence", IntegrityError), ("tar_name", ObjectMissing)])
def test_a_hostile_index_is_refused(tmp_path: Path, column: str, error: type[Exception]) -> None:
    root = tmp_path / "hub"
    root.mkdir()
    row = {"sequence": ["k"], "num_frames": [1], "tar_name": ["x-0"]} | {column: ["../../evil"]}
    pq.write_table(pa.table(row), root / "meta.parquet")
    with pytest.raises(error, match="evil"):
        unpack(DirectoryStore(root), tmp_path / "u")
    assert not list(tmp_path.rglob("evil*"))


@pytest.mark.parametrize("keys", [None, ["dog-3"]])
def test_a_missing_payload_is_not_an_empty_success(
    finished: DirectoryStore, tmp_path: Path, keys: list[str] | None
) -> None:
    for info in list(finished.list("payload/")):
        finished.delete(info.key)
    with pytest.raises(ObjectMissing, match="no tars of vipe-"):
        unpack(finished, tmp_path / "u", keys)


def test_a_sample_that_a_tar_lacks_is_missed(finished: DirectoryStore, tmp_path: Path) -> None:
    names = {o.key.split("/")[1]: o.key for o in finished.list("payload/") if o.key.endswith("depth.tar")}
    first, second = names.values()
    finished.put_bytes(first, finished.get_bytes(second))
    with pytest.raises(IntegrityError, match="does not hold"):
        unpack(finished, tmp_path / "u")


def test_an_output_that_is_not_finalised_cannot_be_unpacked(committed: DirectoryStore, tmp_path: Path) -> None:
    with pytest.raises(ObjectMissing, match=r"meta\.parquet"):
        unpack(committed, tmp_path / "u")
