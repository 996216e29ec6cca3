"""From the commit records of a finished job to an indexed, described data set.

Reads records only, one at a time, so a million videos need little memory. Running it again writes the same bytes.
`dataset.json` is written last: where it lies, the data set is complete.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import tempfile
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from services.commit.plan import read_plan
from services.commit.reconcile import stored_records
from services.dataset.card import dataset_card
from services.dataset.schema import (
    CARD_KEY,
    DATASET_KEY,
    FAILURES_KEY,
    FAILURES_SCHEMA,
    META_KEY,
    SCHEMA_VERSION,
    failure_row,
    meta_row,
    meta_schema,
    public_spec,
)
from services.domain.errors import IntegrityError
from services.domain.models import CommitRecord, JobSpec
from services.domain.states import VideoStatus
from services.storage.base import ObjectStore

_ROW_GROUP = 10_000
_ALL_FAILURES = "failures-of-all-records.parquet"


@dataclass(slots=True)
class Totals:
    """What a data set holds.

    Attributes:
        superseded: Rows of failures in the records that rows of a later retry took the place of: the records together
            have `videos + superseded` rows.
    """

    shards: int = 0
    videos: int = 0
    succeeded: int = 0
    failed: int = 0
    quarantined: int = 0
    superseded: int = 0
    frames: int = 0
    objects: int = 0
    size_bytes: int = 0
    duration_s: float = 0.0


@dataclass(slots=True)
class Completeness:
    """Checks a stream of records: every shard once, every video once, every object present with its size.

    A video may occur again in the record of a later retry, if it had failed before; then only its last row counts.

    Memory: some hundred bytes per object and per video.

    Attributes:
        replaced: (video key, shard id) of rows that do not count any more.
    """

    sizes: dict[str, int]
    totals: Totals = field(default_factory=Totals)
    _ordinals: set[int] = field(default_factory=set)
    replaced: set[tuple[str, str]] = field(default_factory=set)
    _videos: set[bytes] = field(default_factory=set)
    _lost: dict[bytes, tuple[VideoStatus, str, int]] = field(default_factory=dict)

    @classmethod
    def of(cls, store: ObjectStore) -> Completeness:
        """One listing of the payload takes the place of a request per object."""
        return cls({info.key: info.size_bytes for info in store.list("payload/")})

    def add(self, record: CommitRecord) -> None:
        """Raises IntegrityError, naming what is missing, double or of another size."""
        totals = self.totals
        if record.ordinal in self._ordinals:
            raise IntegrityError(f"shard number {record.ordinal} has two commit records, one is {record.shard_id}")
        self._ordinals.add(record.ordinal)
        totals.shards += 1
        for o in record.objects:
            found = self.sizes.get(o.key)
            if found is None:
                raise IntegrityError(f"{o.key} is missing, although shard {record.shard_id} is committed")
            if found != o.size_bytes:
                raise IntegrityError(f"{o.key} has {found} bytes, its record says {o.size_bytes}")
            totals.objects += 1
            totals.size_bytes += o.size_bytes
        for video in record.videos:
            digest = hashlib.blake2b(video.key.encode(), digest_size=16).digest()
            if digest in self._videos:
                self._replace(digest, video.key, record)
            self._videos.add(digest)
            if video.status in (VideoStatus.FAILED, VideoStatus.QUARANTINED):
                self._lost[digest] = (video.status, record.shard_id, record.retry)
            totals.videos += 1
            if video.status is VideoStatus.SUCCEEDED:
                totals.succeeded += 1
                totals.frames += video.num_frames or 0
                totals.duration_s = round(totals.duration_s + (video.duration_s or 0.0), 6)
            elif video.status is VideoStatus.QUARANTINED:
                totals.quarantined += 1
            elif video.status is VideoStatus.FAILED:
                totals.failed += 1
            else:
                raise IntegrityError(f"video {video.key} of shard {record.shard_id} has no outcome")

    @property
    def ordinals(self) -> frozenset[int]:
        """Numbers of the shards that have a record."""
        return frozenset(self._ordinals)

    def _replace(self, digest: bytes, key: str, record: CommitRecord) -> None:
        """Take back the row of a failure that is followed by one of a later retry."""
        status, shard, retry = self._lost.pop(digest, (VideoStatus.SUCCEEDED, "", 0))
        if status is VideoStatus.SUCCEEDED or record.retry <= retry:
            raise IntegrityError(f"video {key} occurs twice, the second time in shard {record.shard_id}")
        self.replaced.add((key, shard))
        totals = self.totals
        totals.superseded += 1
        totals.videos -= 1
        if status is VideoStatus.QUARANTINED:
            totals.quarantined -= 1
        else:
            totals.failed -= 1

    def close(self, num_shards: int | None, num_videos: int | None) -> Totals:
        """The totals, if they are what was planned; raises IntegrityError if not."""
        totals = self.totals
        expected = totals.shards if num_shards is None else num_shards
        if totals.shards != expected or self._ordinals != set(range(expected)):
            raise IntegrityError(f"{totals.shards} of {expected} shards are committed; the job is not complete")
        if num_videos is not None and totals.videos != num_videos:
            raise IntegrityError(f"the records account for {totals.videos} of {num_videos} videos")
        return totals


def finalise(
    store: ObjectStore,
    job_id: str,
    spec: JobSpec,
    *,
    num_shards: int,
    num_videos: int | None = None,
    scratch: Path | None = None,
) -> Totals:
    """Check completeness, then write `meta.parquet`, `failures.parquet`, `README.md` and `dataset.json`.

    Args:
        num_shards: As planned.
        num_videos: As planned; None skips this check (the shards' plans are still checked by number).
        scratch: Folder for temporary files.

    Raises:
        IntegrityError: The records are not exactly the planned shards and videos, or the payload is not what they say.
            Nothing was written.
        StorageError: The store refused.
    """
    records = hashlib.sha256()
    with tempfile.TemporaryDirectory(dir=scratch, prefix="finalise-") as name:
        folder = Path(name)
        completeness = Completeness.of(store)
        with (
            _RowWriter(folder / META_KEY, meta_schema(spec)) as meta,
            _RowWriter(folder / _ALL_FAILURES, FAILURES_SCHEMA) as failures,
            (folder / "shards").open("w", encoding="utf-8") as shards,
        ):
            for record, digest in stored_records(store, job_id):
                records.update(digest.encode())
                completeness.add(record)
                for video in record.videos:
                    for sample in video.samples:
                        meta.write(meta_row(record, sample))
                    if not video.samples:
                        failures.write(failure_row(record, video))
                shards.write(("" if completeness.totals.shards == 1 else ",\n") + json.dumps(_shard(record, digest)))
        totals = completeness.close(num_shards, num_videos)
        _leave_out(folder / _ALL_FAILURES, folder / FAILURES_KEY, completeness.replaced)
        description = {
            "schema_version": SCHEMA_VERSION,
            "job_id": job_id,
            "config_hash": spec.config_hash,
            "spec": public_spec(spec),
            "totals": asdict(totals),
            "records_sha256": records.hexdigest(),
            "plan": read_plan(store, job_id, lambda shard: None).to_json(),
        }
        _write_dataset_json(folder / DATASET_KEY, description, folder / "shards")
        (folder / CARD_KEY).write_text(dataset_card(job_id, spec, asdict(totals)), encoding="utf-8")
        for key in (META_KEY, FAILURES_KEY, CARD_KEY, DATASET_KEY):
            store.put_file(key, folder / key)
    return totals


class _RowWriter:
    """Rows to a parquet file in row groups of bounded size. An empty file still has its schema."""

    def __init__(self, path: Path, schema: pa.Schema) -> None:
        self._writer = pq.ParquetWriter(path, schema, compression="zstd")
        self._schema = schema
        self._rows: list[dict[str, Any]] = []

    def __enter__(self) -> _RowWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self._flush()
        self._writer.close()

    def write(self, row: dict[str, Any]) -> None:
        self._rows.append(row)
        if len(self._rows) >= _ROW_GROUP:
            self._flush()

    def _flush(self) -> None:
        if self._rows:
            self._writer.write_table(pa.Table.from_pylist(self._rows, schema=self._schema))
            self._rows.clear()


def _leave_out(source: Path, target: Path, replaced: set[tuple[str, str]]) -> None:
    """Copy the rows of failures that still count."""
    with _RowWriter(target, FAILURES_SCHEMA) as kept:
        for batch in pq.ParquetFile(source).iter_batches(batch_size=_ROW_GROUP):
            for row in batch.to_pylist():
                if (row["sequence"], row["shard_id"]) not in replaced:
                    kept.write(row)


def _shard(record: CommitRecord, digest: str) -> dict[str, Any]:
    return {
        "shard_id": record.shard_id,
        "ordinal": record.ordinal,
        "tar_name": record.tar_name,
        "videos": len(record.videos),
        "frames": record.frames,
        "plan_hash": record.plan_hash,
        "record_sha256": digest,
        "objects": [
            {"key": o.key, "attribute": o.attribute, "size_bytes": o.size_bytes, "sha256": o.sha256}
            for o in record.objects
        ],
    }


def _write_dataset_json(path: Path, description: dict[str, Any], shards: Path) -> None:
    """One shard per line; the list is copied, not parsed, because it may be long."""
    head = json.dumps(description, indent=1, sort_keys=True).removesuffix("\n}")
    with path.open("w", encoding="utf-8") as out, shards.open(encoding="utf-8") as lines:
        out.write(f'{head},\n "shards": [\n')
        shutil.copyfileobj(lines, out)
        out.write("\n]}\n")
