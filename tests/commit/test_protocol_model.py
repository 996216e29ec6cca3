"""Every order of two attempts, the garbage collection and the reconciler, with every fault at every step.

Faults: crashes before and after each call, refusals (503, 409, no connection), lost answers, requests that arrive after
everything that was sent later, requests that the client library sent twice (412 about one's own object), truncated
uploads; leases that run out at any moment, so that their holders go on as zombies. See `protocol_model`.
"""

from __future__ import annotations

import functools
import inspect
import itertools
import sys
import types
import uuid
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import pytest
from protocol_model import LastAttempt, Model, Process, Row, View, Violation, apply
from shard_factory import JOB, make_lease, success

import services.commit.gc as gc_module
import services.commit.protocol as protocol_module
from services.commit.layout import commit_key
from services.commit.protocol import CommitOutcome, PreparedPayload
from services.commit.reconcile import committed_record
from services.commit.tar_writer import WrittenTar, write_tar
from services.commit.verify import Members, verify_tar
from services.domain.errors import IntegrityError, StorageError
from services.domain.models import Attribute, JobSpec, Lease

KEYS = ("a", "b")


@functools.cache
def lease_of(attempt: int) -> Lease:
    spec = JobSpec(inputs=("/in",), output="/out", attributes=("pose", "intrinsics"))
    return replace(make_lease(list(KEYS), attempt=attempt), spec=spec)


class Attempts:
    """The agent's side of an attempt around one version of the protocol; packs and commits twice before it gives up."""

    def __init__(self, protocol: types.ModuleType, root: Path) -> None:
        self._protocol = protocol
        self._root = root
        (root / "scratch").mkdir()
        # Every packing has other bytes, as a GPU that is not deterministic and a worker that died would make them.
        for attempt, packing in itertools.product((1, 2, 3), (0, 1)):
            artifacts = self._artifacts(attempt, packing)
            for folder, names in {"pose": ["{}.npz"], "intrinsics": ["{}.npz", "{}_camera.txt"]}.items():
                (artifacts / folder).mkdir(parents=True)
                for name, key in itertools.product(names, KEYS):
                    (artifacts / folder / name.format(key)).write_bytes(b"%d%d" % (attempt, packing))

    def by_output(self, attempt: int) -> Callable[[View], str]:
        lease = lease_of(attempt)

        def run(view: View) -> str:
            if attempt > 1 and (found := committed_record(view, JOB, lease.shard_id)) is not None:
                view.record_commit(found)
                return "found"
            prepared = self._prepared(view, attempt, lambda: None)
            return self._committed(
                view, lambda: self._protocol.write_record(view, prepared, lambda: view.holds(lease.fence))
            )

        return run

    def by_database(self, attempt: int) -> Callable[[View], str]:
        lease = lease_of(attempt)

        def run(view: View) -> str:
            if attempt > 1:
                key = commit_key(JOB, lease.shard_id)
                if (decided := view.decided()) is not None and view.head(key) is None:
                    view.put_bytes(key, decided)
                if (found := committed_record(view, JOB, lease.shard_id)) is not None:
                    view.record_commit(found)
                    return "found"
            names = tuple(self._protocol.tar_names(lease)[:4])
            prepared = self._prepared(view, attempt, lambda: view.take_name(names))
            return self._committed(view, lambda: self._protocol.write_decided(view, prepared, view.decide))

        return run

    def _prepared(self, view: View, attempt: int, name: Callable[[], str | None]) -> PreparedPayload:
        lease = lease_of(attempt)
        results = [success(key, attempt=attempt) for key in KEYS]
        nonces = itertools.count()
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(uuid, "uuid4", lambda: types.SimpleNamespace(hex=f"{attempt}-{next(nonces)}"))
            for packing in (0, 1):
                try:
                    prepared: PreparedPayload = self._protocol.prepare_payload(
                        lease,
                        results,
                        self._artifacts(attempt, packing),
                        self._root / "scratch",
                        view,
                        tar_name=name(),
                    )
                    return prepared
                except (StorageError, IntegrityError):
                    if packing:
                        raise StorageError("given back") from None
        raise AssertionError

    @staticmethod
    def _committed(view: View, write: Callable[[], CommitOutcome]) -> str:
        for last in (False, True):
            try:
                outcome = write()
            except StorageError:
                if last:
                    raise
            else:
                if outcome.record is not None:
                    view.record_commit(outcome.record)
                return outcome.kind
        raise AssertionError

    def _artifacts(self, attempt: int, packing: int) -> Path:
        return self._root / f"artifacts-{attempt}-{packing}"


def reconcile(view: View) -> str:
    found = committed_record(view, JOB, lease_of(1).shard_id)
    if found is not None:
        view.record_commit(found)
    return "reconciled"


def collector(gc: types.ModuleType) -> Callable[[View], str]:
    def run(view: View) -> str:
        gc.collect_garbage(view, JOB)
        return "collected"

    return run


Around = Callable[[types.ModuleType], Attempts]
"""Attempts around a version of the protocol."""


@pytest.fixture
def attempts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Around:
    """Tars are built once for each packing: a model runs the code some ten thousand times."""
    built: dict[tuple[str, str], tuple[bytes, WrittenTar]] = {}

    def write(path: Path, samples: Iterable[Sequence[tuple[str, Path]]]) -> WrittenTar:
        files = list(samples)
        key = (str(files[0][0][1].parent.parent), path.name)
        if key not in built:
            tar = write_tar(path, files)
            built[key] = path.read_bytes(), tar
        data, tar = built[key]
        path.write_bytes(data)
        return replace(tar, path=path)

    verified: dict[str, Members] = {}

    def verify(tar: WrittenTar, attribute: Attribute, keys: Sequence[str]) -> Members:
        if tar.sha256 not in verified:
            verified[tar.sha256] = verify_tar(tar, attribute, keys)
        return verified[tar.sha256]

    def around(protocol: types.ModuleType) -> Attempts:
        monkeypatch.setattr(protocol, "write_tar", write)
        monkeypatch.setattr(protocol, "verify_tar", verify)
        return Attempts(protocol, tmp_path)

    return around


def last_attempt(made: Attempts, code: Callable[[View], str]) -> LastAttempt:
    """The attempt that ends it: undisturbed, and then the garbage collection; what is there after them."""
    model = Model((Process(code, 3), Process(collector(gc_module))), 0, lambda objects, row: (objects, b""))

    def run(objects: dict[str, bytes], row: Row) -> tuple[dict[str, bytes], bytes]:
        now, row = frozenset(objects.items()), replace(row, fence=3)
        for number in (0, 1):
            history: tuple[object, ...] = ()
            while (call := model.next_call(number, history)[0]) is not None:
                now, row, answer = apply(now, row, call)
                history = (*history, answer)
            outcome = model.next_call(number, history)[1]
            assert isinstance(outcome, str), f"the last attempt failed: {outcome!r}"
        assert row.committed is not None, "the database does not know of the commit"
        after = dict(now)
        referenced = {o.key for o in protocol_module.read_record(row.committed, "").objects}
        assert {key for key in after if key.startswith("payload/")} == referenced, "rubbish is left"
        return after, row.committed

    return run


def explore(made: Attempts, mode: str, *, faults: int, beside: tuple[Callable[[View], str], ...] = ()) -> Model:
    code = made.by_output if mode == "output" else made.by_database
    processes = (Process(code(1)), Process(code(2), 2), *(Process(each) for each in beside))
    model = Model(processes, faults, last_attempt(made, code(3)))
    model.check()
    return model


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["output", "database"])
@pytest.mark.parametrize(("faults", "states"), [(1, 3_000), pytest.param(2, 10_000, marks=pytest.mark.long)])
def test_two_attempts_with_faults_anywhere(attempts: Around, mode: str, faults: int, states: int) -> None:
    model = explore(attempts(protocol_module), mode, faults=faults)
    assert model.outcomes == {"committed", "adopted", "found", "lost_lease", "StorageError"}
    assert model.states > states


@pytest.mark.parametrize("mode", ["output", "database"])
@pytest.mark.parametrize(
    ("beside", "ended"),
    [
        ((collector(gc_module),), {"collected"}),
        ((reconcile,), {"reconciled"}),
        ((collector(gc_module), reconcile), {"collected", "reconciled"}),
    ],
    ids=["collector", "reconciler", "both"],
)
def test_garbage_collection_and_reconciler_at_any_moment(
    attempts: Around, mode: str, beside: tuple[Callable[[View], str], ...], ended: set[str]
) -> None:
    # Four processes have orders enough without faults.
    model = explore(attempts(protocol_module), mode, faults=2 - len(beside), beside=beside)
    assert ended <= model.outcomes


# What breaks the protocol, and how it is found out.
MUTANTS = {
    "412 is taken for success": (
        "protocol",
        '        if store.create(key, data):\n            return CommitOutcome("committed", record)\n',
        '        store.create(key, data)\n        return CommitOutcome("committed", record)\n',
    ),
    "the record replaces what is there": (
        "protocol",
        "        if store.create(key, data):\n",
        "        if store.put_bytes(key, data):\n",
    ),
    "the payload goes when the answer is lost": (
        "protocol",
        "        if _read(store, key) != data:\n            raise\n",
        "        if _read(store, key) != data:\n"
        "            _discard(store, [o.key for o in record.objects])\n            raise\n",
    ),
    "tar names are used again": (
        "protocol",
        "        if store.create(claim_key(name), data) or _read(store, claim_key(name)) == data:\n",
        "        if store.create(claim_key(name), data) or True:\n",
    ),
    "the size of an upload is not looked at": (
        "protocol",
        "                    if info.size_bytes != tar.size_bytes:\n",
        "                    if False:\n",
    ),
    "the fence is skipped": ("protocol", "    if not holds():\n", "    if False:\n"),
    "the loser deletes the winner's": (
        "protocol",
        "    _discard(store, [o.key for o in mine.objects if o.key not in referenced])\n",
        "    _discard(store, [o.key for o in winner.objects])\n",
    ),
    "rubbish is what has no record yet": (
        "gc",
        "        if claimed[1] not in settled and not abandoned:\n",
        "        if False:\n",
    ),
    "the database is asked after the record is written": (
        "database",
        "    counts = decide(record)\n",
        "    store.put_bytes(key, record.to_bytes())\n    counts = decide(record)\n",
    ),
    "nobody looks at what the database decided": (
        "database",
        "    store.put_bytes(key, counts)  # Only",
        "    store.put_bytes(key, record.to_bytes())  # Only",
    ),
}


@pytest.mark.parametrize("name", MUTANTS)
def test_a_protocol_that_is_broken_is_found_out(attempts: Around, name: str) -> None:
    where, old, new = MUTANTS[name]
    module = gc_module if where == "gc" else protocol_module
    mutant = _mutated(module, old, new)
    made = attempts(protocol_module if where == "gc" else mutant)
    beside = (collector(mutant if where == "gc" else gc_module),)
    with pytest.raises(Violation):
        explore(made, "database" if where == "database" else "output", faults=1, beside=beside)


def _mutated(module: types.ModuleType, old: str, new: str) -> types.ModuleType:
    source = inspect.getsource(module)
    assert source.count(old) == 1, "the protocol changed: change the mutant, too"
    mutant = types.ModuleType(f"{module.__name__}_mutant")
    sys.modules[mutant.__name__] = mutant  # Dataclasses look themselves up there.
    try:
        exec(compile(source.replace(old, new), module.__file__ or "", "exec"), mutant.__dict__)
    finally:
        del sys.modules[mutant.__name__]
    return mutant
