"""Transitions of jobs: creation, cancellation, failure, the end."""

from __future__ import annotations

import posixpath
from datetime import datetime, timedelta
from typing import Any

from sqlalchemy import Row, and_, func, insert, select, update
from ulid import ULID

from services.domain.control import JobControl
from services.domain.errors import InvalidTransition, JobNotCancellable, JobNotFound, OutputInUse
from services.domain.events import EventKind, job_event
from services.domain.models import JobSpec
from services.domain.states import JOB_TRANSITIONS, JobState, ShardState
from services.store.base import Deferral
from services.store.database import Tx
from services.store.rows import control_columns
from services.store.schema import in_state, jobs, shards
from services.store.tenants import admit, make_known

# Serialises the creation of jobs in PostgreSQL, so that ids grow and the check of the output cannot be overtaken.
_CREATE_LOCK = 0x6A6F6273


# What a job looks like that moves along.
NO_FAILURES: dict[str, Any] = {"failures": 0, "failing_since": None, "not_before": None}

# Beyond any wait that somebody asks for, and far from where a float overflows.
_MAX_DOUBLINGS = 64


def owns(tenant: str | None, job: Row[Any]) -> bool:
    """Whether a job exists for a tenant; None is the service itself."""
    return tenant is None or bool(job.tenant == tenant)


def lock_job(tx: Tx, job_id: str, tenant: str | None = None) -> Row[Any]:
    """Read a job's row for a change. Whoever changes a job's shards or counters takes this lock first.

    It is the lock that lets rows refer to the job meanwhile (`FOR NO KEY UPDATE`): a claim, which locks shards only,
    can write its event.
    """
    row = tx.first(select(jobs).where(jobs.c.id == job_id).with_for_update(key_share=True))
    if row is None or not owns(tenant, row):
        raise JobNotFound(f"there is no job {job_id!r}")
    return row


def move_job(tx: Tx, job: Row[Any], to: JobState, *, event_data: dict[str, Any] | None = None, **columns: Any) -> None:
    """Take one step of the job's state machine and write its event."""
    if to not in JOB_TRANSITIONS[JobState(job.state)]:
        raise InvalidTransition(f"job {job.id} is {job.state}: it cannot become {to.value}")
    if to.terminal:
        columns.update(finished_at=tx.now, **NO_FAILURES)
    tx.run(update(jobs).where(jobs.c.id == job.id).values(state=to.value, updated_at=tx.now, **columns))
    tx.emit(job.id, job_event(to), **(event_data or {}))


def settle_cancelling(tx: Tx, job_id: str) -> None:
    """Cancelling -> cancelled as soon as no shard of the job is leased."""
    job = lock_job(tx, job_id)
    if JobState(job.state) is not JobState.CANCELLING:
        return
    leased = select(shards.c.id).where(shards.c.job_id == job_id, in_state(shards.c.state, ShardState.LEASED))
    if tx.first(leased.limit(1)) is None:
        move_job(tx, job, JobState.CANCELLED)


def canonical_output(output: str) -> str:
    """One spelling per location, so that two jobs cannot own it under two names."""
    if output.startswith("s3://"):
        bucket, _, prefix = output.removeprefix("s3://").partition("/")
        return f"s3://{bucket}/{prefix.strip('/')}".rstrip("/")
    return posixpath.normpath(output)


def create_job(tx: Tx, spec: JobSpec, control: JobControl, tenant: str) -> str:
    """A new job; gives its id.

    Raises:
        InvalidRequest, OutputInUse, QuotaExceeded: See `Store.create_job`.
    """
    if tx.conn.dialect.name == "postgresql":
        tx.run(select(func.pg_advisory_xact_lock(_CREATE_LOCK)))
    output = canonical_output(spec.output)
    ended_without_a_trace = and_(jobs.c.state.in_([JobState.FAILED, JobState.CANCELLED]), jobs.c.shards_total == 0)
    owner = tx.first(
        select(jobs.c.id, jobs.c.state, jobs.c.tenant).where(jobs.c.output == output, ~ended_without_a_trace)
    )
    if owner is not None:
        whose = f"job {owner.id} ({owner.state})" if owns(tenant, owner) else "a job of another tenant"
        raise OutputInUse(
            f"output {spec.output!r} belongs to {whose}, "
            "and stays with the first job that wrote to it; choose another folder"
        )

    make_known(tx, tenant)
    admit(tx, tenant, jobs_more=1, videos_more=0)
    job_id = _next_id(tx)
    tx.run(
        insert(jobs).values(
            id=job_id,
            tenant=tenant,
            spec=spec.to_json(),
            output=output,
            state=JobState.QUEUED.value,
            created_at=tx.now,
            updated_at=tx.now,
            **control_columns(control, tx.now),
        )
    )
    tx.emit(job_id, EventKind.JOB_QUEUED, name=spec.name)
    return job_id


def _next_id(tx: Tx) -> str:
    """A ULID of the database's clock, later than every other: jobs sort by age also within one tick of the clock."""
    moment: datetime = tx.now
    newest = tx.run(select(func.max(jobs.c.id))).scalar_one()
    if newest is not None:
        moment = max(moment, ULID.from_str(newest.removeprefix("job_")).datetime + timedelta(milliseconds=1))
    return f"job_{ULID.from_datetime(moment)}"


def request_cancel(tx: Tx, job_id: str, tenant: str | None) -> None:
    """See `Store.request_cancel`."""
    job = lock_job(tx, job_id, tenant)
    state = JobState(job.state)
    if state is JobState.CANCELLING:
        return
    if JobState.CANCELLING not in JOB_TRANSITIONS[state]:
        raise JobNotCancellable(f"job {job_id} is {state.value}: it cannot be cancelled any more")
    move_job(tx, job, JobState.CANCELLING)
    _cancel_pending(tx, job_id)
    settle_cancelling(tx, job_id)


def is_planned_by(job: Row[Any], fence: int) -> bool:
    """Whether this planner's word counts. One whose time ran out, but whom nobody replaced, may go on."""
    return JobState(job.state) is JobState.RUNNING and not job.planned and bool(job.planning_fence == fence)


def fail_job(tx: Tx, job_id: str, code: str, message: str, planning_fence: int | None = None) -> None:
    """See `Store.fail_job`."""
    job = lock_job(tx, job_id)
    if planning_fence is not None and not is_planned_by(job, planning_fence):
        return
    if JobState.FAILED not in JOB_TRANSITIONS[JobState(job.state)]:
        return
    error = {"error_code": code, "error_message": message}
    move_job(tx, job, JobState.FAILED, event_data=error, **error)
    _cancel_pending(tx, job_id)


def defer_job(tx: Tx, job_id: str, base_s: float, max_s: float, planning_fence: int | None) -> Deferral:
    """See `Store.defer_job`."""
    job = lock_job(tx, job_id)
    if planning_fence is not None and not is_planned_by(job, planning_fence):
        return Deferral(0, 0.0, 0.0)
    wait_s = min(max_s, base_s * 2.0 ** min(job.failures, _MAX_DOUBLINGS))
    since = job.failing_since or tx.now
    tx.run(
        update(jobs)
        .where(jobs.c.id == job_id)
        .values(
            failures=job.failures + 1,
            failing_since=since,
            not_before=tx.now + timedelta(seconds=wait_s),
            planning_holder=None,
            planning_expires_at=None,
        )
    )
    return Deferral(job.failures + 1, (tx.now - since).total_seconds(), wait_s)


def begin_finalizing(tx: Tx, job_id: str) -> bool:
    """Running -> finalizing if every shard is settled; True if the job is finalizing now."""
    job = lock_job(tx, job_id)
    if JobState(job.state) is JobState.FINALIZING:
        return True
    if JobState(job.state) is not JobState.RUNNING or not job.planned or job.shards_committed != job.shards_total:
        return False
    move_job(tx, job, JobState.FINALIZING)
    return True


def finish_job(tx: Tx, job_id: str) -> None:
    """See `Store.finish_job`. Idempotent."""
    job = lock_job(tx, job_id)
    if JobState(job.state) in (JobState.SUCCEEDED, JobState.SUCCEEDED_WITH_ERRORS):
        return
    with_errors = job.videos_failed + job.videos_quarantined > 0
    counts = {
        "videos_succeeded": job.videos_succeeded,
        "videos_failed": job.videos_failed,
        "videos_quarantined": job.videos_quarantined,
    }
    move_job(tx, job, JobState.SUCCEEDED_WITH_ERRORS if with_errors else JobState.SUCCEEDED, event_data=counts)


def finish_sweep(tx: Tx, job_id: str) -> None:
    """See `Store.finish_sweep`. A job that was retried meanwhile is swept again when it ends."""
    if not JobState(lock_job(tx, job_id).state).terminal:
        return
    tx.run(update(jobs).where(jobs.c.id == job_id).values(swept=True, **NO_FAILURES))


def _cancel_pending(tx: Tx, job_id: str) -> None:
    tx.run(
        update(shards)
        .where(shards.c.job_id == job_id, in_state(shards.c.state, ShardState.PENDING))
        .values(state=ShardState.CANCELLED.value)
    )
