"""Reads: rows become the domain's values, lists come in pages by key."""

from __future__ import annotations

from collections.abc import Collection
from datetime import datetime, timedelta
from typing import Any

from sqlalchemy import ColumnElement, Row, Select, and_, exists, func, or_, select

from services.domain.control import PauseReason
from services.domain.errors import InvalidPageToken, JobNotFound
from services.domain.models import (
    Event,
    Job,
    JobProgress,
    JobSpec,
    PlannedShard,
    Shard,
    ShardDigest,
    VideoRef,
    VideoResult,
)
from services.domain.states import JobState, ShardState, VideoStatus
from services.store.base import VideoRow
from services.store.database import Tx
from services.store.jobs import owns
from services.store.rows import control_of
from services.store.schema import events, in_state, jobs, shards, videos

# The recent past over which frames per second are counted.
_RATE_WINDOW_S = 120.0


def get_job(tx: Tx, job_id: str, tenant: str | None = None) -> Job:
    """See `Store.get_job`."""
    row = tx.first(select(jobs).where(jobs.c.id == job_id))
    if row is None or not owns(tenant, row):
        raise JobNotFound(f"there is no job {job_id!r}")
    return _job(tx, row)


def list_jobs(
    tx: Tx, tenant: str | None, limit: int, after: str | None, state: JobState | None
) -> tuple[list[Job], str | None]:
    """See `Store.list_jobs`."""
    query = select(jobs).order_by(jobs.c.id.desc())
    if tenant is not None:
        query = query.where(jobs.c.tenant == tenant)
    if after is not None:
        query = query.where(jobs.c.id < after)
    if state is not None:
        query = query.where(jobs.c.state == state.value)
    rows, cursor = _page(tx, query, limit, "id")
    return [_job(tx, row) for row in rows], cursor


def first_job(tx: Tx, query: Select[Any]) -> Job | None:
    row = tx.first(query.order_by(jobs.c.id).limit(1))
    return None if row is None else _job(tx, row)


def unplanned(holder: str, now: datetime) -> Select[Any]:
    free = or_(
        jobs.c.planning_expires_at.is_(None), jobs.c.planning_expires_at <= now, jobs.c.planning_holder == holder
    )
    open_plan = and_(jobs.c.state == JobState.RUNNING.value, ~jobs.c.planned, free)
    return select(jobs).where(or_(jobs.c.state == JobState.QUEUED.value, open_plan), _has_its_turn(now))


def finalizable(now: datetime) -> Select[Any]:
    settled = and_(
        jobs.c.state == JobState.RUNNING.value, jobs.c.planned, jobs.c.shards_committed == jobs.c.shards_total
    )
    return select(jobs).where(or_(jobs.c.state == JobState.FINALIZING.value, settled), _has_its_turn(now))


def unswept(now: datetime, quiet_s: float) -> Select[Any]:
    since = now - timedelta(seconds=quiet_s)
    heard_of = exists().where(
        shards.c.job_id == jobs.c.id, or_(in_state(shards.c.state, ShardState.LEASED), shards.c.renewed_at > since)
    )
    complete = jobs.c.state.in_([JobState.SUCCEEDED, JobState.SUCCEEDED_WITH_ERRORS])
    abandoned = and_(jobs.c.state.in_([JobState.FAILED, JobState.CANCELLED]), jobs.c.finished_at <= since, ~heard_of)
    open_jobs = select(jobs).where(~jobs.c.swept, jobs.c.shards_total > 0, _has_its_turn(now))
    return open_jobs.where(or_(complete, abandoned))


def _has_its_turn(now: datetime) -> ColumnElement[bool]:
    return or_(jobs.c.not_before.is_(None), jobs.c.not_before <= now)


def list_videos(
    tx: Tx,
    job_id: str,
    tenant: str | None,
    status: VideoStatus | None,
    error_code: str | None,
    limit: int,
    after: str | None,
) -> tuple[list[VideoRow], str | None]:
    """See `Store.list_videos`."""
    _require_job(tx, job_id, tenant)
    query = select(videos).where(videos.c.job_id == job_id).order_by(videos.c.key)
    if after is not None:
        query = query.where(videos.c.key > after)
    if status is not None:
        query = query.where(videos.c.status == status.value)
    if error_code is not None:
        query = query.where(videos.c.error_code == error_code)
    rows, cursor = _page(tx, query, limit, "key")
    found = [
        VideoRow(
            ref=VideoRef(row.key, row.uri, row.size_bytes, row.etag),
            shard_id=row.shard_id,
            status=VideoStatus(row.status),
            result=None if row.result is None else VideoResult.from_json(row.result),
        )
        for row in rows
    ]
    return found, cursor


def list_shards(
    tx: Tx, job_id: str, tenant: str | None, limit: int, after: str | None
) -> tuple[list[Shard], str | None]:
    """See `Store.list_shards`."""
    _require_job(tx, job_id, tenant)
    query = select(shards).where(shards.c.job_id == job_id).order_by(shards.c.ordinal)
    if after is not None:
        if not after.isascii() or not after.isdigit() or len(after) > 9:
            raise InvalidPageToken("this page token was not given out for a list of shards")
        query = query.where(shards.c.ordinal > int(after))
    rows, cursor = _page(tx, query, limit, "ordinal")
    return [_shard(row) for row in rows], cursor


def uncommitted_shards(tx: Tx, job_id: str) -> list[Shard]:
    """See `Store.uncommitted_shards`."""
    query = select(shards).where(shards.c.job_id == job_id, shards.c.state != ShardState.COMMITTED.value)
    return [_shard(row) for row in tx.rows(query.order_by(shards.c.ordinal))]


def planned_shards(tx: Tx, job_id: str, first_ordinal: int, limit: int) -> list[PlannedShard]:
    """See `Store.planned_shards`."""
    query = select(shards.c.id, shards.c.ordinal, shards.c.plan_hash).where(
        shards.c.job_id == job_id, shards.c.ordinal >= first_ordinal
    )
    rows = tx.rows(query.order_by(shards.c.ordinal).limit(limit))
    keys: dict[str, list[str]] = {row.id: [] for row in rows}
    of_them = select(videos.c.shard_id, videos.c.key).where(videos.c.shard_id.in_(list(keys)))
    for video in tx.rows(of_them.order_by(videos.c.shard_id, videos.c.position)):
        keys[video.shard_id].append(video.key)
    return [PlannedShard(row.ordinal, row.plan_hash, tuple(keys[row.id])) for row in rows]


def shard_digests(tx: Tx, job_id: str, first_ordinal: int, limit: int) -> list[ShardDigest]:
    """See `Store.shard_digests`."""
    _require_job(tx, job_id, None)
    c = shards.c
    query = select(c.id, c.ordinal, c.state, c.plan_hash, c.record_sha256).where(
        c.job_id == job_id, c.ordinal >= first_ordinal
    )
    return [
        ShardDigest(row.id, row.ordinal, ShardState(row.state), row.plan_hash, row.record_sha256)
        for row in tx.rows(query.order_by(c.ordinal).limit(limit))
    ]


def job_states(tx: Tx, job_ids: Collection[str]) -> dict[str, JobState]:
    """See `Store.job_states`."""
    found = tx.rows(select(jobs.c.id, jobs.c.state).where(jobs.c.id.in_(sorted(job_ids))))
    return {row.id: JobState(row.state) for row in found}


def list_events(tx: Tx, job_id: str, tenant: str | None, after_seq: int, limit: int) -> list[Event]:
    """See `Store.events`."""
    _require_job(tx, job_id, tenant)
    query = select(events).where(events.c.job_id == job_id, events.c.seq > after_seq).order_by(events.c.seq)
    return [Event(e.seq, e.job_id, e.at, e.kind, e.data) for e in tx.rows(query.limit(limit))]


def counts(tx: Tx) -> dict[str, dict[str, int]]:
    """See `Store.counts`. Every state is there, also those with nothing in them."""
    answer: dict[str, dict[str, int]] = {
        "jobs": {state.value: 0 for state in JobState},
        "shards": {state.value: 0 for state in ShardState},
    }
    for name, table in (("jobs", jobs), ("shards", shards)):
        for row in tx.rows(select(table.c.state, func.count().label("number")).group_by(table.c.state)):
            answer[name][row.state] = row.number
    paused = select(jobs.c.pause_reason, func.count().label("number")).where(jobs.c.state == JobState.PAUSED.value)
    answer["paused"] = {reason.value: 0 for reason in PauseReason}
    for row in tx.rows(paused.group_by(jobs.c.pause_reason)):
        answer["paused"][row.pause_reason] = row.number
    return answer


def _page(tx: Tx, query: Select[Any], limit: int, cursor_column: str) -> tuple[list[Row[Any]], str | None]:
    rows = tx.rows(query.limit(limit + 1))
    if len(rows) <= limit:
        return rows, None
    return rows[:limit], str(getattr(rows[limit - 1], cursor_column))


def _require_job(tx: Tx, job_id: str, tenant: str | None) -> None:
    row = tx.first(select(jobs.c.tenant).where(jobs.c.id == job_id))
    if row is None or not owns(tenant, row):
        raise JobNotFound(f"there is no job {job_id!r}")


def _job(tx: Tx, row: Row[Any]) -> Job:
    progress, live_slot_s = _progress(tx, row)
    return Job(
        id=row.id,
        spec=JobSpec.from_json(row.spec),
        state=JobState(row.state),
        created_at=row.created_at,
        updated_at=row.updated_at,
        tenant=row.tenant,
        error_code=row.error_code,
        error_message=row.error_message,
        planned=row.planned,
        started_at=row.started_at,
        finished_at=row.finished_at,
        control=control_of(row),
        pause_reason=row.pause_reason,
        pause_message=row.pause_message,
        slot_seconds=row.slot_seconds + live_slot_s,
        retries=row.retries,
        progress=progress,
    )


def _shard(row: Row[Any]) -> Shard:
    return Shard(
        id=row.id,
        job_id=row.job_id,
        ordinal=row.ordinal,
        state=ShardState(row.state),
        num_videos=row.num_videos,
        attempts=row.attempts,
        holder=row.holder,
        lease_expires_at=row.lease_expires_at,
        tar_name=row.tar_name,
    )


def _progress(tx: Tx, job: Row[Any]) -> tuple[JobProgress, float]:
    """The job's counters plus what live leases report, and the seconds that these have lasted."""
    settled = job.videos_succeeded + job.videos_failed + job.videos_quarantined
    base: dict[str, Any] = {
        "shards_total": job.shards_total,
        "shards_committed": job.shards_committed,
        "videos_total": job.videos_total,
        "videos_succeeded": job.videos_succeeded,
        "videos_failed": job.videos_failed,
        "videos_quarantined": job.videos_quarantined,
    }
    if JobState(job.state) in (JobState.QUEUED, JobState.FINALIZING) or JobState(job.state).terminal:
        frames = job.frames_committed
        expected = frames if settled else None
        return JobProgress(**base, videos_done=settled, frames_done=frames, frames_expected=expected), 0.0

    c = shards.c
    reported = (c.state, c.num_videos, c.videos_done, c.frames_done, c.frames_expected)
    of_job = select(*reported, c.leased_at, c.renewed_at, c.committed_at).where(c.job_id == job.id)
    window = tx.now - timedelta(seconds=_RATE_WINDOW_S)
    # Two queries of one index each: together as an OR they would read every shard of the job.
    recent = tx.rows(of_job.where(in_state(c.state, ShardState.LEASED)))
    recent += tx.rows(of_job.where(in_state(c.state, ShardState.COMMITTED), c.committed_at > window))
    leased = [s for s in recent if s.state == ShardState.LEASED.value]
    frames_done = job.frames_committed + sum(s.frames_done for s in leased)
    videos_done = settled + sum(min(s.videos_done, s.num_videos) for s in leased)
    frames_expected = _expected_frames(job, leased, settled)
    if frames_expected is not None:
        frames_expected = max(frames_expected, frames_done)
    rate = _frames_per_s(tx, job, recent)

    eta_s: float | None = None
    if job.planned and frames_expected is not None and rate > 0:
        eta_s = (frames_expected - frames_done) / rate
    elif job.planned and videos_done and job.started_at is not None:
        elapsed = (tx.now - job.started_at).total_seconds()
        eta_s = elapsed / videos_done * (job.videos_total - videos_done)
    progress = JobProgress(
        **base,
        videos_done=videos_done,
        frames_done=frames_done,
        frames_expected=frames_expected,
        frames_per_s=rate,
        eta_s=eta_s,
    )
    return progress, sum((tx.now - s.leased_at).total_seconds() for s in leased if s.leased_at is not None)


def _expected_frames(job: Row[Any], leased: list[Row[Any]], settled: int) -> int | None:
    """Frames of settled and of probed videos, and their mean for all others."""
    probed = [s for s in leased if s.frames_expected is not None]
    known_videos: int = settled + sum(s.num_videos for s in probed)
    if known_videos == 0:
        return None
    known_frames: int = job.frames_committed + sum(s.frames_expected for s in probed)
    unknown_videos = max(job.videos_total - known_videos, 0)
    mean: float = known_frames / known_videos
    extra: int = round(mean * unknown_videos)
    return known_frames + extra


def _frames_per_s(tx: Tx, job: Row[Any], recent: list[Row[Any]]) -> float:
    """Frames done within the window before now, each lease's frames spread evenly over the time it was held."""
    if job.started_at is None:
        return 0.0
    window_s: float = min(_RATE_WINDOW_S, max((tx.now - job.started_at).total_seconds(), 1.0))
    opens = tx.now - timedelta(seconds=window_s)
    frames = 0.0
    for s in recent:
        end = s.committed_at or s.renewed_at
        if s.leased_at is None or end is None or end <= s.leased_at:
            continue
        inside_s = (end - max(s.leased_at, opens)).total_seconds()
        if inside_s > 0:
            frames += float(s.frames_done) * inside_s / (end - s.leased_at).total_seconds()
    return frames / window_s
