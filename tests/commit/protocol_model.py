"""An explicit-state model checker for the commit protocol, running the real protocol code.

A process (an attempt, the garbage collection, the reconciler) is a function of the answers it got so far: given a
history of answers the code is run again from its beginning and stopped at its next call, which is what the process
wants to do next. So a state of the world is a value: the objects, the database's row, the requests that are still on
their way, and the history of each process. All states that any order of calls and any choice of faults can reach are
visited, each once. A process that is never run again has crashed: so there is a crash before and after every step.
"""

from __future__ import annotations

import functools
import hashlib
import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from services.domain.errors import ObjectMissing, StorageError
from services.domain.models import CommitRecord
from services.storage.base import ObjectInfo

Call = tuple[Any, ...]
History = tuple[Any, ...]
Objects = frozenset[tuple[str, bytes]]
LastAttempt = Callable[[dict[str, bytes], "Row"], tuple[dict[str, bytes], bytes]]

ERROR = "no answer"


class Violation(AssertionError):
    """The protocol broke a promise; `trace` tells how, one step a line."""


class _Wants(BaseException):
    """Unwinds a process at its next call."""


class View:
    """What a process sees of the world: answers of its history, then nothing any more.

    It is an object store, and on top of it what the agent asks the database.
    """

    uri = "model"

    def __init__(self, history: History) -> None:
        self._history = history
        self._at = 0
        self.next_call: Call | None = None

    def _call(self, *call: Any) -> Any:
        if self._at == len(self._history):
            if self.next_call is None:  # What runs while the stack unwinds is not done by anybody.
                self.next_call = call
            raise _Wants
        answer = self._history[self._at]
        self._at += 1
        if answer is ERROR:
            raise StorageError("no answer")
        return answer

    def create(self, key: str, data: bytes) -> bool:
        return bool(self._call("create", key, data))

    def put_bytes(self, key: str, data: bytes) -> ObjectInfo:
        return ObjectInfo(key, self._call("put", key, data), None)

    def put_file(self, key: str, path: Path) -> ObjectInfo:
        return self.put_bytes(key, path.read_bytes())

    def get_bytes(self, key: str, start: int = 0, length: int | None = None) -> bytes:
        data = self._call("get", key)
        if data is None:
            raise ObjectMissing(key)
        return bytes(data)

    def download(self, key: str, path: Path) -> None:
        path.write_bytes(self.get_bytes(key))

    def head(self, key: str) -> ObjectInfo | None:
        size = self._call("head", key)
        return None if size is None else ObjectInfo(key, size, None)

    def list(self, prefix: str = "") -> Iterator[ObjectInfo]:
        for key, size in self._call("list", prefix):
            yield ObjectInfo(key, size, None)

    def delete(self, key: str) -> None:
        self._call("delete", key)

    def holds(self, fence: int) -> bool:
        return bool(self._call("holds", fence))

    def record_commit(self, record: CommitRecord) -> None:
        self._call("record_commit", record.to_bytes())

    def take_name(self, names: tuple[str, ...]) -> str:
        return str(self._call("take_name", names))

    def decide(self, record: CommitRecord) -> bytes | None:
        answer = self._call("decide", record.fence, record.to_bytes())
        return None if answer is None else bytes(answer)

    def decided(self) -> bytes | None:
        answer = self._call("decided")
        return None if answer is None else bytes(answer)


@dataclass(frozen=True)
class Row:
    """The shard's row in the database."""

    fence: int = 1
    committed: bytes | None = None
    decided: bytes | None = None
    names: frozenset[str] = frozenset()


@dataclass(frozen=True)
class State:
    objects: Objects = frozenset()
    row: Row = Row()
    late: tuple[Call, ...] = ()
    histories: tuple[History, ...] = ()
    faults: int = 0


@dataclass(frozen=True)
class Process:
    """What runs: code, from which fence on it may begin, and whether faults befall it."""

    code: Callable[[View], Any]
    fence: int = 1
    faulty: bool = True


@dataclass
class Model:
    """Visits every state. `last` is the attempt that the service makes in the end, undisturbed, in a given state."""

    processes: tuple[Process, ...]
    faults: int
    last: LastAttempt
    max_fence: int = 2
    states: int = field(default=0, init=False)
    outcomes: set[str] = field(default_factory=set, init=False)

    def __post_init__(self) -> None:
        self.next_call = functools.cache(self._run)
        self._checked: set[Any] = set()

    def check(self) -> None:
        """Raises Violation."""
        start = State(histories=((),) * len(self.processes), faults=self.faults)
        seen: dict[State, tuple[State | None, str]] = {start: (None, "")}
        stack = [start]
        while stack:
            state = stack.pop()
            try:
                self._promises(state)
                for label, after in self._successors(state):
                    if after not in seen:
                        seen[after] = (state, label)
                        _record_stays(state, after)
                        stack.append(after)
            except AssertionError as error:
                raise Violation(f"{error}\n" + "\n".join(_trace(seen, state))) from error
        self.states = len(seen)

    def _run(self, number: int, history: History) -> tuple[Call | None, Any]:
        """(next call, None), or (None, outcome) of a process that has ended."""
        view = View(history)
        try:
            outcome = self.processes[number].code(view)
        except _Wants:
            return view.next_call, None
        except Exception as error:
            outcome = error
        return None, outcome

    def _successors(self, state: State) -> Iterator[tuple[str, State]]:
        if state.row.fence < self.max_fence:
            yield "the lease runs out", replace(state, row=replace(state.row, fence=state.row.fence + 1))
        for index, request in enumerate(state.late):
            objects, row, _ = apply(state.objects, state.row, request)
            left = state.late[:index] + state.late[index + 1 :]
            yield f"late {_name(request)}", replace(state, objects=objects, row=row, late=left)
        for number, process in enumerate(self.processes):
            if state.row.fence < process.fence:
                continue
            call, outcome = self.next_call(number, state.histories[number])
            if call is None:
                self.outcomes.add(outcome if isinstance(outcome, str) else type(outcome).__name__)
                assert isinstance(outcome, (str, StorageError)), f"process {number} ended with {outcome!r}"
                continue
            if call[0] == "create" and call[1].startswith("_commits/"):
                asked = [a for a in state.histories[number] if isinstance(a, bool)]
                assert asked[-1:] == [True], (
                    f"process {number} commits without having been told that it holds the lease"
                )
            for fault, objects, row, late, answer in self._answers(state, process, call):
                histories = list(state.histories)
                histories[number] = (*histories[number], answer)
                yield (
                    f"{number}: {_name(call)} {fault}",
                    State(
                        objects,
                        row,
                        tuple(sorted((*state.late, *late), key=lambda each: each[:2])),
                        tuple(histories),
                        state.faults - bool(fault),
                    ),
                )

    def _answers(
        self, state: State, process: Process, call: Call
    ) -> Iterator[tuple[str, Objects, Row, tuple[Call, ...], Any]]:
        """(fault, objects, row, requests on their way, answer) of every way in which a call can go."""
        objects, row, answer = apply(state.objects, state.row, call)
        yield "", objects, row, (), answer
        if not process.faulty or not state.faults or call[0] not in _REMOTE:
            return
        yield "refused", state.objects, state.row, (), ERROR  # 503, 409 for ever, a connection that breaks
        if call[0] in ("create", "put", "delete"):
            yield "answer lost", objects, row, (), ERROR
            yield "late", state.objects, state.row, (call,), ERROR
        if call[0] == "create" and answer:
            yield "sent twice", objects, row, (), False  # 412 about its own object
        if call[0] == "put" and call[1].startswith("payload/"):
            short = ("put", call[1], call[2][: len(call[2]) // 2])
            objects, row, answer = apply(state.objects, state.row, short)
            yield "truncated", objects, row, (), answer

    def _promises(self, state: State) -> None:
        """In every state: what exists is whole; and wherever everybody stops, one more attempt makes it exist once."""
        objects = dict(state.objects)
        record = _consistent(objects)
        if state.row.committed is not None:
            assert record == state.row.committed, "the database knows another record than the output holds"
        key = (state.objects, state.row, state.late)
        if key in self._checked:
            return
        self._checked.add(key)
        for land_first in (False, True) if state.late else (True,):
            now, row = state.objects, state.row
            if land_first:
                now, row = _land(now, row, state.late)
                record = _consistent(dict(now))
            after, final = self.last(dict(now), row)
            assert record is None or record == final, "the last attempt replaced a record"
            assert _consistent(after) == final
            if not land_first:
                landed, _ = _land(frozenset(after.items()), row, state.late)
                assert _consistent(dict(landed)) == final, "a late request broke a committed shard"


_REMOTE = {"create", "put", "get", "head", "list", "delete"}


def apply(objects: Objects, row: Row, call: Call) -> tuple[Objects, Row, Any]:
    """One atomic call: (objects, row, answer)."""
    match call:
        case ("create", key, data):
            if _get(objects, key) is not None:
                return objects, row, False
            return objects | {(key, data)}, row, True
        case ("put", key, data):
            return frozenset((k, d) for k, d in objects if k != key) | {(key, data)}, row, len(data)
        case ("get", key):
            return objects, row, _get(objects, key)
        case ("head", key):
            data = _get(objects, key)
            return objects, row, None if data is None else len(data)
        case ("list", prefix):
            return objects, row, tuple(sorted((k, len(d)) for k, d in objects if k.startswith(prefix)))
        case ("delete", key):
            return frozenset((k, d) for k, d in objects if k != key), row, None
        case ("holds", fence):
            return objects, row, row.fence == fence and row.committed is None
        case ("record_commit", data):
            return objects, row if row.committed else replace(row, committed=data, decided=None), None
        case ("take_name", names):
            name = next(n for n in names if n not in row.names)
            return objects, replace(row, names=row.names | {name}), name
        case ("decide", fence, data):
            if row.decided is None and row.committed is None and row.fence == fence:
                return objects, replace(row, decided=data), data
            return objects, row, row.decided
        case ("decided",):
            return objects, row, row.decided
    raise TypeError(call)


def _get(objects: Objects, key: str) -> bytes | None:
    return next((data for k, data in objects if k == key), None)


def _land(objects: Objects, row: Row, late: tuple[Call, ...]) -> tuple[Objects, Row]:
    for call in late:
        objects, row, _ = apply(objects, row, call)
    return objects, row


parse = functools.cache(CommitRecord.from_bytes)


@functools.cache
def _sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def _consistent(objects: dict[str, bytes]) -> bytes | None:
    """The one record there is, its payload whole and all its videos settled; None if there is none."""
    records = [data for key, data in objects.items() if key.startswith("_commits/")]
    assert len(records) <= 1, "two records of one shard"
    for data in records:
        record = parse(data)
        assert [v.key for v in record.videos] == ["a", "b"], "a video is missing or double"
        for o in record.objects:
            assert o.key in objects, f"the record refers to {o.key}, which is gone"
            assert _sha256(objects[o.key]) == o.sha256, f"{o.key} holds the bytes of another attempt"
    return records[0] if records else None


def _record_stays(before: State, after: State) -> None:
    old = {(k, d) for k, d in before.objects if k.startswith("_commits/")}
    assert old <= after.objects, "a record was replaced or deleted"


def _name(call: Call) -> str:
    return " ".join(str(part) if not isinstance(part, bytes) else "..." for part in call[:2])


def _trace(seen: dict[State, tuple[State | None, str]], state: State) -> list[str]:
    steps = []
    at: State | None = state
    while at is not None:
        at, label = seen[at]
        steps.append(label)
    return [step for step in itertools.chain(reversed(steps)) if step]
