"""One shard through the protocol, against real files."""

from __future__ import annotations

import dataclasses
import io
import json
import pickle
import zipfile
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import webdataset
from shard_factory import (
    HEIGHT,
    JOB,
    WIDTH,
    commit_shard,
    depth_of,
    failure,
    make_lease,
    poses_of,
    success,
    write_artifacts,
)

from services.commit import (
    PreparedPayload,
    collect_garbage,
    commit_key,
    committed_record,
    committed_records,
    prepare_payload,
    write_record,
)
from services.commit.layout import MEMBERS, claim_key
from services.domain.errors import CommitConflict, IntegrityError
from services.domain.models import Lease
from services.domain.states import VideoStatus
from services.storage import DirectoryStore
from vipe_core.formats import member_path
from vipe_core.formats.layout import info_path, rig_path

KEYS = ["b-2", "a_1", "c-3"]  # not sorted, as a plan may be


@pytest.fixture
def artifacts(tmp_path: Path) -> Path:
    for key in KEYS:
        write_artifacts(tmp_path / "artifacts", key)
    return tmp_path / "artifacts"


@pytest.fixture
def store(tmp_path: Path) -> DirectoryStore:
    return DirectoryStore(tmp_path / "out")


def _keys(store: DirectoryStore, prefix: str) -> list[str]:
    return [o.key for o in store.list(prefix)]


def test_the_tars_are_what_webdataset_and_vipe_readers_expect(
    store: DirectoryStore, artifacts: Path, tmp_path: Path
) -> None:
    results = [success("a_1"), failure("c-3"), success("b-2")]
    outcome = commit_shard(make_lease(KEYS), results, artifacts, tmp_path / "scratch", store, lambda: True)
    assert outcome.kind == "committed"
    record = outcome.record
    assert record is not None
    assert record == committed_record(store, JOB, record.shard_id)
    assert [(v.key, v.status) for v in record.videos] == [
        ("b-2", VideoStatus.SUCCEEDED),
        ("a_1", VideoStatus.SUCCEEDED),
        ("c-3", VideoStatus.FAILED),
    ]
    assert list((tmp_path / "scratch").iterdir()) == []

    tars = {o.attribute: Path(store.uri) / o.key for o in record.objects}
    assert [o.key for o in record.objects] == [
        f"payload/{record.tar_name}/{a}.tar" for a in ("pose", "intrinsics", "depth", "rgb")
    ]
    read = {
        attribute: list(webdataset.WebDataset(str(path), shardshuffle=False, empty_check=False))
        for attribute, path in tars.items()
    }
    fields = {a: [sorted(k for k in s if not k.startswith("__")) for s in samples] for a, samples in read.items()}
    assert all([s["__key__"] for s in samples] == ["a_1", "b-2"] for samples in read.values())
    assert fields == {
        "pose": [["npz"]] * 2,
        "intrinsics": [["camera.txt", "npz"]] * 2,
        "depth": [["zip"]] * 2,
        "rgb": [["mp4"]] * 2,
    }

    pose = np.load(io.BytesIO(read["pose"][0]["npz"]))
    assert sorted(pose.files) == ["data", "inds"]
    assert (pose["data"].dtype, pose["inds"].dtype) == (np.float32, np.int64)
    np.testing.assert_array_equal(pose["data"], poses_of(3))
    intrinsics = np.load(io.BytesIO(read["intrinsics"][1]["npz"]))
    np.testing.assert_array_equal(intrinsics["data"], np.tile([10, 10, WIDTH / 2, HEIGHT / 2], (3, 1)))
    assert read["intrinsics"][0]["camera.txt"] == b"0: PINHOLE\n1: PINHOLE\n2: PINHOLE\n"
    with zipfile.ZipFile(io.BytesIO(read["depth"][0]["zip"])) as archive:
        assert archive.namelist() == ["00000.exr", "00001.exr", "00002.exr"]
        (tmp_path / "f.exr").write_bytes(archive.read("00001.exr"))
    with OpenEXR.File(str(tmp_path / "f.exr")) as exr:
        assert list(exr.channels()) == ["Z"]
        z = exr.channels()["Z"].pixels
    assert z.dtype == np.float16
    np.testing.assert_array_equal(z, depth_of(1))

    for o in record.objects:
        for sample, members in o.members.items():
            for name, (offset, size) in members.items():
                field = name[len(sample) + 1 :]
                expected = next(s for s in read[o.attribute] if s["__key__"] == sample)[field]
                assert store.get_bytes(o.key, offset, size) == expected


def test_the_info_of_a_sample_travels_with_its_poses(store: DirectoryStore, artifacts: Path, tmp_path: Path) -> None:
    (artifacts / "vipe").mkdir()
    (artifacts / "vipe" / "a_1_info.json").write_text('{"fps": 10}')
    prepared = prepare_payload(make_lease(["a_1"]), [success("a_1")], artifacts, tmp_path / "s", store)
    pose = prepared.record.objects[0]
    assert list(pose.members["a_1"]) == ["a_1.json", "a_1.npz"]
    assert store.get_bytes(pose.key, *pose.members["a_1"]["a_1.json"]) == b'{"fps": 10}'


def test_the_same_artifacts_give_the_same_bytes(store: DirectoryStore, artifacts: Path, tmp_path: Path) -> None:
    results = [success(key) for key in KEYS]
    first = prepare_payload(make_lease(KEYS), results, artifacts, tmp_path / "s1", store).record
    for path in sorted(artifacts.rglob("*")):
        path.touch()
    second = prepare_payload(make_lease(KEYS, attempt=2), results, artifacts, tmp_path / "s2", store).record
    assert [o.sha256 for o in first.objects] == [o.sha256 for o in second.objects]
    assert first.tar_name != second.tar_name


def test_preparing_the_same_attempt_twice_never_shares_a_name(
    store: DirectoryStore, artifacts: Path, tmp_path: Path
) -> None:
    lease = make_lease(["a_1"])
    names = {
        prepare_payload(lease, [success("a_1")], artifacts, tmp_path / "s", store).record.tar_name for _ in range(3)
    }
    assert len(names) == 3
    assert len(_keys(store, "payload/")) == 3 * 4


def test_a_colliding_name_is_left_to_its_owner(store: DirectoryStore, artifacts: Path, tmp_path: Path) -> None:
    lease = make_lease(["a_1"])
    name = prepare_payload(lease, [success("a_1")], artifacts, tmp_path / "s", store).record.tar_name
    other = DirectoryStore(tmp_path / "other")
    other.create(claim_key(str(name)), b'{"job_id": "another", "shard_id": "x"}')
    assert prepare_payload(lease, [success("a_1")], artifacts, tmp_path / "s", other).record.tar_name != name


def test_a_payload_crosses_processes(store: DirectoryStore, artifacts: Path, tmp_path: Path) -> None:
    prepared = prepare_payload(make_lease(["a_1"]), [success("a_1")], artifacts, tmp_path / "s", store)
    assert pickle.loads(pickle.dumps(prepared)) == prepared
    revived = PreparedPayload.from_json(json.loads(json.dumps(prepared.to_json())))
    assert revived == prepared
    assert write_record(store, prepared, lambda: True).kind == "committed"
    assert write_record(store, revived, lambda: True).kind == "committed"
    assert prepared.size_bytes == sum(o.size_bytes for o in store.list("payload/"))


def test_a_shard_whose_videos_all_failed_has_a_record_and_no_payload(store: DirectoryStore, tmp_path: Path) -> None:
    lease = make_lease(["a", "b"])
    results = [failure("a"), failure("b", quarantined=True)]
    outcome = commit_shard(lease, results, tmp_path / "none", tmp_path / "s", store, lambda: True)
    assert outcome.record is not None
    assert (outcome.record.tar_name, outcome.record.objects) == (None, ())
    assert _keys(store, "") == [commit_key(JOB, lease.shard_id)]


@pytest.mark.parametrize(
    "results",
    [
        [success("a_1")],
        [success("a_1"), success("a_1"), success("b-2")],
        [success("a_1"), success("b-2"), success("c-3"), success("d")],
        [success("a_1"), success("b-2"), dataclasses.replace(success("c-3"), status=VideoStatus.PENDING)],
    ],
)
def test_results_must_settle_exactly_the_videos_of_the_lease(
    store: DirectoryStore, artifacts: Path, tmp_path: Path, results: list
) -> None:
    with pytest.raises(IntegrityError, match="shard"):
        prepare_payload(make_lease(KEYS), results, artifacts, tmp_path / "s", store)
    assert _keys(store, "") == []


@pytest.mark.parametrize("key", ["a.b", "a/b", "../a", ""])
def test_a_key_that_webdataset_would_split_is_refused(store: DirectoryStore, tmp_path: Path, key: str) -> None:
    with pytest.raises(IntegrityError, match="webdataset"):
        prepare_payload(make_lease([key]), [success(key)], tmp_path, tmp_path / "s", store)


def test_the_artifacts_are_where_the_engine_puts_them(tmp_path: Path) -> None:
    for attribute, members in MEMBERS.items():
        for member in members:
            ours = {"json": info_path, "rig.json": rig_path}.get(member.extension)
            expected = tmp_path / member_path(attribute, member.name("k")) if ours is None else ours(tmp_path, "k")
            assert member.path(tmp_path, "k") == expected


def test_a_missing_artifact_is_named_and_nothing_is_uploaded(
    store: DirectoryStore, artifacts: Path, tmp_path: Path
) -> None:
    (artifacts / "depth" / "b-2.zip").unlink()
    with pytest.raises(IntegrityError, match=r"depth artifact of video b-2 .* b-2\.zip"):
        prepare_payload(make_lease(KEYS), [success(k) for k in KEYS], artifacts, tmp_path / "s", store)
    assert _keys(store, "") == []
    assert list((tmp_path / "s").iterdir()) == []


def _race(store: DirectoryStore, artifacts: Path, tmp_path: Path, loser: Lease) -> tuple[PreparedPayload, ...]:
    first = prepare_payload(make_lease(["a_1"]), [success("a_1")], artifacts, tmp_path / "s", store)
    second = prepare_payload(loser, [success("a_1")], artifacts, tmp_path / "s", store)
    assert write_record(store, first, lambda: True).kind == "committed"
    return first, second


def test_the_loser_adopts_the_winner_and_clears_its_payload(
    store: DirectoryStore, artifacts: Path, tmp_path: Path
) -> None:
    first, second = _race(store, artifacts, tmp_path, make_lease(["a_1"], attempt=2))
    outcome = write_record(store, second, lambda: True)
    assert (outcome.kind, outcome.record) == ("adopted", first.record)
    assert _keys(store, "payload/") == sorted(o.key for o in first.record.objects)
    assert [r.attempt for r in committed_records(store, JOB)] == [1]


def test_without_the_lease_nothing_is_written(store: DirectoryStore, artifacts: Path, tmp_path: Path) -> None:
    prepared = prepare_payload(make_lease(["a_1"]), [success("a_1")], artifacts, tmp_path / "s", store)
    outcome = write_record(store, prepared, lambda: False)
    assert (outcome.kind, outcome.record) == ("lost_lease", None)
    assert _keys(store, "_commits/") == []


def test_losing_the_lease_after_an_unnoticed_commit_is_still_success(
    store: DirectoryStore, artifacts: Path, tmp_path: Path
) -> None:
    prepared = prepare_payload(make_lease(["a_1"]), [success("a_1")], artifacts, tmp_path / "s", store)
    store.create(commit_key(JOB, prepared.record.shard_id), prepared.record.to_bytes())
    assert write_record(store, prepared, lambda: False).kind == "committed"
    assert len(_keys(store, "payload/")) == 4


def test_another_plan_under_this_name_is_a_conflict(store: DirectoryStore, artifacts: Path, tmp_path: Path) -> None:
    changed = dataclasses.replace(make_lease(["a_1"], attempt=2), plan_hash="0" * 64)
    first, second = _race(store, artifacts, tmp_path, changed)
    with pytest.raises(CommitConflict, match="another plan"):
        write_record(store, second, lambda: True)
    assert _keys(store, "payload/") == sorted(o.key for o in first.record.objects)


@pytest.mark.parametrize("data", [b"", b"{}", b"[1]", b'{"schema_version": 1}', b"\xff"])
def test_a_damaged_record_is_an_integrity_error(
    store: DirectoryStore, artifacts: Path, tmp_path: Path, data: bytes
) -> None:
    prepared = prepare_payload(make_lease(["a_1"]), [success("a_1")], artifacts, tmp_path / "s", store)
    store.create(commit_key(JOB, prepared.record.shard_id), data)
    with pytest.raises(IntegrityError, match="damaged"):
        write_record(store, prepared, lambda: True)
    with pytest.raises(IntegrityError, match="damaged"):
        list(committed_records(store, JOB))


def test_a_record_under_another_name_is_an_integrity_error(
    store: DirectoryStore, artifacts: Path, tmp_path: Path
) -> None:
    prepared = prepare_payload(make_lease(["a_1"]), [success("a_1")], artifacts, tmp_path / "s", store)
    store.create(commit_key(JOB, "other-000001"), prepared.record.to_bytes())
    with pytest.raises(IntegrityError, match="not of its name"):
        list(committed_records(store, JOB))


def test_records_come_in_shard_order_and_only_of_their_job(
    store: DirectoryStore, artifacts: Path, tmp_path: Path
) -> None:
    for ordinal in (2, 0, 1):
        lease = make_lease(["a_1"], ordinal=ordinal)
        commit_shard(lease, [success("a_1")], artifacts, tmp_path / "s", store, lambda: True)
    assert [r.ordinal for r in committed_records(store, JOB)] == [0, 1, 2]
    assert list(committed_records(store, JOB[:-1])) == []
    assert committed_record(store, JOB, "nothing") is None


def test_garbage_collection_keeps_what_counts_and_what_may_still_count(
    store: DirectoryStore, artifacts: Path, tmp_path: Path
) -> None:
    results = [success("a_1")]
    scratch = tmp_path / "s"
    crashed = prepare_payload(make_lease(["a_1"]), results, artifacts, scratch, store).record
    winner = commit_shard(make_lease(["a_1"], attempt=2), results, artifacts, scratch, store, lambda: True).record
    running = prepare_payload(make_lease(["a_1"], ordinal=1), results, artifacts, scratch, store).record
    stranger = dataclasses.replace(make_lease(["a_1"], ordinal=0), job_id="job_other", shard_id="job_other-000000")
    foreign = prepare_payload(stranger, results, artifacts, scratch, store).record
    store.put_bytes("payload/unclaimed/pose.tar", b"somebody's")

    report = collect_garbage(store, JOB)
    assert set(report.deleted) == {o.key for o in crashed.objects}
    assert report.deleted_bytes == sum(o.size_bytes for o in crashed.objects)
    assert report.kept_unsettled == (running.tar_name,)
    assert winner is not None
    left = {o.key for r in (winner, running, foreign) for o in r.objects} | {"payload/unclaimed/pose.tar"}
    assert set(_keys(store, "payload/")) == left
    assert collect_garbage(store, JOB).deleted == ()

    assert set(collect_garbage(store, JOB, abandoned=True).deleted) == {o.key for o in running.objects}
    assert set(_keys(store, "payload/")) == left - {o.key for o in running.objects}
