"""The index, the list of failures, the description and the card."""

from __future__ import annotations

import dataclasses
import io
import json
from pathlib import Path

import pyarrow.parquet as pq
import pytest
import yaml
from shard_factory import ATTRIBUTES, JOB, commit_shard, failure, make_lease, success, write_artifacts

from services.commit import committed_records, publish_plan
from services.dataset import finalise, iterate, read_one, verify
from services.dataset.schema import meta_schema, public_spec, public_uri
from services.domain.errors import IntegrityError
from services.domain.models import JobSpec, PlannedShard, VideoResult
from services.storage import DirectoryStore, ObjectStore

SPEC = JobSpec(inputs=("/in",), output="/out", attributes=ATTRIBUTES, name='Three "animals"')


def _table(store: ObjectStore, key: str):
    return pq.read_table(io.BytesIO(store.get_bytes(key)))


def test_the_index_starts_with_the_published_columns_and_finds_every_member(any_finished: ObjectStore) -> None:
    table = _table(any_finished, "meta.parquet")
    assert table.column_names[:3] == ["sequence", "num_frames", "tar_name"]
    rows = {r["sequence"]: r for r in table.to_pylist()}
    assert {k: r["num_frames"] for k, r in rows.items()} == {"cat-1": 3, "ant-2": 2, "dog-3": 4}
    assert rows["cat-1"]["tar_name"] == rows["ant-2"]["tar_name"] != rows["dog-3"]["tar_name"]
    cat = rows["cat-1"]
    assert (cat["fx"], cat["cx"], cat["alpha"], cat["fov_x_deg"]) == (10.0, 8.0, None, 77.3)
    assert (cat["reliable"], cat["reasons"], cat["inlier_ratio"]) == ("doubtful", ["few_keyframes"], None)
    assert json.loads(cat["provenance_json"])["preset"] == cat["preset"] == "classical"
    for row in rows.values():
        for stem, attribute, magic in (
            ("pose", "pose", b"PK\x03\x04"),
            ("pose_json", "pose", b"{"),
            ("intrinsics", "intrinsics", b"PK\x03\x04"),
            ("intrinsics_camera_txt", "intrinsics", b"0: PINHOLE"),
            ("depth", "depth", b"PK\x03\x04"),
            ("rgb", "rgb", b""),
        ):
            key = f"payload/{row['tar_name']}/{attribute}.tar"
            data = any_finished.get_bytes(key, row[f"{stem}_offset"], row[f"{stem}_size"])
            assert len(data) == row[f"{stem}_size"]
            assert data.startswith(magic)
    assert "mask_offset" not in table.column_names


def test_failures_are_listed_with_their_codes(finished: DirectoryStore) -> None:
    rows = _table(finished, "failures.parquet").to_pylist()
    assert [(r["sequence"], r["status"], r["error_code"], r["attempt"]) for r in rows] == [
        ("bad-1", "failed", "media_corrupt", 1),
        ("bad-2", "failed", "media_corrupt", 1),
        ("poison-3", "quarantined", "worker_died", 1),
    ]
    assert all(r["uri"] in r["error_message"] for r in rows)


def test_the_description_names_every_tar_with_its_sum(finished: DirectoryStore) -> None:
    described = json.loads(finished.get_bytes("dataset.json"))
    totals = described["totals"]
    assert {k: totals[k] for k in ("shards", "videos", "succeeded", "failed", "quarantined", "frames", "objects")} == {
        "shards": 3,
        "videos": 6,
        "succeeded": 3,
        "failed": 2,
        "quarantined": 1,
        "frames": 9,
        "objects": 8,
    }
    records = list(committed_records(finished, JOB))
    assert [s["shard_id"] for s in described["shards"]] == [r.shard_id for r in records]
    assert [[o["sha256"] for o in s["objects"]] for s in described["shards"]] == [
        [o.sha256 for o in r.objects] for r in records
    ]
    assert (described["job_id"], described["schema_version"], described["spec"]["preset"]) == (JOB, 1, "classical")


def test_the_card_has_front_matter_and_the_figures(finished: DirectoryStore) -> None:
    _, front, text = finished.get_bytes("README.md").decode().split("---\n", 2)
    matter = yaml.safe_load(front)
    assert matter["pretty_name"] == "Three animals"
    assert matter["size_categories"] == ["n<1K"]
    assert "| Annotated | 3 |" in text
    assert "mask.tar" not in text
    assert "depth.tar" in text


def test_finalising_again_gives_the_same_bytes(finished: DirectoryStore) -> None:
    before = {o.key: finished.get_bytes(o.key) for o in finished.list()}
    finalise(finished, JOB, SPEC, num_shards=3, num_videos=6)
    assert {o.key: finished.get_bytes(o.key) for o in finished.list()} == before


def test_a_job_without_any_success_still_has_all_four_files(tmp_path: Path) -> None:
    from shard_factory import failure

    store = DirectoryStore(tmp_path / "out")
    commit_shard(make_lease(["x"]), [failure("x")], tmp_path, tmp_path / "s", store, lambda: True)
    totals = finalise(store, JOB, SPEC, num_shards=1, num_videos=1)
    assert (totals.succeeded, totals.failed, totals.objects) == (0, 1, 0)
    assert _table(store, "meta.parquet").schema.equals(meta_schema(SPEC))
    assert _table(store, "meta.parquet").num_rows == 0
    assert _table(store, "failures.parquet").num_rows == 1


def test_an_empty_list_of_failures_is_written(tmp_path: Path) -> None:
    from shard_factory import write_artifacts

    store = DirectoryStore(tmp_path / "out")
    write_artifacts(tmp_path / "a", "k")
    commit_shard(make_lease(["k"]), [success("k")], tmp_path / "a", tmp_path / "s", store, lambda: True)
    finalise(store, JOB, SPEC, num_shards=1)
    assert _table(store, "failures.parquet").num_rows == 0
    (row,) = _table(store, "meta.parquet").to_pylist()
    assert row["pose_json_offset"] is None  # an engine that wrote no info


@pytest.mark.parametrize(("num_shards", "num_videos"), [(4, 6), (2, 6), (3, 5), (3, 7)])
def test_what_is_not_complete_is_not_described(committed: DirectoryStore, num_shards: int, num_videos: int) -> None:
    with pytest.raises(IntegrityError):
        finalise(committed, JOB, SPEC, num_shards=num_shards, num_videos=num_videos)
    assert [o.key for o in committed.list() if "/" not in o.key] == ["_job.json"]


def test_a_video_in_two_shards_is_refused(committed: DirectoryStore, tmp_path: Path) -> None:
    lease = make_lease(["dog-3"], ordinal=3)
    commit_shard(lease, [success("dog-3", 4)], tmp_path / "artifacts", tmp_path / "s", committed, lambda: True)
    with pytest.raises(IntegrityError, match="dog-3 occurs twice"):
        finalise(committed, JOB, SPEC, num_shards=4)


def test_a_gap_in_the_shards_is_refused(tmp_path: Path, committed: DirectoryStore) -> None:
    (first, *_) = committed.list("_commits/")
    committed.delete(first.key)
    with pytest.raises(IntegrityError, match="not complete"):
        finalise(committed, JOB, SPEC, num_shards=2)


@pytest.mark.parametrize("damage", ["delete", "shorten"])
def test_a_payload_that_is_not_there_is_refused(committed: DirectoryStore, damage: str) -> None:
    key = next(o.key for o in committed.list("payload/"))
    if damage == "delete":
        committed.delete(key)
    else:
        committed.put_bytes(key, committed.get_bytes(key)[:-512])
    with pytest.raises(IntegrityError, match=key):
        finalise(committed, JOB, SPEC, num_shards=3)


@pytest.mark.parametrize(
    ("uri", "public"),
    [
        ("/a/b?c.mp4", "/a/b?c.mp4"),
        ("s3://bucket/a?b.mp4", "s3://bucket/a?b.mp4"),
        ("s3://key:secret@bucket/a", "s3://bucket/a"),
        ("https://u:p@host:1/a.mp4?X-Amz-Signature=1", "https://host:1/a.mp4"),
    ],
)
def test_addresses_are_published_without_secrets(uri: str, public: str) -> None:
    assert public_uri(uri) == public
    spec = dataclasses.replace(SPEC, inputs=(uri,))
    assert public_spec(spec)["inputs"] == [public]


class TestRetries:
    """A later retry's row takes the place of a failure, and of nothing else."""

    @pytest.fixture
    def retried(self, finished: DirectoryStore, engine_output: Path, tmp_path: Path) -> DirectoryStore:
        """`bad-1` succeeds at last, `poison-3` fails again in another way, `bad-2` was not tried again."""
        artifacts = tmp_path / "more"
        write_artifacts(artifacts, "bad-1", 2, info=True)
        for ordinal, result in ((3, success("bad-1", 2)), (4, failure("poison-3"))):
            lease = dataclasses.replace(make_lease([result.key], ordinal=ordinal), retry=1)
            planned = PlannedShard(ordinal, lease.plan_hash, (result.key,))
            publish_plan(finished, JOB, SPEC.config_hash, lambda first, planned=planned: [planned], ordinal + 1)
            commit_shard(lease, [result], artifacts, tmp_path / "s", finished, lambda: True)
        return finished

    def test_every_video_is_counted_once_with_its_last_outcome(self, retried: DirectoryStore) -> None:
        totals = finalise(retried, JOB, SPEC, num_shards=5, num_videos=6)
        assert (totals.videos, totals.succeeded, totals.failed, totals.quarantined) == (6, 4, 2, 0)
        assert (totals.shards, totals.superseded) == (5, 2)
        assert sorted(_table(retried, "meta.parquet")["sequence"].to_pylist()) == ["ant-2", "bad-1", "cat-1", "dog-3"]
        rows = _table(retried, "failures.parquet").to_pylist()
        assert [(r["sequence"], r["status"], r["shard_id"][-1]) for r in rows] == [
            ("bad-2", "failed", "1"),
            ("poison-3", "failed", "4"),
        ]
        report = verify(retried, deep=True)
        assert report.ok, report.problems
        assert report.totals == totals
        assert read_one(retried, "bad-1").num_frames == 2
        assert {sample.key for sample in iterate(retried)} == {"ant-2", "bad-1", "cat-1", "dog-3"}

    def test_until_it_is_finalised_again_the_records_are_ahead_of_the_index(self, retried: DirectoryStore) -> None:
        report = verify(retried)
        assert report.ok, report.problems
        assert not report.finished
        assert (report.totals.videos, report.planned_videos, report.totals.superseded) == (6, 6, 2)

    @pytest.mark.parametrize(
        ("result", "retry"),
        [
            (success("cat-1"), 1),  # a second success
            (failure("cat-1"), 1),  # a failure of what had succeeded
            (failure("bad-1"), 0),  # twice in one plan
        ],
        ids=["second success", "failure of a success", "same retry"],
    )
    def test_what_is_no_retry_is_found(
        self, finished: DirectoryStore, engine_output: Path, tmp_path: Path, result: VideoResult, retry: int
    ) -> None:
        lease = dataclasses.replace(make_lease([result.key], ordinal=3), retry=retry)
        commit_shard(lease, [result], engine_output, tmp_path / "s", finished, lambda: True)
        with pytest.raises(IntegrityError, match=f"video {result.key} occurs twice"):
            finalise(finished, JOB, SPEC, num_shards=4, num_videos=6)
        assert any(f"video {result.key} occurs twice" in problem for problem in verify(finished).problems)

    def test_a_data_set_from_before_there_were_retries_is_whole(self, finished: DirectoryStore) -> None:
        described = json.loads(finished.get_bytes("dataset.json"))
        del described["totals"]["superseded"]
        finished.put_bytes("dataset.json", json.dumps(described).encode())
        assert verify(finished).ok
