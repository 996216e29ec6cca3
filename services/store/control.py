"""Transitions of job control: pause, resume, change, and the limits that pause a job instead of failing it."""

from __future__ import annotations

from datetime import datetime
from typing import Any

from sqlalchemy import ColumnElement, Row, Select, and_, func, or_, select, update

from services.domain.control import Changes, JobControl, PauseReason
from services.domain.errors import JobEnded, JobNotPausable, JobNotResumable
from services.domain.events import EventKind
from services.domain.states import JOB_TRANSITIONS, JobState, ShardState, VideoStatus
from services.store.database import Tx
from services.store.jobs import lock_job, move_job
from services.store.rows import control_columns, control_of
from services.store.schema import in_state, jobs, shards, videos

_MOST_CODES = 5


def change_job(tx: Tx, job_id: str, tenant: str | None, changes: Changes) -> None:
    """See `Store.change_job`."""
    job = lock_job(tx, job_id, tenant)
    if JobState(job.state).terminal or JobState(job.state) is JobState.CANCELLING:
        raise JobEnded(f"job {job_id} is {job.state}: nothing about how it runs can be changed any more")
    before = control_of(job)
    wanted = {name: value for name, value in changes.items() if getattr(before, name) != value}
    if not wanted:
        return
    # Only what is asked for: a deadline that passed meanwhile must not get in the way of a new priority.
    columns = control_columns(JobControl(**wanted), tx.now)
    own = {"max_slot_hours": "max_slot_seconds"}
    named = {own.get(name, name) for name in wanted}
    tx.run(
        update(jobs)
        .where(jobs.c.id == job_id)
        .values(updated_at=tx.now, **{name: value for name, value in columns.items() if name in named})
    )
    shown = JobControl(**wanted).to_json()
    tx.emit(job_id, EventKind.JOB_UPDATED, **{name: shown[name] for name in wanted})


def request_pause(tx: Tx, job_id: str, tenant: str | None) -> None:
    """See `Store.request_pause`."""
    job = lock_job(tx, job_id, tenant)
    state = JobState(job.state)
    if state is JobState.PAUSED:
        return
    if JobState.PAUSED not in JOB_TRANSITIONS[state]:
        raise JobNotPausable(f"job {job_id} is {state.value}: it cannot be paused")
    pause(tx, job, PauseReason.REQUESTED, "somebody asked for it")


def pause(tx: Tx, job: Row[Any], reason: PauseReason, message: str, **report: Any) -> None:
    """Queued or running -> paused. A planner of the job stops at its next step, and another may take over at once."""
    move_job(
        tx,
        job,
        JobState.PAUSED,
        event_data={"reason": reason.value, "message": message, **report},
        pause_reason=reason.value,
        pause_message=message,
        planning_holder=None,
        planning_expires_at=None,
    )


def resume(tx: Tx, job_id: str, tenant: str | None) -> None:
    """See `Store.resume`."""
    job = lock_job(tx, job_id, tenant)
    state = JobState(job.state)
    if state in (JobState.QUEUED, JobState.RUNNING):
        return
    if state is not JobState.PAUSED:
        raise JobNotResumable(f"job {job_id} is {state.value}: it cannot be resumed")
    if (exceeded := _exceeded(tx, job)) is not None:
        raise JobNotResumable(f"job {job_id} would be paused again at once: {exceeded[1]}; change that first")
    to = JobState.QUEUED if job.started_at is None else JobState.RUNNING
    data = {"resumed": True, "paused_for": job.pause_reason}
    move_job(tx, job, to, event_data=data, pause_reason=None, pause_message=None, failures_since=tx.now)


def over_limits(now: datetime) -> Select[Any]:
    """Jobs that passed their deadline or may have used up their budget, by id."""
    unfinished = or_(~jobs.c.planned, jobs.c.shards_committed < jobs.c.shards_total)
    live = and_(jobs.c.state.in_([JobState.QUEUED.value, JobState.RUNNING.value]), unfinished)
    return select(jobs.c.id).where(live, or_(jobs.c.deadline <= now, jobs.c.max_slot_seconds.is_not(None)))


def pause_over_limit(tx: Tx, job_id: str) -> bool:
    """Pause a job that passed its deadline or used up its budget; whether it did."""
    job = lock_job(tx, job_id)
    if JobState(job.state) not in (JobState.QUEUED, JobState.RUNNING):
        return False
    if job.planned and job.shards_committed == job.shards_total:
        return False  # Nothing is left that would cost anything.
    exceeded = _exceeded(tx, job)
    if exceeded is None:
        return False
    pause(tx, job, *exceeded)
    return True


def live_slot_seconds(tx: Tx, of: ColumnElement[bool]) -> float:
    """Seconds that the live leases of some shards have lasted so far."""
    leased = select(shards.c.leased_at).where(of, in_state(shards.c.state, ShardState.LEASED))
    return sum(((tx.now - at).total_seconds() for at in tx.run(leased).scalars() if at is not None), 0.0)


def trip(tx: Tx, job_id: str) -> None:
    """Pause a running job if too many of the videos that were settled last have failed.

    Looks at whole shards, newest first, until they hold `failure_window` videos.
    """
    job = lock_job(tx, job_id)
    if JobState(job.state) is not JobState.RUNNING or job.max_failure_ratio is None:
        return
    if job.planned and job.shards_committed == job.shards_total:
        return
    committed = (
        select(shards.c.id, shards.c.num_videos, shards.c.videos_lost)
        .where(shards.c.job_id == job_id, in_state(shards.c.state, ShardState.COMMITTED))
        .order_by(shards.c.committed_at.desc())
        .limit(job.failure_window)
    )
    if job.failures_since is not None:
        committed = committed.where(shards.c.committed_at > job.failures_since)
    settled = lost = 0
    recent: list[str] = []
    for shard in tx.rows(committed):
        settled, lost = settled + shard.num_videos, lost + shard.videos_lost
        recent.append(shard.id)
        if settled >= job.failure_window:
            break
    if settled < job.failure_window or lost <= job.max_failure_ratio * settled:
        return
    failed = (
        select(videos.c.error_code, func.count().label("number"))
        .where(videos.c.shard_id.in_(recent), videos.c.status != VideoStatus.SUCCEEDED.value)
        .group_by(videos.c.error_code)
        .order_by(func.count().desc(), videos.c.error_code)
        .limit(_MOST_CODES)
    )
    most = {str(row.error_code): int(row.number) for row in tx.rows(failed)}
    named = ", ".join(f"{code} {number}" for code, number in most.items())
    message = f"{lost} of the last {settled} videos failed ({named}), more than {job.max_failure_ratio:.0%}"
    pause(tx, job, PauseReason.FAILURE_RATIO, message, settled=settled, lost=lost, error_codes=most)


def _exceeded(tx: Tx, job: Row[Any]) -> tuple[PauseReason, str] | None:
    """The limit that keeps a job from running, and its sentence."""
    if job.deadline is not None and job.deadline <= tx.now:
        return PauseReason.DEADLINE, f"its deadline was {job.deadline.isoformat()}"
    if job.max_slot_seconds is not None:
        used = job.slot_seconds + live_slot_seconds(tx, shards.c.job_id == job.id)
        if used >= job.max_slot_seconds:
            hours = f"{used / 3600:.3g} of {job.max_slot_seconds / 3600:.3g}"
            return PauseReason.SLOT_HOURS, f"it has used {hours} slot-hours"
    return None
