"""Every interleaving of two attempts, with a crash, a lost answer or a late request at every step.

The attempts run the real protocol code. Each of their calls to the store or the lease stops at a gate; a schedule says
who goes next, and a fault hits one attempt at one of its calls. Afterwards a third attempt runs undisturbed, as the
service would lease a shard that is not known to be committed. Whatever happened, the shard must exist exactly once.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import itertools
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from shard_factory import JOB, make_lease, success

from services.commit import (
    CommitOutcome,
    PreparedPayload,
    collect_garbage,
    committed_records,
    prepare_payload,
    write_record,
)
from services.domain.errors import ObjectMissing, StorageError
from services.domain.models import CommitRecord, JobSpec
from services.storage.base import ObjectInfo

FAULTS = ("crash", "crash after", "refused", "answer lost", "late", "retried inside")


class Crashed(BaseException):
    """The process is gone: nothing of it runs any more."""


@dataclass
class MemoryStore:
    """What object storage promises: single calls are atomic."""

    objects: dict[str, bytes] = field(default_factory=dict)
    late: list[Callable[[], object]] = field(default_factory=list)
    uri: str = "memory"

    def put_file(self, key: str, path: Path) -> ObjectInfo:
        return self.put_bytes(key, path.read_bytes())

    def put_bytes(self, key: str, data: bytes) -> ObjectInfo:
        self.objects[key] = data
        return ObjectInfo(key, len(data), None)

    def create(self, key: str, data: bytes) -> bool:
        return self.objects.setdefault(key, data) is data

    def get_bytes(self, key: str, start: int = 0, length: int | None = None) -> bytes:
        if key not in self.objects:
            raise ObjectMissing(key)
        return self.objects[key]

    def download(self, key: str, path: Path) -> None:
        path.write_bytes(self.get_bytes(key))

    def head(self, key: str) -> ObjectInfo | None:
        return ObjectInfo(key, len(self.objects[key]), None) if key in self.objects else None

    def list(self, prefix: str = "") -> Iterator[ObjectInfo]:
        return iter([ObjectInfo(k, len(v), None) for k, v in sorted(self.objects.items()) if k.startswith(prefix)])

    def delete(self, key: str) -> None:
        self.objects.pop(key, None)


class Gated:
    """One attempt's view of the store: every call waits for its turn and may meet the fault."""

    def __init__(self, store: MemoryStore, fault: tuple[int, str] | None) -> None:
        self._store, self._fault = store, fault
        self._calls = 0
        self._go, self._stopped = threading.Semaphore(0), threading.Semaphore(0)
        self._thread: threading.Thread | None = None
        self._dead = False
        self.uri = store.uri
        self.outcome: CommitOutcome | BaseException | None = None

    def start(self, work: Callable[[Gated], CommitOutcome]) -> None:
        def run() -> None:
            try:
                self.outcome = work(self)
            except BaseException as error:  # a crash is an outcome here
                self.outcome = error
            self._stopped.release()

        self._thread = threading.Thread(target=run)
        self._thread.start()
        self._stopped.acquire()

    def step(self) -> bool:
        """Let one call through; False if the attempt has ended."""
        if self.outcome is not None:
            return False
        self._go.release()
        self._stopped.acquire()
        return True

    def finish(self) -> None:
        while self.step():
            pass
        assert self._thread is not None
        self._thread.join()

    def call(self, action: Callable[[], object]) -> object:
        if self._dead:
            raise Crashed
        self._stopped.release()
        self._go.acquire()
        number, self._calls = self._calls, self._calls + 1
        kind = self._fault[1] if self._fault and self._fault[0] == number else None
        if kind in ("crash", "refused", "late"):
            if kind == "late":  # the request is on its way and lands after everything else
                self._store.late.append(action)
            self._dead = kind == "crash"
            raise Crashed if kind == "crash" else StorageError("no answer")
        result = action()
        if kind == "retried inside":  # the answer was lost and the client library sent the request again
            return action()
        if kind == "crash after":
            self._dead = True
            raise Crashed
        if kind == "answer lost":
            raise StorageError("no answer")
        return result

    def put_file(self, key: str, path: Path) -> object:
        data = path.read_bytes()  # a late upload has left the disk already
        return self.call(lambda: self._store.put_bytes(key, data))

    def __getattr__(self, name: str) -> Callable[..., object]:
        method = getattr(self._store, name)
        return lambda *args, **kwargs: self.call(lambda: method(*args, **kwargs))


def _lease(attempt: int):
    lease = make_lease(["a", "b"], attempt=attempt)
    spec = JobSpec(inputs=("/in",), output="/out", attributes=("pose", "intrinsics"))
    return type(lease)(**{f: getattr(lease, f) for f in lease.__slots__} | {"spec": spec})


@pytest.fixture(scope="module")
def artifacts(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Different bytes per attempt, as a GPU that is not deterministic would make them."""
    roots = []
    for attempt in (1, 2, 3):
        root = tmp_path_factory.mktemp(f"attempt{attempt}")
        for folder, names in {"pose": ["{}.npz"], "intrinsics": ["{}.npz", "{}_camera.txt"]}.items():
            (root / folder).mkdir()
            for name, key in itertools.product(names, ("a", "b")):
                (root / folder / name.format(key)).write_bytes(b"%d" % attempt)
        roots.append(root)
    return roots


class Templates(list[tuple[PreparedPayload, dict[str, bytes]]]):
    def __repr__(self) -> str:
        return "the templates"


@pytest.fixture(scope="module")
def templates(artifacts: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Templates:
    """Attempts whose upload is done: to walk over the record's step exhaustively, and for the attempt at the end."""
    made = Templates()
    for attempt in (1, 2, 3):
        store = MemoryStore()
        prepared = prepare_payload(
            _lease(attempt), _results(attempt), artifacts[attempt - 1], tmp_path_factory.mktemp("s"), store
        )
        made.append((prepared, dict(store.objects)))
    return made


def _results(attempt: int):
    return [success("a", attempt=attempt), success("b", attempt=attempt)]


# What the database says when an attempt asks: it has the lease, it has lost it, it loses it before it asks again.
HOLDS = ((True, True), (False, False), (True, False))


def _record(holds: tuple[bool, bool], prepared: PreparedPayload) -> Callable[[Gated], CommitOutcome]:
    """The agent: an error of storage makes it ask once more."""

    def work(gate: Gated) -> CommitOutcome:
        try:
            return write_record(gate, prepared, lambda: bool(gate.call(lambda: holds[0])))
        except StorageError:
            return write_record(gate, prepared, lambda: bool(gate.call(lambda: holds[1])))

    return work


def _run(gates: Sequence[Gated], works: Sequence[Callable[[Gated], CommitOutcome]], schedule: Sequence[int]) -> None:
    for gate, work in zip(gates, works, strict=True):
        gate.start(work)
    for turn in schedule:
        gates[turn].step()
    for gate in gates:
        gate.finish()


_parse = functools.cache(CommitRecord.from_bytes)


@functools.cache
def _sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def _check(store: MemoryStore, gates: Sequence[Gated], last: tuple[PreparedPayload, dict], *, very_late: bool) -> None:
    """The invariants: after the race, after a third attempt, after the late requests, after the garbage collection."""

    def land() -> None:
        while store.late:
            with contextlib.suppress(ObjectMissing):
                store.late.pop()()

    def consistent() -> list[bytes]:
        records = [store.objects[o.key] for o in store.list(f"_commits/{JOB}/")]
        assert len(records) <= 1
        for record in map(_parse, records):
            assert {v.key for v in record.videos} == {"a", "b"}
            assert all(_sha256(store.objects[o.key]) == o.sha256 for o in record.objects)
        return records

    before = consistent()
    for gate in gates:
        if isinstance(gate.outcome, CommitOutcome) and gate.outcome.record is not None:
            assert [gate.outcome.record.to_bytes()] == before
        elif not isinstance(gate.outcome, CommitOutcome):
            assert isinstance(gate.outcome, (Crashed, StorageError)), gate.outcome
    if not very_late:
        land()
    existing = consistent()
    assert existing[: len(before)] == before

    prepared, objects = last
    store.objects.update(objects)
    outcome = write_record(store, prepared, lambda: True)
    assert outcome.kind == ("adopted" if existing else "committed")
    final = consistent()
    assert len(final) == 1
    assert not existing or final == existing
    land()
    assert consistent() == final

    collect_garbage(store, JOB)
    (record,) = committed_records(store, JOB)
    assert {o.key for o in store.list("payload/")} == {o.key for o in record.objects}
    assert consistent() == final


def _schedules(steps: int) -> Iterator[tuple[int, ...]]:
    """Every order of `steps` calls of either attempt; what is left then runs one attempt after the other."""
    for first in itertools.combinations(range(2 * steps), steps):
        yield tuple(0 if turn in first else 1 for turn in range(2 * steps))


def test_every_interleaving_of_two_records_with_every_fault(
    templates: Templates,
) -> None:
    faults: list[tuple[int, str] | None] = [None, *itertools.product(range(5), FAULTS)]
    kinds: set[str] = set()
    for fault, *holds in itertools.product(faults, HOLDS, HOLDS[:2]):
        # Ask, create, read. A side without a lease writes nothing, so then the order says little.
        schedules = list(_schedules(3))[: None if holds[1][0] else 2]
        for number, schedule in enumerate(schedules):
            store = MemoryStore()
            for _, objects in templates[:2]:
                store.objects.update(objects)
            gates = [Gated(store, fault), Gated(store, None)]
            _run(gates, [_record(h, t[0]) for h, t in zip(holds, templates[:2], strict=True)], schedule)
            kinds.update(g.outcome.kind for g in gates if isinstance(g.outcome, CommitOutcome))
            _check(store, gates, templates[2], very_late=number % 2 == 0)
    assert kinds == {"committed", "adopted", "lost_lease"}


@settings(max_examples=150, deadline=None)
@given(
    schedule=st.lists(st.integers(0, 1), max_size=24),
    faults=st.tuples(*[st.none() | st.tuples(st.integers(0, 9), st.sampled_from(FAULTS))] * 2),
    holds=st.tuples(st.sampled_from(HOLDS), st.sampled_from(HOLDS)),
    very_late=st.booleans(),
)
def test_two_whole_attempts_with_faults_on_both_sides(
    artifacts: list[Path],
    templates: Templates,
    tmp_path_factory: pytest.TempPathFactory,
    schedule: list[int],
    faults: tuple[tuple[int, str] | None, ...],
    holds: tuple[tuple[bool, bool], ...],
    very_late: bool,
) -> None:
    scratch = tmp_path_factory.mktemp("scratch")

    def whole(attempt: int) -> Callable[[Gated], CommitOutcome]:
        def work(gate: Gated) -> CommitOutcome:
            prepared = prepare_payload(
                _lease(attempt), _results(attempt), artifacts[attempt - 1], scratch / str(attempt), gate
            )
            return _record(holds[attempt - 1], prepared)(gate)

        return work

    store = MemoryStore()
    gates = [Gated(store, fault) for fault in faults]
    _run(gates, [whole(1), whole(2)], schedule)
    _check(store, gates, templates[2], very_late=very_late)
