"""Is the data set what it says? Nothing is believed that was not counted here.

What is compared: the plan (`_plan/`, a chain of digests) with the commit records, the records with the objects that
they name, and the index that was made from the records (`dataset.json`, which holds the digest of every record, and the
two tables) with both. A record that was invented, changed or exchanged contradicts one of them. Who rewrites all of
them in agreement is found out only where the database is at hand, which knows the digest of every record, too.
"""

from __future__ import annotations

import hashlib
import json
import tempfile
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import pyarrow as pa
import pyarrow.parquet as pq

from services.commit.layout import JOB_KEY
from services.commit.plan import PlanHead, read_plan
from services.commit.reconcile import stored_records
from services.commit.verify import check_keys, check_members, index_tar, sha256_of
from services.dataset.finalise import Completeness, Totals
from services.dataset.index import DatasetIndex, parquet_errors
from services.dataset.schema import DATASET_KEY, FAILURES_KEY, META_KEY
from services.domain.errors import IntegrityError, ObjectMissing
from services.domain.models import CommitRecord, PayloadObject, PlannedShard, ShardDigest, shard_id
from services.domain.states import ShardState
from services.storage.base import ObjectStore
from services.storage.object_file import open_object
from services.storage.open import open_store

_MAX_PROBLEMS = 100
_META_COLUMNS = ("sequence", "num_frames", "tar_name")
_FAILURE_COLUMNS = ("sequence", "status", "error_code")

EXIT_COMPLETE, EXIT_WRONG, EXIT_RUNNING = 0, 1, 3


@dataclass(slots=True)
class Report:
    """The outcome of `verify`.

    Attributes:
        finished: Whether the index says that the job has ended; otherwise it still runs, or runs again for a retry.
        problems: One sentence each, the first hundred; empty means that the data set is whole, or will be.
        totals: Counted from the commit records: videos = succeeded + failed + quarantined.
        planned_shards, planned_videos: Counted from the plan; None where the output has none.
        checked_bytes: Payload that was read back and hashed (`deep` only).
        checked_against: What the records were held against.
        orphans: Payload objects that no record refers to; not a problem, the garbage collection removes them.
    """

    uri: str
    job_id: str | None = None
    finished: bool = False
    problems: list[str] = field(default_factory=list)
    totals: Totals = field(default_factory=Totals)
    planned_shards: int | None = None
    planned_videos: int | None = None
    checked_bytes: int = 0
    checked_against: list[str] = field(default_factory=list)
    orphans: int = 0

    @property
    def ok(self) -> bool:
        """Nothing is wrong; of a job that runs, with what there is so far."""
        return not self.problems

    @property
    def state(self) -> Literal["complete", "running", "damaged"]:
        if self.problems:
            return "damaged"
        return "complete" if self.finished else "running"

    @property
    def exit_code(self) -> int:
        return {"complete": EXIT_COMPLETE, "damaged": EXIT_WRONG, "running": EXIT_RUNNING}[self.state]

    def to_json(self) -> dict[str, Any]:
        return {**asdict(self), "ok": self.ok, "state": self.state, "exit_code": self.exit_code}

    def problem(self, text: str) -> None:
        if len(self.problems) < _MAX_PROBLEMS:
            self.problems.append(text)


def verify(
    source: ObjectStore | str,
    deep: bool = False,
    known: Callable[[str], Iterable[ShardDigest]] | None = None,
) -> Report:
    """Check an output against its plan and its records: every shard and video once, every object with its size, the
    index equal to the records. A job that still runs is checked as far as it is.

    Args:
        source: The output, or its address.
        deep: Also read every tar back: sha256, samples, order and member positions.
        known: Job id -> what the database knows of its shards; None: there is no database at hand.

    Raises:
        StorageError: The store does not answer. What is wrong with the data set is in the report instead.
        JobNotFound: By `known`, for a job of another database.
    """
    store = open_store(source) if isinstance(source, str) else source
    report = Report(uri=store.uri)
    described = _described(store, report)
    if report.problems:
        return report
    report.job_id = str(described["job_id"]) if described is not None else _owner(store, report)
    if report.job_id is None:
        return report
    plan = _Plan.read(store, report.job_id, report)
    database = None if known is None else {shard.id: shard for shard in known(report.job_id)}
    if plan.head.pages:
        report.checked_against.append("plan")
        report.planned_shards, report.planned_videos = plan.head.shards, plan.num_videos
    if database is not None:
        report.checked_against.append("database")
    completeness = Completeness.of(store)
    index = _Index.of(store, described, plan.head, report)
    referenced: set[str] = set()
    tar_names: set[str] = set()
    try:
        for record, digest in stored_records(store, report.job_id):
            try:
                completeness.add(record)
            except IntegrityError as error:
                report.problem(str(error))
            plan.check(record, report)
            if database is not None:
                _check_known(record, digest, database, report)
            if record.tar_name is not None and record.tar_name in tar_names:
                report.problem(f"two records refer to the tars of {record.tar_name}, one is that of {record.shard_id}")
            tar_names.add(record.tar_name or "")
            index.add(record, digest)
            for o in record.objects:
                referenced.add(o.key)
                if deep and o.key in completeness.sizes:
                    report.checked_bytes += _read_back(store, record, o, report)
    except (IntegrityError, ObjectMissing) as error:
        report.problem(str(error))
    index.end(completeness)
    if database is not None:
        _check_committed(completeness, database, report)
    report.orphans = sum(1 for key in completeness.sizes if key not in referenced)
    return report


@dataclass(slots=True)
class _Plan:
    """What there must be; some hundred bytes a shard, and as many a video: a retry plans some of them again."""

    head: PlanHead
    _videos: set[bytes] = field(default_factory=set)
    _shards: dict[int, tuple[str, bytes]] = field(default_factory=dict)

    @classmethod
    def read(cls, store: ObjectStore, job_id: str, report: Report) -> _Plan:
        plan = cls(PlanHead())

        def add(shard: PlannedShard) -> None:
            plan._shards[shard.ordinal] = (shard.plan_hash, _digest(shard.videos))
            plan._videos.update(hashlib.blake2b(key.encode(), digest_size=16).digest() for key in shard.videos)

        try:
            plan.head = read_plan(store, job_id, add)
        except IntegrityError as error:
            report.problem(str(error))
        return plan

    @property
    def num_videos(self) -> int:
        return len(self._videos)

    def check(self, record: CommitRecord, report: Report) -> None:
        """A record must be that of a planned shard, with its videos in their order."""
        if record.shard_id != shard_id(record.job_id, record.ordinal):
            report.problem(f"the record of shard {record.shard_id} says that it is number {record.ordinal}")
        planned = self._shards.get(record.ordinal)
        if planned is None:
            if self.head.complete:
                report.problem(f"the record of shard {record.shard_id} is that of no planned shard")
        elif record.plan_hash != planned[0]:
            report.problem(f"the record of shard {record.shard_id} was made from another plan")
        elif _digest(tuple(video.key for video in record.videos)) != planned[1]:
            report.problem(f"the record of shard {record.shard_id} has other videos than were planned")


class _Index:
    """What was made from the records when the job had ended, held against them as they come by.

    Where the job runs again for a retry, the index is that of before, and says nothing about the records of now.
    """

    def __init__(self, store: ObjectStore, described: dict[str, Any], report: Report) -> None:
        self._described, self._report = described, report
        self._index = DatasetIndex(store)
        self._meta = _Listed(META_KEY, (tuple(r.values()) for r in self._index.rows(_META_COLUMNS)), report)
        self._failures = _Listed(FAILURES_KEY, _failures(store), report)
        self._shards = _Listed(DATASET_KEY, _described_shards(described), report)
        self._lost: list[tuple[str, tuple[Any, ...]]] = []  # until it is known which of them a retry replaced
        self._records = hashlib.sha256()
        self._knows_records = "records_sha256" in described  # not in what earlier releases wrote

    @classmethod
    def of(
        cls, store: ObjectStore, described: dict[str, Any] | None, plan: PlanHead, report: Report
    ) -> _Index | _NoIndex:
        if described is None:
            return _NoIndex(report, plan)
        of_then = described.get("plan") or {}
        if of_then.get("sha256") not in (None, *plan.digests):
            report.problem(f"the plan is not the one that {DATASET_KEY} was made from")
        elif of_then.get("sha256") not in (None, plan.sha256):
            return _NoIndex(report, plan)
        report.finished = True
        try:
            return cls(store, described, report)
        except (IntegrityError, ObjectMissing) as error:
            report.problem(str(error))
            return _NoIndex(report, plan)

    def add(self, record: CommitRecord, digest: str) -> None:
        for video in record.videos:
            for sample in video.samples:
                self._meta.expect((sample.key, sample.num_frames, record.tar_name))
            if not video.samples:
                self._lost.append((record.shard_id, (video.key, str(video.status), video.error_code)))
        objects = ((o.key, o.size_bytes, o.sha256) for o in record.objects)
        self._records.update(digest.encode())
        self._shards.expect((record.shard_id, digest if self._knows_records else None, *objects))

    def end(self, completeness: Completeness) -> None:
        report, expected = self._report, self._described.get("totals", {})
        try:
            for shard, row in self._lost:
                if (row[0], shard) not in completeness.replaced:
                    self._failures.expect(row)
            for listed in (self._meta, self._failures, self._shards):
                listed.end()
        except (IntegrityError, ObjectMissing) as error:
            report.problem(str(error))
        self._index.close()
        try:
            report.totals = completeness.close(expected.get("shards"), expected.get("videos"))
        except IntegrityError as error:
            report.problem(str(error))
            report.totals = completeness.totals
        if asdict(report.totals) != {"superseded": 0, **expected}:  # earlier releases knew no retries
            report.problem(f"{DATASET_KEY} states other totals than the commit records")
        if self._described.get("records_sha256") not in (None, self._records.hexdigest()):
            report.problem(f"the commit records are not those that {DATASET_KEY} was made from")


@dataclass(slots=True)
class _NoIndex:
    """A job that has not ended: there is nothing to hold the records against but the plan."""

    report: Report
    plan: PlanHead

    def add(self, record: CommitRecord, digest: str) -> None:
        return

    def end(self, completeness: Completeness) -> None:
        self.report.totals = completeness.totals


class _Listed:
    """What a file of the data set lists, compared with the records as they come by, in the same order."""

    def __init__(self, name: str, rows: Iterator[tuple[Any, ...]], report: Report) -> None:
        self._name, self._rows, self._report = name, rows, report
        self._wrong = False

    def expect(self, row: tuple[Any, ...]) -> None:
        found = next(self._rows, None)
        if found != row and not self._wrong:  # after the first difference all that follows differs
            self._wrong = True
            shown = "ends" if found is None else f"says {found[:3]}"
            self._report.problem(f"{self._name} {shown} where the commit records say {row[:3]}")

    def end(self) -> None:
        if not self._wrong and (found := next(self._rows, None)) is not None:
            self._report.problem(f"{self._name} lists {found[0]}, which no commit record has")


def _described(store: ObjectStore, report: Report) -> dict[str, Any] | None:
    """What `dataset.json` says; None if there is none: the job has not ended."""
    try:
        described = json.loads(store.get_bytes(DATASET_KEY))
    except ObjectMissing:
        return None
    except ValueError:
        report.problem(f"{DATASET_KEY} is damaged")
        return None
    if isinstance(described, dict) and isinstance(described.get("shards"), list) and "job_id" in described:
        return described
    report.problem(f"{DATASET_KEY} does not describe a data set")
    return None


def _owner(store: ObjectStore, report: Report) -> str | None:
    """The job that began to write here."""
    try:
        return str(json.loads(store.get_bytes(JOB_KEY))["job_id"])
    except ObjectMissing:
        report.problem(f"{DATASET_KEY} and {JOB_KEY} are missing: this is not the output of a job")
    except (ValueError, KeyError, TypeError):
        report.problem(f"{JOB_KEY} is damaged")
    return None


def _check_known(record: CommitRecord, digest: str, database: dict[str, ShardDigest], report: Report) -> None:
    """A record is the one that the database was told of."""
    shard = database.get(record.shard_id)
    if shard is None:
        report.problem(f"the database has no shard {record.shard_id}, whose record is here")
    elif record.plan_hash != shard.plan_hash:
        report.problem(f"the record of shard {record.shard_id} was made from another plan than the database has")
    elif shard.record_sha256 not in (None, digest):
        report.problem(f"the record of shard {record.shard_id} is not the one that the database knows")


def _check_committed(completeness: Completeness, database: dict[str, ShardDigest], report: Report) -> None:
    """What the database holds for committed has its record here."""
    there = completeness.ordinals
    for shard in database.values():
        if shard.state is ShardState.COMMITTED and shard.ordinal not in there:
            report.problem(f"shard {shard.id} is committed, says the database, and its record is not here")


def _digest(keys: tuple[str, ...]) -> bytes:
    return hashlib.blake2b("\n".join(keys).encode(), digest_size=16).digest()


def _described_shards(described: dict[str, Any]) -> Iterator[tuple[Any, ...]]:
    for shard in described["shards"]:
        objects = ((o.get("key"), o.get("size_bytes"), o.get("sha256")) for o in shard.get("objects", ()))
        yield (shard.get("shard_id"), shard.get("record_sha256"), *objects)


def _failures(store: ObjectStore) -> Iterator[tuple[Any, ...]]:
    with open_object(store, FAILURES_KEY) as file:
        with parquet_errors(FAILURES_KEY):
            table = pq.read_table(pa.PythonFile(file, mode="r"), columns=list(_FAILURE_COLUMNS))
        for batch in table.to_batches(max_chunksize=1000):
            yield from (tuple(row.values()) for row in batch.to_pylist())


def _read_back(store: ObjectStore, record: CommitRecord, o: PayloadObject, report: Report) -> int:
    """Fetch one tar and compare it with its record; returns its size."""
    keys = sorted(sample.key for video in record.videos for sample in video.samples)
    with tempfile.TemporaryDirectory(prefix="verify-") as name:
        path = Path(name) / f"{o.attribute}.tar"
        store.download(o.key, path)
        size = path.stat().st_size
        if sha256_of(path) != o.sha256:
            report.problem(f"{o.key} does not have the sha256 of its record")
            return size
        try:
            index = index_tar(path)
            check_keys({o.attribute: index}, keys)
            check_members(o.attribute, index)
            if index != o.members:
                report.problem(f"{o.key} has members elsewhere than its record says")
        except IntegrityError as error:
            report.problem(f"{o.key}: {error}")
        return size
