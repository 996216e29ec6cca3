"""Transitions of planning: one planner at a time, told apart by a fence.

All of them lock the job first, so that a planner that was replaced is refused however late its statement arrives.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from datetime import timedelta
from typing import Any

from sqlalchemy import Row, insert, select, update

from services.domain.control import PauseReason
from services.domain.errors import InvalidTransition, QuotaExceeded
from services.domain.events import EventKind
from services.domain.models import ShardPlan, shard_id
from services.domain.states import JobState, ShardState, VideoStatus
from services.store.control import pause
from services.store.database import Tx
from services.store.jobs import NO_FAILURES, is_planned_by, lock_job, move_job
from services.store.schema import jobs, shards, videos
from services.store.tenants import admit


def begin(tx: Tx, job_id: str, holder: str, ttl_s: float) -> int | None:
    """See `Store.begin_planning`."""
    job = lock_job(tx, job_id)
    state = JobState(job.state)
    if state is not JobState.QUEUED and (state is not JobState.RUNNING or job.planned):
        return None
    if job.planning_expires_at is not None and job.planning_expires_at > tx.now and job.planning_holder != holder:
        return None
    if job.not_before is not None and job.not_before > tx.now:
        return None
    if state is JobState.QUEUED:
        move_job(tx, job, JobState.RUNNING, started_at=tx.now)
    fence = int(job.planning_fence) + 1
    _change(tx, job_id, planning_holder=holder, planning_fence=fence, planning_expires_at=_until(tx, ttl_s))
    return fence


def renew(tx: Tx, job_id: str, fence: int, ttl_s: float) -> bool:
    """See `Store.renew_planning`."""
    if not is_planned_by(lock_job(tx, job_id), fence):
        return False
    _change(tx, job_id, planning_expires_at=_until(tx, ttl_s))
    return True


def add_shards(tx: Tx, job_id: str, fence: int, plans: Iterable[ShardPlan], ttl_s: float) -> bool:
    """See `Store.add_shards`."""
    job = lock_job(tx, job_id)
    if not is_planned_by(job, fence):
        return False
    _change(tx, job_id, planning_expires_at=_until(tx, ttl_s))
    new = _not_there_yet(tx, job, plans)
    if not new:
        return True
    num_videos = sum(len(plan.videos) for plan in new)
    try:
        admit(tx, job.tenant, jobs_more=0, videos_more=num_videos)
    except QuotaExceeded as error:
        pause(tx, job, PauseReason.TENANT_VIDEOS, str(error))
        return False
    tx.run(insert(shards), [shard_row(job_id, plan) for plan in new])
    tx.run(insert(videos), [row for plan in new for row in _video_rows(job_id, plan)])
    totals = {"shards_total": jobs.c.shards_total + len(new), "videos_total": jobs.c.videos_total + num_videos}
    _change(tx, job_id, **totals, **NO_FAILURES)
    tx.emit(job_id, EventKind.SHARDS_PLANNED, shards=len(new), videos=num_videos)
    return True


def finish(tx: Tx, job_id: str, fence: int) -> bool:
    """See `Store.finish_planning`."""
    job = lock_job(tx, job_id)
    if not is_planned_by(job, fence):
        return False
    _change(tx, job_id, planned=True, planning_holder=None, planning_expires_at=None, **NO_FAILURES)
    tx.emit(job_id, EventKind.PLANNING_FINISHED, shards=job.shards_total, videos=job.videos_total)
    return True


def _not_there_yet(tx: Tx, job: Row[Any], plans: Iterable[ShardPlan]) -> Sequence[ShardPlan]:
    """The plans without a shard, by ordinal.

    An ordinal with other videos is an error and not a repetition: leaving it out would lose its videos without a word.
    """
    wanted = {plan.ordinal: plan for plan in plans}
    there = tx.rows(
        select(shards.c.ordinal, shards.c.plan_hash).where(
            shards.c.job_id == job.id, shards.c.ordinal.in_(list(wanted))
        )
    )
    for shard in there:
        if wanted.pop(shard.ordinal).plan_hash != shard.plan_hash:
            raise InvalidTransition(f"shard {shard.ordinal} of job {job.id} is planned with other videos")
    return [plan for _, plan in sorted(wanted.items())]


def shard_row(job_id: str, plan: ShardPlan) -> dict[str, Any]:
    return {
        "id": shard_id(job_id, plan.ordinal),
        "job_id": job_id,
        "ordinal": plan.ordinal,
        "state": ShardState.PENDING.value,
        "plan_hash": plan.plan_hash,
        "num_videos": len(plan.videos),
        "input_bytes": sum(v.size_bytes for v in plan.videos),
    }


def _video_rows(job_id: str, plan: ShardPlan) -> list[dict[str, Any]]:
    return [
        {
            "job_id": job_id,
            "key": video.key,
            "shard_id": shard_id(job_id, plan.ordinal),
            "position": position,
            "uri": video.uri,
            "size_bytes": video.size_bytes,
            "etag": video.etag,
            "status": VideoStatus.PENDING.value,
        }
        for position, video in enumerate(plan.videos)
    ]


def _change(tx: Tx, job_id: str, **columns: Any) -> None:
    tx.run(update(jobs).where(jobs.c.id == job_id).values(updated_at=tx.now, **columns))


def _until(tx: Tx, ttl_s: float) -> Any:
    return tx.now + timedelta(seconds=ttl_s)
