"""Verification finds every kind of damage that we can make."""

from __future__ import annotations

import io
import json
from collections.abc import Callable

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from shard_factory import JOB

from services.dataset import verify
from services.storage import DirectoryStore, ObjectStore


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


def test_an_output_that_is_not_finalised_says_so(committed: DirectoryStore) -> None:
    report = verify(committed)
    assert (report.exit_code, report.problems) == (1, ["dataset.json is missing; the job is not finalised"])


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
    assert verify(finished).ok
    assert any("elsewhere" in p for p in verify(finished, deep=True).problems)


def test_rubbish_is_counted_and_no_problem(finished: DirectoryStore) -> None:
    finished.put_bytes("payload/vipe-00000000/pose.tar", b"left by a crash")
    report = verify(finished)
    assert (report.ok, report.orphans) == (True, 1)
