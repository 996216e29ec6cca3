"""The commit protocol: however many attempts race, crash or lose an answer, a shard exists once and whole.

1. `prepare_payload` builds the tars in scratch, reopens and verifies them, takes a tar name that no other call will
   ever take (a create-once claim), and uploads under it. Nobody refers to these objects yet, so a crash leaves only
   rubbish. It may run in a worker process; its result can be pickled and is JSON.
2. `write_record` asks whether the lease still holds (cheap, stops most zombies) and then creates the shard's record.
   This one create-once PUT is the commit point.

Where the output does not know create-once writes, the database is asked instead: it hands out the tar name, and
`write_decided` makes its row of the shard the commit point; the record then follows into the output, by whoever lives.

Two rules keep it safe. Bytes under a tar name are written by one call only, so a record can never point at bytes of
another attempt. And a payload is deleted only after another attempt's record has been seen: only then can the own
record never land any more, not even from a request that was thought lost.
"""

from __future__ import annotations

import hashlib
import json
import logging
import re
import shutil
import tempfile
import time
import uuid
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from services.commit.layout import attributes_of, claim_key, commit_key, payload_key, sample_files
from services.commit.tar_writer import write_tar
from services.commit.verify import verify_tar
from services.domain.errors import CommitConflict, IntegrityError, ObjectMissing, StorageError
from services.domain.models import CommitRecord, Lease, PayloadObject, VideoResult
from services.domain.states import VideoStatus
from services.storage.base import ObjectStore

logger = logging.getLogger(__name__)

DEFAULT_PREFIX = "vipe"
_NAME_TRIES = 64
_KEY = re.compile(r"[A-Za-z0-9_-]+")


@dataclass(frozen=True, slots=True)
class PreparedPayload:
    """Uploaded and verified, waiting for its record.

    Attributes:
        record: What `write_record` will create.
        build_s: Wall seconds to build and verify the tars.
        upload_s: Wall seconds to upload them.
    """

    record: CommitRecord
    build_s: float = 0.0
    upload_s: float = 0.0

    @property
    def size_bytes(self) -> int:
        return sum(o.size_bytes for o in self.record.objects)

    def to_json(self) -> dict[str, Any]:
        return {"record": self.record.to_bytes().decode(), "build_s": self.build_s, "upload_s": self.upload_s}

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> PreparedPayload:
        return cls(CommitRecord.from_bytes(data["record"].encode()), data["build_s"], data["upload_s"])


@dataclass(frozen=True, slots=True)
class CommitOutcome:
    """What became of an attempt.

    Attributes:
        kind: `committed`: the record is this attempt's. `adopted`: another attempt was first and its record counts; the
            own payload is deleted. `lost_lease`: nothing is committed, and this attempt may no longer do it; its
            payload is left to the garbage collection.
        record: The record that counts; None for `lost_lease`.
    """

    kind: Literal["committed", "adopted", "lost_lease"]
    record: CommitRecord | None


def prepare_payload(
    lease: Lease,
    results: Sequence[VideoResult],
    artifacts_root: Path,
    scratch: Path,
    store: ObjectStore,
    *,
    prefix: str = DEFAULT_PREFIX,
    tar_name: str | None = None,
) -> PreparedPayload:
    """Build, verify and upload the tars of a shard, and make its record without writing it.

    Args:
        results: One settled result for each video of the lease, in any order.
        artifacts_root: ViPE artifact layout (`pose/KEY.npz` ...) of the videos that succeeded.
        scratch: Folder for the tars; empty again afterwards.
        prefix: Start of the tar name, `[a-z0-9]+`.
        tar_name: A name that the database gave to this call alone; None takes one with a create-once claim.

    Raises:
        IntegrityError: Results do not match the lease, an artifact is missing, or the tars do not read back.
        StorageError: The store refused.
        OSError: Scratch is full or an artifact cannot be read.
    """
    videos = _settled(lease, results)
    keys = sorted(sample.key for video in videos for sample in video.samples)
    objects: list[PayloadObject] = []
    build_s = upload_s = 0.0
    if keys:
        scratch.mkdir(parents=True, exist_ok=True)
        folder = Path(tempfile.mkdtemp(prefix=f"{lease.shard_id}-", dir=scratch))
        try:
            started = time.monotonic()
            built = []
            for attribute in attributes_of(lease.spec.attributes):
                samples = (sample_files(artifacts_root, attribute, key) for key in keys)
                tar = write_tar(folder / f"{attribute}.tar", samples)
                built.append((attribute, tar, verify_tar(tar, attribute, keys)))
            build_s = time.monotonic() - started

            started = time.monotonic()
            if tar_name is None:
                tar_name = _claim_name(store, lease, prefix)
            else:  # Its claim only tells the garbage collection whose it is.
                store.put_bytes(claim_key(tar_name), _claim(lease))
            try:
                for attribute, tar, members in built:
                    key = payload_key(tar_name, attribute)
                    info = store.put_file(key, tar.path)
                    if info.size_bytes != tar.size_bytes:
                        raise IntegrityError(f"{store.uri}/{key} holds {info.size_bytes} of {tar.size_bytes} bytes")
                    objects.append(PayloadObject(attribute, key, tar.size_bytes, tar.sha256, members))
                    tar.path.unlink()
            except BaseException:
                _discard(store, [payload_key(tar_name, attribute) for attribute, _, _ in built])
                raise
            upload_s = time.monotonic() - started
        finally:
            shutil.rmtree(folder, ignore_errors=True)
    else:
        tar_name = None
    record = CommitRecord(
        job_id=lease.job_id,
        shard_id=lease.shard_id,
        ordinal=lease.ordinal,
        plan_hash=lease.plan_hash,
        config_hash=lease.spec.config_hash,
        attempt=lease.attempt,
        fence=lease.fence,
        holder=lease.holder,
        tar_name=tar_name,
        objects=tuple(objects),
        videos=videos,
        retry=lease.retry,
    )
    return PreparedPayload(record, build_s, upload_s)


def write_record(store: ObjectStore, prepared: PreparedPayload, holds: Callable[[], bool]) -> CommitOutcome:
    """Make the shard exist, or learn that it does. Idempotent: after an error, call it again.

    Args:
        holds: Asks the database whether the lease is still the shard's current one.

    Raises:
        CommitConflict: A record of another plan or configuration has this name.
        IntegrityError: The record that is there cannot be read.
        StorageError: The store did not answer; the record may or may not be there.
    """
    record = prepared.record
    key = commit_key(record.job_id, record.shard_id)
    data = record.to_bytes()
    if not holds():
        existing = _read(store, key)
        return CommitOutcome("lost_lease", None) if existing is None else _settle(store, prepared, key, existing)
    try:
        if store.create(key, data):
            return CommitOutcome("committed", record)
    except StorageError:
        # The answer was lost, not necessarily the request.
        if _read(store, key) != data:
            raise
        return CommitOutcome("committed", record)
    existing = _read(store, key)
    if existing is None:
        raise StorageError(f"{store.uri}/{key} was there and is gone; nothing may delete commit records")
    return _settle(store, prepared, key, existing)


def write_decided(
    store: ObjectStore, prepared: PreparedPayload, decide: Callable[[CommitRecord], bytes | None]
) -> CommitOutcome:
    """`write_record` where the database is the commit point. Idempotent: after an error, call it again.

    Args:
        decide: Atomically keeps the record if the lease is current and no record was kept; gives the one that counts,
            None if there is none.

    Raises:
        CommitConflict: A record of another plan or configuration has this name.
        IntegrityError: The record that is there cannot be read.
        StorageError: The store did not answer; what was decided stands, and somebody must put it there.
    """
    record = prepared.record
    key = commit_key(record.job_id, record.shard_id)
    if (existing := _read(store, key)) is not None:  # Its database may have been restored from before it.
        return _settle(store, prepared, key, existing)
    counts = decide(record)
    if counts is None:
        return CommitOutcome("lost_lease", None)
    store.put_bytes(key, counts)  # Only these bytes are ever put there, so it may be repeated, also late.
    return _settle(store, prepared, key, counts)


def read_record(data: bytes, where: str) -> CommitRecord:
    """Parse a record.

    Raises:
        IntegrityError: It is not one.
    """
    try:
        record = CommitRecord.from_bytes(data)
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise IntegrityError(f"the commit record {where} is damaged: {type(error).__name__}") from error
    if record.schema_version != 1:
        raise IntegrityError(f"the commit record {where} has schema {record.schema_version}, this version reads 1")
    return record


def _settle(store: ObjectStore, prepared: PreparedPayload, key: str, existing: bytes) -> CommitOutcome:
    """A record is there: the own one (its answer was lost), or the winner's."""
    mine = prepared.record
    if existing == mine.to_bytes():
        return CommitOutcome("committed", mine)
    winner = read_record(existing, f"{store.uri}/{key}")
    same = (winner.job_id, winner.shard_id, winner.plan_hash, winner.config_hash) == (
        mine.job_id,
        mine.shard_id,
        mine.plan_hash,
        mine.config_hash,
    )
    referenced = {o.key for o in winner.objects}
    _discard(store, [o.key for o in mine.objects if o.key not in referenced])
    if not same:
        raise CommitConflict(f"{store.uri}/{key} was made from another plan; give every job its own output")
    return CommitOutcome("adopted", winner)


def _settled(lease: Lease, results: Sequence[VideoResult]) -> tuple[VideoResult, ...]:
    """Results in the order of the lease; every video exactly once."""
    by_key = {r.key: r for r in results}
    planned = [v.key for v in lease.videos]
    if len(by_key) != len(results) or set(by_key) != set(planned) or len(set(planned)) != len(planned):
        raise IntegrityError(f"shard {lease.shard_id} needs exactly one result for each of its {len(planned)} videos")
    sample_keys = [sample.key for result in results for sample in result.samples]
    if len(set(sample_keys)) != len(sample_keys):
        raise IntegrityError(f"shard {lease.shard_id} has samples of the same key")
    if bad_keys := [key for key in (*planned, *sample_keys) if not _KEY.fullmatch(key)]:
        raise IntegrityError(f"shard {lease.shard_id} has keys that webdataset would split: {', '.join(bad_keys)}")
    if open_keys := [r.key for r in results if r.status is VideoStatus.PENDING]:
        raise IntegrityError(f"shard {lease.shard_id} has videos without an outcome: {', '.join(open_keys)}")
    return tuple(by_key[key] for key in planned)


def _claim_name(store: ObjectStore, lease: Lease, prefix: str) -> str:
    """A tar name that belongs to this call alone, forever.

    32 bits over 100,000 shards do collide, and an attempt may be prepared twice, so the name is taken with a
    create-once object whose content tells us apart. It stays, so that the garbage collection knows whose payload it is.
    """
    data = _claim(lease)
    for name in tar_names(lease, prefix):
        if store.create(claim_key(name), data) or _read(store, claim_key(name)) == data:
            return name
    raise StorageError(f"no free tar name for shard {lease.shard_id} in {store.uri}")


def tar_names(lease: Lease, prefix: str = DEFAULT_PREFIX) -> list[str]:
    """Names that an attempt may try to take, in this order."""
    sources = (f"{lease.shard_id}/{lease.attempt}/{lease.fence}/{number}" for number in range(_NAME_TRIES))
    return [f"{prefix}-{hashlib.sha256(source.encode()).hexdigest()[:8]}" for source in sources]


def _claim(lease: Lease) -> bytes:
    """Whose a tar name is; no two calls give the same."""
    claim = {
        "job_id": lease.job_id,
        "shard_id": lease.shard_id,
        "attempt": lease.attempt,
        "fence": lease.fence,
        "nonce": uuid.uuid4().hex,
    }
    return json.dumps(claim, sort_keys=True).encode()


def _read(store: ObjectStore, key: str) -> bytes | None:
    try:
        return store.get_bytes(key)
    except ObjectMissing:
        return None


def _discard(store: ObjectStore, keys: Sequence[str]) -> None:
    """Delete rubbish; what cannot be deleted now is left to the garbage collection."""
    for key in keys:
        try:
            store.delete(key)
        except StorageError as error:
            logger.warning("left %s behind: %s", key, error)
