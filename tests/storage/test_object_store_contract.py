"""One contract, run against a directory and against a real S3 server over HTTP."""

from __future__ import annotations

import threading
import uuid
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import boto3
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from services.domain.errors import ObjectMissing, StorageError
from services.storage import DirectoryStore, ObjectStore, S3Store, open_store, supports_create_once


class Ledger:
    """A `StorageObserver` that remembers."""

    def __init__(self) -> None:
        self.requests: Counter[tuple[str, str]] = Counter()
        self.size_bytes: Counter[str] = Counter()

    def request(self, op: str, status: str) -> None:
        self.requests[op, status] += 1

    def transferred(self, op: str, size_bytes: int) -> None:
        self.size_bytes[op] += size_bytes


@pytest.fixture
def aws(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "test")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "a-secret-that-must-not-leak")
    monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")


@pytest.fixture
def bucket(aws: None, s3_endpoint: str) -> str:
    name = f"b-{uuid.uuid4().hex[:12]}"
    boto3.client("s3", endpoint_url=s3_endpoint).create_bucket(Bucket=name)
    return name


@pytest.fixture(params=["directory", "s3"])
def make_store(request: pytest.FixtureRequest, tmp_path: Path) -> Callable[..., ObjectStore]:
    if request.param == "directory":
        return lambda observer=None: DirectoryStore(tmp_path / "store", observer=observer)
    endpoint, name = request.getfixturevalue("s3_endpoint"), request.getfixturevalue("bucket")
    # Small parts, so that the multipart path runs too (the protocol's minimum is 5 MiB).
    return lambda observer=None: S3Store(
        name, "some/prefix", endpoint_url=endpoint, part_bytes=5 << 20, observer=observer
    )


@pytest.fixture
def store(make_store: Callable[..., ObjectStore]) -> Iterator[ObjectStore]:
    return make_store()


def test_an_absent_object_is_missing_for_every_reader(store: ObjectStore, tmp_path: Path) -> None:
    assert store.head("no/such") is None
    for read in (
        lambda: store.get_bytes("no/such"),
        lambda: store.get_bytes("no/such", 3, 0),
        lambda: store.get_bytes("no/such", 3, 2),
        lambda: store.download("no/such", tmp_path / "x"),
    ):
        with pytest.raises(ObjectMissing, match="no/such"):
            read()
    store.delete("no/such")
    assert list(store.list()) == []
    assert not (tmp_path / "x").exists()


def test_put_replaces_and_reports_what_is_there(store: ObjectStore) -> None:
    first = store.put_bytes("a/b.bin", b"one")
    second = store.put_bytes("a/b.bin", b"three")
    assert (first.size_bytes, second.size_bytes) == (3, 5)
    assert store.head("a/b.bin") == second
    assert first.etag != second.etag
    assert store.get_bytes("a/b.bin") == b"three"


def test_a_file_makes_the_round_trip_in_parts(store: ObjectStore, tmp_path: Path) -> None:
    source, target = tmp_path / "source", tmp_path / "new" / "target"
    source.write_bytes(bytes(range(256)) * 45_000)  # 11.5 MB: three parts on S3
    info = store.put_file("big.bin", source)
    assert info.size_bytes == source.stat().st_size
    assert info.key == "big.bin"
    store.download("big.bin", target)
    assert target.read_bytes() == source.read_bytes()
    assert [p.name for p in target.parent.iterdir()] == ["target"]


def test_create_lets_only_the_first_through(store: ObjectStore) -> None:
    assert store.create("_commits/j/s.json", b"first")
    assert not store.create("_commits/j/s.json", b"second")
    assert store.get_bytes("_commits/j/s.json") == b"first"
    store.put_bytes("other", b"")
    assert not store.create("other", b"x")
    store.delete("other")
    assert store.create("other", b"y")


def test_of_many_concurrent_creators_exactly_one_wins(make_store: Callable[..., ObjectStore]) -> None:
    gate = threading.Barrier(8)
    wins: list[int] = []

    def work(number: int) -> None:
        store = make_store()
        gate.wait()
        if store.create("contended", b"%d" % number):
            wins.append(number)

    threads = [threading.Thread(target=work, args=(n,)) for n in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(wins) == 1
    assert make_store().get_bytes("contended") == b"%d" % wins[0]
    assert [o.key for o in make_store().list()] == ["contended"]


def test_the_probe_says_yes_and_leaves_nothing(store: ObjectStore) -> None:
    assert supports_create_once(store)
    assert list(store.list()) == []


def test_the_probe_says_no_where_the_condition_is_ignored(tmp_path: Path) -> None:
    class Overwriting(DirectoryStore):
        def create(self, key: str, data: bytes) -> bool:
            self.put_bytes(key, data)
            return True

    assert not supports_create_once(Overwriting(tmp_path))


def test_list_is_in_key_order_and_filters_by_string_prefix(store: ObjectStore) -> None:
    keys = ["a", "a.b/x", "a/x", "a0", "b/c/d", "b/c.tar", "b/é", "b-c/z"]
    keys.remove("a")  # a directory cannot hold both `a` and `a/x`
    for key in keys:
        store.put_bytes(key, key.encode())
    assert [o.key for o in store.list()] == sorted(keys)
    assert [o.key for o in store.list("a")] == ["a.b/x", "a/x", "a0"]
    assert [o.key for o in store.list("b/c")] == ["b/c.tar", "b/c/d"]
    assert [o.key for o in store.list("b/c/")] == ["b/c/d"]
    assert list(store.list("c")) == []
    assert {o.key: o.size_bytes for o in store.list()} == {k: len(k.encode()) for k in keys}


def test_listing_is_lazy_over_more_than_one_page(store: ObjectStore) -> None:
    if isinstance(store, S3Store):
        keys = [f"k/{i:05d}" for i in range(1002)]  # the server answers with at most 1000
    else:
        keys = [f"k/{i:05d}" for i in range(30)]
    for key in keys:
        store.create(key, b"")
    assert [o.key for o in store.list("k/")] == keys


@pytest.mark.parametrize(
    "key",
    [
        "",
        "/a",
        "a/",
        "a//b",
        "../a",
        "a/../b",
        "./a",
        "a/.",
        "a\\b",
        "a\nb",
        "a\0b",
        ".vipe-tmp-1",
        "a" * 1100,
        "\ud800",
    ],
)
def test_keys_that_leave_the_root_or_cannot_exist_everywhere_are_refused(store: ObjectStore, key: str) -> None:
    for use in (
        store.head,
        store.get_bytes,
        store.delete,
        lambda k: store.put_bytes(k, b""),
        lambda k: store.create(k, b""),
    ):
        with pytest.raises(StorageError, match="object key"):
            use(key)


_SEGMENT = st.text(alphabet="abZ09_-.é ", min_size=1, max_size=6).filter(lambda s: s not in (".", ".."))


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    objects=st.dictionaries(
        st.lists(_SEGMENT, min_size=3, max_size=3).map("/".join), st.binary(max_size=40), min_size=1, max_size=6
    ),
    start=st.integers(0, 50),
    length=st.none() | st.integers(0, 50),
)
def test_a_store_behaves_as_a_dictionary_of_bytes(
    store: ObjectStore, objects: dict[str, bytes], start: int, length: int | None
) -> None:
    for info in list(store.list()):
        store.delete(info.key)
    for key, data in objects.items():
        store.put_bytes(key, data)
    assert [(o.key, o.size_bytes) for o in store.list()] == [(k, len(objects[k])) for k in sorted(objects)]
    stop = None if length is None else start + length
    for key, data in objects.items():
        assert store.get_bytes(key) == data
        assert store.get_bytes(key, start, length) == data[start:stop]
        assert not store.create(key, b"other")
        info = store.head(key)
        assert info is not None
        assert info.size_bytes == len(data)
    gone = min(objects)
    store.delete(gone)
    assert [o.key for o in store.list()] == sorted(set(objects) - {gone})


@pytest.mark.parametrize(("start", "length"), [(-1, None), (0, -1)])
def test_a_negative_range_is_a_programming_error(store: ObjectStore, start: int, length: int | None) -> None:
    store.put_bytes("k", b"abc")
    with pytest.raises(ValueError, match="range"):
        store.get_bytes("k", start, length)


def test_the_observer_counts_requests_and_bytes(make_store: Callable[..., ObjectStore], tmp_path: Path) -> None:
    ledger = Ledger()
    store = make_store(observer=ledger)
    store.put_bytes("a", b"12345")
    store.create("b", b"123")
    store.create("b", b"456")
    store.get_bytes("a", 1, 2)
    store.download("a", tmp_path / "a")
    store.head("none")
    list(store.list())
    store.delete("a")
    created = "put" if isinstance(store, S3Store) else "create"  # on the wire a conditional PUT is a PUT
    assert ledger.size_bytes == {"put": 5, "create": 3, "get": 7}
    assert ledger.requests["head", "404"] == 1
    assert ledger.requests[created, "412"] == 1
    assert sum(n for (op, _), n in ledger.requests.items() if op == "list") == 1
    assert sum(n for (op, _), n in ledger.requests.items() if op == "delete") == 1


def test_open_store_gives_the_same_objects_by_address(store: ObjectStore, request: pytest.FixtureRequest) -> None:
    endpoint = request.getfixturevalue("s3_endpoint") if isinstance(store, S3Store) else None
    again = open_store(store.uri, endpoint_url=endpoint)
    store.put_bytes("x", b"1")
    assert again.get_bytes("x") == b"1"
    assert again.uri == store.uri
