"""Verification finds every kind of damage that we can make."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from shard_factory import ATTRIBUTES, JOB, make_lease

from services.commit import publish_plan, stored_records
from services.dataset import finalise, verify
from services.domain.models import CommitRecord, JobSpec, PlannedShard, ShardDigest
from services.domain.states import ShardState
from services.storage import DirectoryStore, ObjectStore

SPEC = JobSpec(inputs=("/in",), output="/out", attributes=ATTRIBUTES, name='Three "animals"')


def _flip(position: int) -> Callable[[bytes], bytes]:
    return lambda data: data[:position] + bytes([data[position] ^ 1]) + data[position + 1 :]


def _edit_table(change: Callable[[list[dict]], list[dict]]) -> Callable[[bytes], bytes]:
    def edit(data: bytes) -> bytes:
        table = pq.read_table(io.BytesIO(data))
        out = io.BytesIO()
        pq.write_table(pa.Table.from_pylist(change(table.to_pylist()), schema=table.schema), out)
        return out.getvalue()

    return edit


def _edit_json(change: Callable[[dict], object]) -> Callable[[bytes], bytes]:
    def edit(data: bytes) -> bytes:
        described = json.loads(data)
        change(described)
        return json.dumps(described).encode()

    return edit


@pytest.mark.parametrize("deep", [False, True])
def test_a_whole_data_set_is_whole(any_finished: ObjectStore, deep: bool) -> None:
    report = verify(any_finished, deep=deep)
    assert report.problems == []
    assert (report.ok, report.exit_code, report.job_id, report.orphans) == (True, 0, JOB, 0)
    totals = report.totals
    assert totals.videos == totals.succeeded + totals.failed + totals.quarantined == 6
    assert report.checked_bytes == (totals.size_bytes if deep else 0)
    json.dumps(report.to_json())


def test_an_address_will_do(finished: DirectoryStore) -> None:
    assert verify(finished.uri).ok


def test_a_job_that_runs_is_checked_as_far_as_it_is(committed: DirectoryStore) -> None:
    report = verify(committed)
    assert (report.exit_code, report.state, report.problems) == (3, "running", [])
    committed.delete(_first(committed, "_commits/"))
    report = verify(committed)
    assert (report.exit_code, report.totals.shards, report.planned_shards, report.planned_videos) == (3, 2, 3, 6)
    referenced = [o.key for record, _ in stored_records(committed, JOB) for o in record.objects]
    committed.delete(referenced[0])
    report = verify(committed)
    assert (report.exit_code, report.state) == (1, "damaged")
    assert f"{referenced[0]} is missing" in report.problems[0]


def test_what_no_job_wrote_is_no_output(tmp_path: Path) -> None:
    report = verify(DirectoryStore(tmp_path))
    assert report.exit_code == 1
    assert report.problems == ["dataset.json and _job.json are missing: this is not the output of a job"]


def _forged(change: Callable[[dict], object]) -> Callable[[bytes], bytes]:
    def forge(data: bytes) -> bytes:
        record = json.loads(data)
        change(record)
        return CommitRecord.from_bytes(json.dumps(record).encode()).to_bytes()

    return forge


FORGERIES = {
    "another plan": (lambda r: r.update(plan_hash="0" * 64), "was made from another plan"),
    "another number": (lambda r: r.update(ordinal=7), "says that it is number 7"),
    "a video that was not planned": (lambda r: r["videos"][0].update(key="cat-9"), "other videos than were planned"),
    "videos in another order": (lambda r: r["videos"].reverse(), "other videos than were planned"),
    "a row that says something else": (lambda r: r["videos"][0].update(fov_x_deg=1.0), "dataset.json says"),
    "a failure that is called a success": (
        lambda r: r["videos"][1].update(status="succeeded", num_frames=3),
        "dataset.json says",
    ),
    "another sha256": (lambda r: r["objects"][0].update(sha256="0" * 64), "dataset.json says"),
}


@pytest.mark.parametrize("name", FORGERIES)
def test_a_forged_record_contradicts_the_plan_or_the_index(
    finished: DirectoryStore, rewrite: Callable[[str, Callable[[bytes], bytes]], None], name: str
) -> None:
    change, expected = FORGERIES[name]
    rewrite(_first(finished, "_commits/"), _forged(change))
    report = verify(finished)
    assert report.exit_code == 1
    assert any(expected in problem for problem in report.problems), report.problems


def test_an_invented_shard_is_found(finished: DirectoryStore) -> None:
    record = json.loads(finished.get_bytes(_first(finished, "_commits/")))
    record.update(shard_id=f"{JOB}-000003", ordinal=3, objects=[], tar_name=None, videos=[])
    finished.create(f"_commits/{JOB}/{JOB}-000003.json", json.dumps(record).encode())
    assert any("of no planned shard" in problem for problem in verify(finished).problems)


@pytest.mark.parametrize(
    ("how", "expected"),
    [
        (_edit_json(lambda page: page["shards"].pop()), "not the one that dataset.json was made from"),
        (_edit_json(lambda page: page["shards"].pop(0)), "does not follow"),
        (_edit_json(lambda page: page.update(previous="0" * 64)), "does not follow"),
        (_edit_json(lambda page: page.update(job_id="job_other")), "does not follow"),
        (lambda data: data[:-5], "damaged"),
    ],
)
def test_a_plan_that_was_changed_is_found(
    finished: DirectoryStore,
    rewrite: Callable[[str, Callable[[bytes], bytes]], None],
    how: Callable[[bytes], bytes],
    expected: str,
) -> None:
    rewrite("_plan/000000.json", how)
    assert any(expected in problem for problem in verify(finished).problems)


def test_who_forges_everything_is_betrayed_by_the_database_only(finished: DirectoryStore) -> None:
    """The record, and the index made anew from it: the output agrees with itself."""
    genuine = {
        record.shard_id: ShardDigest(record.shard_id, record.ordinal, ShardState.COMMITTED, record.plan_hash, digest)
        for record, digest in stored_records(finished, JOB)
    }
    assert verify(finished, known=lambda job_id: genuine.values()).exit_code == 0
    key = _first(finished, "_commits/")
    finished.put_bytes(key, _forged(lambda r: r["videos"][0].update(fov_x_deg=1.0))(finished.get_bytes(key)))
    finalise(finished, JOB, SPEC, num_shards=3, num_videos=6)
    assert verify(finished).exit_code == 0
    report = verify(finished, known=lambda job_id: genuine.values())
    assert report.problems == [f"the record of shard {JOB}-000000 is not the one that the database knows"]
    assert report.checked_against == ["plan", "database"]

    finished.delete(_first(finished, "_commits/"))
    report = verify(finished, known=lambda job_id: genuine.values())
    assert any("is committed, says the database" in problem for problem in report.problems)


def test_a_retry_makes_the_index_one_of_before(finished: DirectoryStore) -> None:
    """The plan has grown: the job runs again, until the index is made anew."""
    again = make_lease(["bad-1"], ordinal=3)
    planned = PlannedShard(3, again.plan_hash, ("bad-1",))
    publish_plan(finished, JOB, SPEC.config_hash, lambda first: [planned][first - 3 :], 4)
    report = verify(finished)
    assert (report.state, report.problems, report.planned_shards) == ("running", [], 4)


def _first(store: DirectoryStore, prefix: str) -> str:
    return next(o.key for o in store.list(prefix))


@pytest.mark.parametrize(
    ("key", "how", "expected"),
    [
        ("payload/", lambda d: d + b"\0", "bytes, its record says"),
        ("dataset.json", lambda d: d[:-9], "damaged"),
        ("dataset.json", lambda d: b"[]", "does not describe"),
        ("dataset.json", _edit_json(lambda d: d["totals"].update(frames=1)), "other totals"),
        ("dataset.json", _edit_json(lambda d: d["totals"].update(shards=4)), "3 of 4 shards"),
        ("dataset.json", _edit_json(lambda d: d["shards"].pop()), "dataset.json ends where"),
        ("dataset.json", _edit_json(lambda d: d["shards"].append(d["shards"][0])), "dataset.json lists"),
        ("dataset.json", _edit_json(lambda d: d["shards"][0]["objects"][0].update(sha256="0")), "dataset.json says"),
        ("meta.parquet", lambda d: d[:4] + bytes(200) + d[204:], "not a readable parquet file"),
        ("meta.parquet", lambda d: b"no parquet", "not a readable parquet file"),
        ("meta.parquet", _edit_table(lambda rows: rows[:-1]), "meta.parquet ends"),
        ("meta.parquet", _edit_table(lambda rows: [*rows, rows[0]]), "meta.parquet lists"),
        ("meta.parquet", _edit_table(lambda rows: [{**r, "num_frames": 7} for r in rows]), "meta.parquet says"),
        ("failures.parquet", _edit_table(lambda rows: rows[1:]), "failures.parquet says"),
        ("failures.parquet", lambda d: b"", "not a readable parquet file"),
        ("_commits/", lambda d: d[:-20], "damaged"),
        ("_commits/", lambda d: d.replace(b'"bad-1"', b'"bad-2"'), "bad-2 occurs twice"),
    ],
)
def test_damage_is_found(
    finished: DirectoryStore,
    rewrite: Callable[[str, Callable[[bytes], bytes]], None],
    key: str,
    how: Callable[[bytes], bytes],
    expected: str,
) -> None:
    rewrite(_first(finished, key), how)
    report = verify(finished)
    assert report.exit_code == 1
    assert any(expected in problem for problem in report.problems), report.problems


@pytest.mark.parametrize("prefix", ["payload/", "meta.parquet", "failures.parquet", "_commits/"])
def test_a_missing_object_is_found(finished: DirectoryStore, prefix: str) -> None:
    finished.delete(_first(finished, prefix))
    assert not verify(finished).ok


@pytest.mark.parametrize("position", [600, 5, -1])
def test_a_flipped_bit_needs_a_deep_look(
    finished: DirectoryStore, rewrite: Callable[[str, Callable[[bytes], bytes]], None], position: int
) -> None:
    key = next(o.key for o in finished.list("payload/") if o.key.endswith("depth.tar"))
    size = len(finished.get_bytes(key))
    rewrite(key, _flip(position % size))
    assert verify(finished).ok
    assert verify(finished, deep=True).problems == [f"{key} does not have the sha256 of its record"]


def test_a_record_that_lies_about_positions_is_found(
    finished: DirectoryStore, rewrite: Callable[[str, Callable[[bytes], bytes]], None]
) -> None:
    def shift(data: bytes) -> bytes:
        record = json.loads(data)
        for files in record["objects"][0]["members"].values():
            for position in files.values():
                position[0] += 512
        return json.dumps(record).encode()

    rewrite(_first(finished, "_commits/"), shift)
    assert any("dataset.json says" in p for p in verify(finished).problems)
    finalise(finished, JOB, SPEC, num_shards=3, num_videos=6)  # an index made from the lie
    assert verify(finished).ok
    assert any("elsewhere" in p for p in verify(finished, deep=True).problems)


def test_rubbish_is_counted_and_no_problem(finished: DirectoryStore) -> None:
    finished.put_bytes("payload/vipe-00000000/pose.tar", b"left by a crash")
    report = verify(finished)
    assert (report.ok, report.orphans) == (True, 1)
