"""Who may commit, where the output itself cannot decide it.

An object store that honours `If-None-Match: *` decides between two writers of a shard's record. Where it does not, the
row of the shard here does: `UPDATE ... WHERE record IS NULL AND state = 'leased' AND fence = ?` is then the commit
point. The record's bytes stay in the row until they are known to lie in the output, so that whoever comes after a
crash can put them there.
"""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import insert, select, update

from services.domain.errors import JobNotFound
from services.domain.events import EventKind
from services.domain.models import CommitRecord
from services.domain.states import ShardState
from services.store.database import Tx
from services.store.jobs import is_planned_by, lock_job
from services.store.leases import is_current, lock_shard
from services.store.schema import jobs, shards, tar_names


def settle_commit_point(tx: Tx, job_id: str, planning_fence: int, create_once: bool) -> bool | None:
    """See `Store.settle_commit_point`."""
    job = lock_job(tx, job_id)
    if job.create_once is not None:
        return bool(job.create_once)
    if not is_planned_by(job, planning_fence):
        return None
    tx.run(update(jobs).where(jobs.c.id == job_id).values(create_once=create_once, updated_at=tx.now))
    tx.emit(job_id, EventKind.OUTPUT_PROBED, create_once=create_once, commit_point=_COMMIT_POINT[create_once])
    return create_once


def commit_point(tx: Tx, job_id: str) -> bool | None:
    """See `Store.commit_point`."""
    row = tx.first(select(jobs.c.create_once).where(jobs.c.id == job_id))
    if row is None:
        raise JobNotFound(f"there is no job {job_id!r}")
    return None if row.create_once is None else bool(row.create_once)


def take_tar_name(tx: Tx, shard: str, fence: int, names: Sequence[str]) -> str | None:
    """See `Store.take_tar_name`."""
    row = lock_shard(tx, shard)
    if not is_current(row, fence):
        return None
    taken = set(
        tx.run(select(tar_names.c.name).where(tar_names.c.job_id == row.job_id, tar_names.c.name.in_(names))).scalars()
    )
    name = next((name for name in names if name not in taken), None)
    if name is not None:
        tx.run(insert(tar_names).values(job_id=row.job_id, name=name, shard_id=shard, fence=fence))
    return name


def decide(tx: Tx, record: CommitRecord) -> bytes | None:
    """See `Store.decide_commit`."""
    row = lock_shard(tx, record.shard_id)
    if row.record is not None:
        return str(row.record).encode()
    if not is_current(row, record.fence):
        return None
    data = record.to_bytes()
    tx.run(update(shards).where(shards.c.id == row.id).values(record=data.decode()))
    return data


def decided(tx: Tx, job_id: str) -> list[str]:
    """See `Store.decided_commits`."""
    return list(
        tx.run(
            select(shards.c.record)
            .where(shards.c.job_id == job_id, shards.c.record.is_not(None), shards.c.state != _COMMITTED)
            .order_by(shards.c.ordinal)
        ).scalars()
    )


def decided_for(tx: Tx, shard: str) -> str | None:
    """The record that was decided for one shard and is not known to lie in the output."""
    found: str | None = tx.run(select(shards.c.record).where(shards.c.id == shard)).scalar_one_or_none()
    return found


_COMMITTED = ShardState.COMMITTED.value
_COMMIT_POINT = {True: "output", False: "database"}
