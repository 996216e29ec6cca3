"""Lists of videos: read row by row, refused with the number of the row, never followed anywhere by themselves."""

from __future__ import annotations

import io
import json
import random
import tempfile
import tracemalloc
from collections.abc import Iterator
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.hostile.mutation import mutated
from benchmarks.hostile.targets import TARGETS
from services.domain.errors import InputTooLarge, InputUnavailable, InvalidManifest, ServiceError
from services.domain.models import JobSpec
from services.domain.states import JobState
from services.inputs.rules import InputRules
from services.network import NetworkPolicy
from services.planner import plan_next
from services.planner.listing import Found, expand
from services.planner.manifest import Row, read_manifest
from services.store.sql import SqlStore

WEB = NetworkPolicy(("media.example",))


def parquet(rows: list[dict[str, object]]) -> bytes:
    buffer = io.BytesIO()
    pq.write_table(pa.Table.from_pylist(rows), buffer)
    return buffer.getvalue()


def rows_of(data: bytes, name: str, max_rows: int = 100) -> list[Row]:
    with tempfile.TemporaryFile() as file:
        file.write(data)
        file.seek(0)
        return list(read_manifest(file, name, max_rows=max_rows))


ROWS = [
    {"uri": "/v/a b.mp4", "key": "first", "size_bytes": 5, "etag": '"x"', "caption": "a, \"b\"\nc"},
    {"uri": "s3://bucket/ü.mp4", "key": None, "size_bytes": None, "etag": None, "caption": None},
]  # fmt: skip
WANTED = [Row(1, "/v/a b.mp4", "first", 5, '"x"'), Row(2, "s3://bucket/ü.mp4", None, 0, None)]
CSV = (
    '\ufeffcaption,uri,key,size_bytes,etag\r\n"a, ""b""\nc",/v/a b.mp4,first,5,"""x"""\r\n\r\n,s3://bucket/ü.mp4,,,\r\n'
)


@pytest.mark.parametrize(
    ("name", "data"),
    [
        ("list.csv", CSV.encode()),
        ("list.JSONL", "\n\n".join(json.dumps(row) for row in ROWS).encode()),
        ("list.ndjson", ("\n".join(json.dumps(row, ensure_ascii=False) for row in ROWS) + "\n").encode()),
        ("list.parquet", parquet(ROWS)),
    ],
)
def test_the_same_list_in_every_format(name: str, data: bytes) -> None:
    assert rows_of(data, name) == WANTED


BAD = {
    "empty.csv": b"",
    "empty.jsonl": b"\n\n",
    "header only.csv": b"uri\n",
    "no column.csv": b"url,key\nx,y\n",
    "two columns.csv": b"uri,uri\nx,y\n",
    "short row.csv": b"uri,key\n/a\n",
    "long row.csv": b"uri\n/a,/b\n",
    "no text.csv": b"uri\n\xff\xfe/a\n",
    "nul.csv": b"uri\n/a\0b\n",
    "quote.csv": b'uri\n"/a\n',
    "field.csv": b'uri\n"' + b"a\n" * 200_000 + b'"\n',
    "no json.jsonl": b"uri: /a\n",
    "list.jsonl": b'["/a"]\n',
    "deep.jsonl": b"[" * 100_000 + b"\n",
    "number.jsonl": b'{"uri": 5}\n',
    "nothing.jsonl": b'{"key": "a"}\n',
    "null.jsonl": b'{"uri": null}\n',
    "size.jsonl": b'{"uri": "/a", "size_bytes": -1}\n',
    "bool.jsonl": b'{"uri": "/a", "size_bytes": true}\n',
    "float.jsonl": b'{"uri": "/a", "size_bytes": 1e400}\n',
    "key case.jsonl": b'{"uri": "/a", "key": "A"}\n',
    "key path.jsonl": b'{"uri": "/a", "key": "../a"}\n',
    "key long.jsonl": b'{"uri": "/a", "key": "' + b"a" * 81 + b'"}\n',
    "control.jsonl": b'{"uri": "/a\\u0007"}\n',
    "direction.jsonl": '{"uri": "/a\u202egpj.mp4"}\n'.encode(),
    "surrogate.jsonl": b'{"uri": "/a\\ud800"}\n',
    "long uri.jsonl": b'{"uri": "/' + b"a" * 3000 + b'"}\n',
    "etag.jsonl": b'{"uri": "/a", "etag": "' + b"a" * 300 + b'"}\n',
    "no parquet.parquet": b"PAR1 and nothing else",
    "cut.parquet": parquet([{"uri": f"/v{i}"} for i in range(100)])[:-30],
    "type.parquet": parquet([{"uri": 5}]),
    "columns.parquet": parquet([{"url": "/a"}]),
    "nested.parquet": parquet([{"uri": {"x": "/a"}}]),
}


@pytest.mark.parametrize("name", BAD)
def test_lists_that_are_not_understood(name: str) -> None:
    with pytest.raises(InvalidManifest) as caught:
        rows_of(BAD[name], name)
    assert name in str(caught.value)
    assert len(str(caught.value)) < 400


def test_lists_that_are_too_large() -> None:
    with pytest.raises(InputTooLarge, match="3 rows"):
        rows_of(b"uri\n/a\n/b\n/c\n/d\n", "list.csv", max_rows=3)
    with pytest.raises(InputTooLarge, match="line 2"):
        rows_of(b"uri\n" + b"a" * (2 << 20), "list.csv")


@given(st.binary(max_size=300), st.sampled_from([".csv", ".jsonl"]))
def test_no_bytes_break_a_reader(data: bytes, suffix: str) -> None:
    for content in (data, b"uri,key\n" + data, b'{"uri": "' + data):
        try:
            rows_of(content, f"list{suffix}")
        except ServiceError:
            continue


def test_a_parquet_file_that_ends_the_process_of_its_reader() -> None:
    """The library aborts on this one, and the planner must live on. Found by `benchmarks.fuzz`."""
    target = TARGETS["parquet"]
    with pytest.raises(InvalidManifest):
        rows_of(mutated(target.seeds(), random.Random("parquet:0:84")), "list.parquet")


def test_a_long_list_needs_no_memory(tmp_path: Path) -> None:
    path = tmp_path / "list.csv"
    with path.open("w") as file:
        file.write("uri\n")
        file.writelines(f"s3://bucket/videos/clip-{number:09d}.mp4\n" for number in range(100_000))
    tracemalloc.start()
    try:
        assert sum(1 for _ in expand(str(path))) == 100_000
        assert tracemalloc.get_traced_memory()[1] < 8 << 20
    finally:
        tracemalloc.stop()


def listed(tmp_path: Path, *uris: str, rules: InputRules | None = None) -> list[Found]:
    path = tmp_path / "list.jsonl"
    path.write_text("".join(json.dumps({"uri": uri}) + "\n" for uri in uris))
    return list(expand(str(path), rules))


def test_rows_of_every_kind(tmp_path: Path) -> None:
    (tmp_path / "a.mp4").write_bytes(b"1234")
    found = listed(
        tmp_path,
        f"{tmp_path}/./a.mp4",
        "/not/there.mp4",
        "s3://bucket/a.mp4",
        "https://media.example/a.mp4?x=1#t=5",
        rules=InputRules(network=WEB),
    )
    assert found == [
        Found(f"{tmp_path}/a.mp4", 4),
        Found("/not/there.mp4", 0),
        Found("s3://bucket/a.mp4", 0),
        Found("https://media.example/a.mp4?x=1", 0),
    ]


@pytest.mark.parametrize(
    "uri",
    [
        "a.mp4", "../a.mp4", "file:///etc/passwd", "ftp://media.example/a", "http://other.example/a", "/etc/passwd",
        "https://u:p@media.example/a", "http://169.254.169.254/latest", "s3://forbidden/a.mp4", "s3://bucket/prefix/",
        "//a", "-i", "concat:/a|/b",
    ],
)  # fmt: skip
def test_a_row_must_name_what_a_job_may_name(tmp_path: Path, uri: str) -> None:
    rules = InputRules(roots=(tmp_path,), buckets=("bucket", "team-*"), network=WEB)
    with pytest.raises(InvalidManifest, match=r"list\.jsonl, row 2"):
        listed(tmp_path, "s3://team-a/fine.mp4", uri, rules=rules)


def test_a_list_outside_of_the_roots(tmp_path: Path) -> None:
    inside = tmp_path / "inside"
    inside.mkdir()
    (tmp_path / "list.csv").write_text("uri\n/a\n")
    (inside / "list.csv").symlink_to(tmp_path / "list.csv")
    for path in (tmp_path / "list.csv", inside / "list.csv"):
        with pytest.raises(InputUnavailable, match="outside"):
            list(expand(str(path), InputRules(roots=(inside,))))


@pytest.fixture
def store(tmp_path: Path) -> Iterator[SqlStore]:
    opened = SqlStore(f"sqlite:///{tmp_path}/store.db")
    yield opened
    opened.close()


def plan(store: SqlStore, tmp_path: Path, content: str) -> str:
    path = tmp_path / "list.csv"
    path.write_text(content)
    job_id = store.create_job(JobSpec((str(path),), str(tmp_path / "out")))[0].id
    plan_next(store, "planner")
    return job_id


def test_keys_of_a_list_become_the_keys_of_the_job(store: SqlStore, tmp_path: Path) -> None:
    job_id = plan(store, tmp_path, "uri,key,etag\ns3://b/x.mp4,clip_one,e1\ns3://b/x.mp4,again,\ns3://b/y.mp4,,\n")
    rows, _ = store.list_videos(job_id)
    assert [(r.ref.uri, r.ref.etag) for r in rows if r.ref.key == "clip_one"] == [("s3://b/x.mp4", "e1")]
    assert len(rows) == 2


def test_two_videos_with_one_key_fail_the_plan(store: SqlStore, tmp_path: Path) -> None:
    job = store.get_job(plan(store, tmp_path, "uri,key\ns3://b/x.mp4,same\ns3://b/y.mp4,same\n"))
    assert (job.state, job.error_code) == (JobState.FAILED, "invalid_manifest")
    assert "same" in str(job.error_message)
