"""Read the truth of results back, so that a database that crashed or vanished can be repaired."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator

from services.commit.layout import commit_key, commit_prefix
from services.commit.protocol import read_record
from services.domain.errors import IntegrityError, ObjectMissing
from services.domain.models import CommitRecord
from services.storage.base import ObjectStore


def committed_records(store: ObjectStore, job_id: str) -> Iterator[CommitRecord]:
    """The records of a job in the order of shard ids, one at a time.

    Raises:
        IntegrityError: A record is damaged or does not belong under its name.
    """
    return (record for record, _ in stored_records(store, job_id))


def stored_records(store: ObjectStore, job_id: str) -> Iterator[tuple[CommitRecord, str]]:
    """`committed_records`, each with the sha256 of its bytes."""
    for info in store.list(commit_prefix(job_id)):
        data = store.get_bytes(info.key)
        record = read_record(data, f"{store.uri}/{info.key}")
        if commit_key(record.job_id, record.shard_id) != info.key or record.job_id != job_id:
            raise IntegrityError(f"{store.uri}/{info.key} is the record of shard {record.shard_id}, not of its name")
        yield record, hashlib.sha256(data).hexdigest()


def committed_record(store: ObjectStore, job_id: str, shard_id: str) -> CommitRecord | None:
    """The record of one shard, None if it is not committed."""
    key = commit_key(job_id, shard_id)
    try:
        return read_record(store.get_bytes(key), f"{store.uri}/{key}")
    except ObjectMissing:
        return None
