"""Delete what crashed and overtaken attempts left behind."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator
from dataclasses import dataclass

from services.commit.layout import claim_key
from services.commit.reconcile import committed_records
from services.domain.errors import ObjectMissing
from services.storage.base import ObjectInfo, ObjectStore
from services.storage.directory import DirectoryStore

logger = logging.getLogger(__name__)

# No write takes so long; what is older is of a process that died.
_STALE_TEMPORARY_S = 86_400.0


@dataclass(frozen=True, slots=True)
class GcReport:
    """What was deleted, and what was left because its shard has no record yet."""

    deleted: tuple[str, ...]
    deleted_bytes: int
    kept_unsettled: tuple[str, ...]


def collect_garbage(store: ObjectStore, job_id: str, *, abandoned: bool = False) -> GcReport:
    """Delete the payload of a job that no record refers to, and in a directory the unfinished files of dead writers.

    Touches only tar names that this job claimed, and only of shards that have a record: such a shard's other attempts
    can never commit any more. So it is safe beside running agents, and harmless to repeat.

    Args:
        abandoned: Also delete payload of shards without a record. Only for a cancelled or failed job that no agent can
            hold a lease of any more.
    """
    if isinstance(store, DirectoryStore):
        store.delete_stale_temporaries(_STALE_TEMPORARY_S)
    settled: set[str] = set()
    referenced: set[str] = set()
    for record in committed_records(store, job_id):
        settled.add(record.shard_id)
        referenced.update(o.key for o in record.objects)
    deleted: list[str] = []
    deleted_bytes = 0
    kept: list[str] = []
    for tar_name, objects in _payload_groups(store):
        if all(o.key in referenced for o in objects):
            continue
        claimed = _claim(store, tar_name)
        if claimed is None or claimed[0] != job_id:
            continue
        if claimed[1] not in settled and not abandoned:
            kept.append(tar_name)
            continue
        for info in objects:
            if info.key not in referenced:
                store.delete(info.key)
                deleted.append(info.key)
                deleted_bytes += info.size_bytes
    if deleted:
        logger.info("garbage collection of job %s: %d objects, %d bytes", job_id, len(deleted), deleted_bytes)
    return GcReport(tuple(deleted), deleted_bytes, tuple(kept))


def _payload_groups(store: ObjectStore) -> Iterator[tuple[str, list[ObjectInfo]]]:
    """(tar name, its objects): the listing is in key order, so a group is complete when the next one begins."""
    name: str | None = None
    group: list[ObjectInfo] = []
    for info in store.list("payload/"):
        parts = info.key.split("/")
        if len(parts) != 3:
            continue
        if parts[1] != name:
            if name is not None:
                yield name, group
            name, group = parts[1], []
        group.append(info)
    if name is not None:
        yield name, group


def _claim(store: ObjectStore, tar_name: str) -> tuple[str, str] | None:
    """(job id, shard id) of who took a tar name; None if it is not known, and then nothing may be deleted."""
    try:
        claim = json.loads(store.get_bytes(claim_key(tar_name)))
        return str(claim["job_id"]), str(claim["shard_id"])
    except (ObjectMissing, ValueError, KeyError, TypeError):
        return None
