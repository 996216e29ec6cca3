"""Is the data set what it says? Nothing is believed that was not counted here."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from services.commit.reconcile import committed_records
from services.commit.verify import check_keys, check_members, index_tar, sha256_of
from services.dataset.finalise import Completeness, Totals
from services.dataset.index import DatasetIndex, parquet_errors
from services.dataset.schema import DATASET_KEY, FAILURES_KEY, META_KEY
from services.domain.errors import IntegrityError, ObjectMissing
from services.domain.models import CommitRecord, PayloadObject
from services.domain.states import VideoStatus
from services.storage.base import ObjectStore
from services.storage.object_file import open_object
from services.storage.open import open_store

_MAX_PROBLEMS = 100
_META_COLUMNS = ("sequence", "num_frames", "tar_name")
_FAILURE_COLUMNS = ("sequence", "status", "error_code")


@dataclass(slots=True)
class Report:
    """The outcome of `verify`.

    Attributes:
        problems: One sentence each, the first hundred; empty means that the data set is whole.
        totals: Counted from the commit records: videos = succeeded + failed + quarantined.
        checked_bytes: Payload that was read back and hashed (`deep` only).
        orphans: Payload objects that no record refers to; not a problem, the garbage collection removes them.
    """

    uri: str
    job_id: str | None = None
    problems: list[str] = field(default_factory=list)
    totals: Totals = field(default_factory=Totals)
    checked_bytes: int = 0
    orphans: int = 0

    @property
    def ok(self) -> bool:
        return not self.problems

    @property
    def exit_code(self) -> int:
        return 0 if self.ok else 1

    def to_json(self) -> dict[str, Any]:
        return {**asdict(self), "ok": self.ok}

    def problem(self, text: str) -> None:
        if len(self.problems) < _MAX_PROBLEMS:
            self.problems.append(text)


def verify(source: ObjectStore | str, deep: bool = False) -> Report:
    """Check an output against its records: every shard and video once, every object with its size, the index equal to
    the records.

    Args:
        source: The output, or its address.
        deep: Also read every tar back: sha256, samples, order and member positions.

    Raises:
        StorageError: The store does not answer. What is wrong with the data set is in the report instead.
    """
    store = open_store(source) if isinstance(source, str) else source
    report = Report(uri=store.uri)
    described = _described(store, report)
    if described is None:
        return report
    report.job_id = str(described.get("job_id"))
    completeness = Completeness.of(store)
    referenced: set[str] = set()
    try:
        with DatasetIndex(store) as index:
            meta = _Listed(META_KEY, (tuple(r.values()) for r in index.rows(_META_COLUMNS)), report)
            failures = _Listed(FAILURES_KEY, _failures(store), report)
            shards = _Listed(DATASET_KEY, _described_shards(described), report)
            for record in committed_records(store, report.job_id):
                try:
                    completeness.add(record)
                except IntegrityError as error:
                    report.problem(str(error))
                for video in record.videos:
                    if video.status is VideoStatus.SUCCEEDED:
                        meta.expect((video.key, video.num_frames, record.tar_name))
                    else:
                        failures.expect((video.key, str(video.status), video.error_code))
                shards.expect((record.shard_id, *((o.key, o.size_bytes, o.sha256) for o in record.objects)))
                for o in record.objects:
                    referenced.add(o.key)
                    if deep and o.key in completeness.sizes:
                        report.checked_bytes += _read_back(store, record, o, report)
            for listed in (meta, failures, shards):
                listed.end()
    except (IntegrityError, ObjectMissing) as error:
        report.problem(str(error))
    expected = described.get("totals", {})
    try:
        report.totals = completeness.close(expected.get("shards"), expected.get("videos"))
    except IntegrityError as error:
        report.problem(str(error))
        report.totals = completeness.totals
    if asdict(report.totals) != expected:
        report.problem(f"{DATASET_KEY} states other totals than the commit records")
    report.orphans = sum(1 for key in completeness.sizes if key not in referenced)
    return report


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
    try:
        described = json.loads(store.get_bytes(DATASET_KEY))
        if isinstance(described, dict) and isinstance(described.get("shards"), list):
            return described
        report.problem(f"{DATASET_KEY} does not describe a data set")
    except ObjectMissing:
        report.problem(f"{DATASET_KEY} is missing; the job is not finalised")
    except ValueError:
        report.problem(f"{DATASET_KEY} is damaged")
    return None


def _described_shards(described: dict[str, Any]) -> Iterator[tuple[Any, ...]]:
    for shard in described["shards"]:
        objects = ((o.get("key"), o.get("size_bytes"), o.get("sha256")) for o in shard.get("objects", ()))
        yield (shard.get("shard_id"), *objects)


def _failures(store: ObjectStore) -> Iterator[tuple[Any, ...]]:
    with open_object(store, FAILURES_KEY) as file:
        with parquet_errors(FAILURES_KEY):
            table = pq.read_table(pa.PythonFile(file, mode="r"), columns=list(_FAILURE_COLUMNS))
        for batch in table.to_batches(max_chunksize=1000):
            yield from (tuple(row.values()) for row in batch.to_pylist())


def _read_back(store: ObjectStore, record: CommitRecord, o: PayloadObject, report: Report) -> int:
    """Fetch one tar and compare it with its record; returns its size."""
    keys = sorted(v.key for v in record.videos if v.status is VideoStatus.SUCCEEDED)
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
