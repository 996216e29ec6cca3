"""Transitions of shards: claim, renew, blame, release, expire, commit.

The lock order is one everywhere: the job's row, then its shards by id. A claim locks shards only and skips what others
hold, so it waits for nobody.
"""

from __future__ import annotations

import hashlib
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime, timedelta
from typing import Any, Literal

from sqlalchemy import Row, bindparam, select, update

from services.domain.errors import CommitConflict, ShardNotFound
from services.domain.events import EventKind
from services.domain.models import (
    CommitRecord,
    Death,
    JobSpec,
    Lease,
    LeaseProgress,
    Renewal,
    VideoRef,
)
from services.domain.states import JobState, ShardState, VideoStatus
from services.store.control import trip
from services.store.database import Tx
from services.store.fairness import lock_claimable
from services.store.jobs import lock_job, settle_cancelling
from services.store.schema import in_state, jobs, shards, videos

_NO_LEASE: dict[str, Any] = {
    "not_before": None,
    "holder": None,
    "lease_expires_at": None,
    "video_key": None,
    "stage": None,
    "videos_done": 0,
    "frames_done": 0,
    "frames_expected": None,
}


_VERDICTS: dict[JobState, Literal["continue", "pause"]] = {JobState.RUNNING: "continue", JobState.PAUSED: "pause"}


def claim(tx: Tx, holder: str, limit: int, ttl_s: float) -> list[Lease]:
    """See `Store.claim`."""
    if limit <= 0:
        return []
    chosen = lock_claimable(tx, limit)
    if not chosen:
        return []
    tx.run(
        update(shards)
        .where(shards.c.id.in_(chosen))
        .values(
            **{
                **_NO_LEASE,
                "state": ShardState.LEASED.value,
                "holder": holder,
                "attempts": shards.c.attempts + 1,
                "fence": shards.c.fence + 1,
                "leased_at": tx.now,
                "renewed_at": tx.now,
                "lease_expires_at": tx.now + timedelta(seconds=ttl_s),
            }
        )
    )
    refs: dict[str, list[VideoRef]] = {}
    spent: dict[str, dict[str, tuple[Death, ...]]] = {}
    for v in tx.rows(
        select(videos).where(videos.c.shard_id.in_(chosen)).order_by(videos.c.shard_id, videos.c.position)
    ):
        refs.setdefault(v.shard_id, []).append(VideoRef(v.key, v.uri, v.size_bytes, v.etag))
        if v.deaths:
            spent.setdefault(v.shard_id, {})[v.key] = _deaths(v)

    leases = []
    specs: dict[str, JobSpec] = {}
    create_once: dict[str, bool] = {}
    leased = select(shards).where(shards.c.id.in_(chosen)).order_by(shards.c.job_id, shards.c.ordinal)
    for s in tx.rows(leased):
        if s.job_id not in specs:
            job = tx.run(select(jobs.c.spec, jobs.c.create_once).where(jobs.c.id == s.job_id)).one()
            specs[s.job_id] = JobSpec.from_json(job.spec)
            create_once[s.job_id] = job.create_once is not False
        leases.append(
            Lease(
                job_id=s.job_id,
                shard_id=s.id,
                ordinal=s.ordinal,
                plan_hash=s.plan_hash,
                videos=tuple(refs.get(s.id, ())),
                spec=specs[s.job_id],
                attempt=s.attempts,
                fence=s.fence,
                holder=holder,
                expires_at=s.lease_expires_at,
                spent=spent.get(s.id, {}),
                create_once=create_once[s.job_id],
                retry=s.retry,
            )
        )
        tx.emit(s.job_id, EventKind.SHARD_LEASED, shard_id=s.id, holder=holder, attempt=s.attempts, fence=s.fence)
    return leases


def renew(tx: Tx, holder: str, progress: Sequence[LeaseProgress], ttl_s: float) -> list[Renewal]:
    """See `Store.renew`. A lease that ran out but that nobody took yet can still be renewed."""
    rows = {
        row.id: row
        for row in tx.rows(
            select(shards.c.id, shards.c.fence, shards.c.holder, shards.c.state, jobs.c.state.label("job_state"))
            .join(jobs, jobs.c.id == shards.c.job_id)
            .where(shards.c.id.in_(sorted({p.shard_id for p in progress})))
            .order_by(shards.c.id)
            .with_for_update(of=shards)
        )
    }
    held: list[LeaseProgress] = []
    renewals: list[Renewal] = []
    for report in progress:
        row = rows.get(report.shard_id)
        if row is None or not is_current(row, report.fence) or row.holder != holder:
            renewals.append(Renewal(report.shard_id, "lost"))
            continue
        held.append(report)
        renewals.append(Renewal(report.shard_id, _VERDICTS.get(JobState(row.job_state), "cancel")))
    if held:
        tx.run(
            update(shards)
            .where(shards.c.id == bindparam("p_id"))
            .values(
                renewed_at=tx.now,
                lease_expires_at=tx.now + timedelta(seconds=ttl_s),
                video_key=bindparam("p_video_key"),
                stage=bindparam("p_stage"),
                videos_done=bindparam("p_videos_done"),
                frames_done=bindparam("p_frames_done"),
                frames_expected=bindparam("p_frames_expected"),
            ),
            [
                {
                    "p_id": p.shard_id,
                    "p_video_key": p.video_key,
                    "p_stage": p.stage,
                    "p_videos_done": p.videos_done,
                    "p_frames_done": p.frames_done,
                    "p_frames_expected": p.frames_expected,
                }
                for p in held
            ],
        )
    return renewals


def holds(tx: Tx, shard: str, fence: int) -> bool:
    """See `Store.holds`."""
    row = tx.first(select(shards.c.state, shards.c.fence).where(shards.c.id == shard))
    return row is not None and is_current(row, fence)


def blame(tx: Tx, shard: str, fence: int, video_key: str, death: Death) -> tuple[Death, ...]:
    """See `Store.blame`. A lease that is not current any more has no say: its deaths are not counted."""
    row = lock_shard(tx, shard)
    video = tx.first(
        select(videos.c.deaths, videos.c.death_log).where(videos.c.shard_id == shard, videos.c.key == video_key)
    )
    if not is_current(row, fence):
        return () if video is None else _deaths(video)  # It may have been tried again, in another shard, since.
    if video is None:
        raise ShardNotFound(f"shard {shard} has no video {video_key!r}")
    deaths = (*_deaths(video), replace(death, at=tx.now.isoformat()))
    log = [_storable(each.to_json()) for each in deaths]
    tx.run(
        update(videos)
        .where(videos.c.shard_id == shard, videos.c.key == video_key)
        .values(deaths=len(deaths), death_log=log)
    )
    where = {"place": death.place} if death.place else {}
    tx.emit(
        row.job_id,
        EventKind.VIDEO_BLAMED,
        shard_id=shard,
        video_key=video_key,
        deaths=len(deaths),
        reason=_storable(death.reason),
        **where,
    )
    return deaths


def release(tx: Tx, shard: str, fence: int, reason: str, wait_s: float) -> None:
    """See `Store.release`. Nothing happens for a lease that is not current any more."""
    row = lock_shard(tx, shard)
    if is_current(row, fence):
        _end_lease(tx, row, EventKind.SHARD_RELEASED, wait_s, reason=reason)
        settle_cancelling(tx, row.job_id)


def expire_job(tx: Tx, job_id: str) -> int:
    """End the leases of one job that ran out, and settle the job if it is being cancelled."""
    lock_job(tx, job_id)
    expired = tx.rows(
        select(shards)
        .where(
            shards.c.job_id == job_id, in_state(shards.c.state, ShardState.LEASED), shards.c.lease_expires_at <= tx.now
        )
        .order_by(shards.c.id)
        .with_for_update()
    )
    for row in expired:
        _end_lease(tx, row, EventKind.SHARD_EXPIRED, ended=row.lease_expires_at)
    settle_cancelling(tx, job_id)
    return len(expired)


def expirable_jobs(tx: Tx) -> list[str]:
    """Jobs with leases that ran out, and those that are being cancelled."""
    ran_out = select(shards.c.job_id).where(
        in_state(shards.c.state, ShardState.LEASED), shards.c.lease_expires_at <= tx.now
    )
    cancelling = select(jobs.c.id).where(jobs.c.state == JobState.CANCELLING.value)
    return sorted(set(tx.run(ran_out).scalars()) | set(tx.run(cancelling).scalars()))


def record_commit(tx: Tx, record: CommitRecord) -> bool:
    """See `Store.record_commit`.

    The record in object storage is the commit point, so the store follows it whoever wrote it: a holder whose lease
    ran out meanwhile may have won. What the store does not accept is a record of another plan, or one that carries a
    fence that was never given out.

    Raises:
        ShardNotFound: There is no such shard.
        CommitConflict: The record is not one of this shard's plan and leases.
    """
    row = lock_shard(tx, record.shard_id)
    if record.plan_hash != row.plan_hash:
        raise CommitConflict(f"the commit record of shard {row.id} belongs to another plan; its output is shared")
    if record.fence > row.fence or record.job_id != row.job_id:
        raise CommitConflict(f"the commit record of shard {row.id} was written without a lease of this store")
    if ShardState(row.state) is ShardState.COMMITTED:
        return False  # Some of its videos may have been tried again since, and belong to another shard now.
    keys = set(tx.run(select(videos.c.key).where(videos.c.shard_id == row.id)).scalars())
    if {v.key for v in record.videos} != keys or len(record.videos) != len(keys) or record.retry != row.retry:
        raise CommitConflict(f"the commit record of shard {row.id} belongs to another plan; its output is shared")
    outcomes = Counter(v.status for v in record.videos)
    lost = outcomes[VideoStatus.FAILED] + outcomes[VideoStatus.QUARANTINED]
    tx.run(
        update(shards)
        .where(shards.c.id == row.id)
        .values(
            **{**_NO_LEASE, "videos_done": len(keys), "frames_done": record.frames},
            state=ShardState.COMMITTED.value,
            tar_name=record.tar_name,
            committed_at=tx.now,
            record=None,  # it lies in the output
            record_sha256=hashlib.sha256(record.to_bytes()).hexdigest(),
            videos_lost=lost,
        )
    )
    tx.run(
        update(videos)
        .where(videos.c.job_id == row.job_id, videos.c.key == bindparam("p_key"))
        .values(status=bindparam("p_status"), error_code=bindparam("p_error_code"), result=bindparam("p_result")),
        [
            {
                "p_key": v.key,
                "p_status": v.status.value,
                "p_error_code": v.error_code,
                "p_result": _storable(v.to_json()),
            }
            for v in record.videos
        ],
    )
    tx.run(
        update(jobs)
        .where(jobs.c.id == row.job_id)
        .values(
            shards_committed=jobs.c.shards_committed + 1,
            videos_succeeded=jobs.c.videos_succeeded + outcomes[VideoStatus.SUCCEEDED],
            videos_failed=jobs.c.videos_failed + outcomes[VideoStatus.FAILED],
            videos_quarantined=jobs.c.videos_quarantined + outcomes[VideoStatus.QUARANTINED],
            frames_committed=jobs.c.frames_committed + record.frames,
            slot_seconds=jobs.c.slot_seconds + _lasted_s(row, tx.now),
            updated_at=tx.now,
        )
    )
    tx.emit(
        row.job_id,
        EventKind.SHARD_COMMITTED,
        shard_id=row.id,
        attempt=record.attempt,
        tar_name=record.tar_name,
        frames=record.frames,
        **{status.value: outcomes[status] for status in VideoStatus if status is not VideoStatus.PENDING},
    )
    settle_cancelling(tx, row.job_id)
    if lost:
        trip(tx, row.job_id)
    return True


def _deaths(video: Row[Any]) -> tuple[Death, ...]:
    """Those of which more is known than their number, and before them those of which no more is."""
    known = tuple(Death(**each) for each in video.death_log or ())
    return (Death("not recorded"),) * (int(video.deaths) - len(known)) + known


def is_current(row: Row[Any], fence: int) -> bool:
    """Whether a fence is that of the shard's live lease."""
    return ShardState(row.state) is ShardState.LEASED and bool(row.fence == fence)


def lock_shard(tx: Tx, shard: str) -> Row[Any]:
    """Read a shard's row for a change, its job's row first."""
    job_id = tx.run(select(shards.c.job_id).where(shards.c.id == shard)).scalar_one_or_none()
    if job_id is None:
        raise ShardNotFound(f"there is no shard {shard!r}")
    lock_job(tx, job_id)
    return tx.run(select(shards).where(shards.c.id == shard).with_for_update()).one()


def _end_lease(
    tx: Tx, row: Row[Any], kind: EventKind, wait_s: float = 0.0, ended: datetime | None = None, **data: Any
) -> None:
    """Pending again, or cancelled where the job takes no more leases. What the lease cost is the job's.

    Args:
        ended: Until when its holder may have worked; now, where it says itself that it has stopped.
    """
    job_state = JobState(tx.run(select(jobs.c.state).where(jobs.c.id == row.job_id)).scalar_one())
    to = ShardState.PENDING if job_state in (JobState.RUNNING, JobState.PAUSED) else ShardState.CANCELLED
    changes = {**_NO_LEASE, "state": to.value}
    if wait_s > 0:
        changes["not_before"] = tx.now + timedelta(seconds=wait_s)
    tx.run(update(shards).where(shards.c.id == row.id).values(**changes))
    lasted_s = _lasted_s(row, ended or tx.now)
    tx.run(update(jobs).where(jobs.c.id == row.job_id).values(slot_seconds=jobs.c.slot_seconds + lasted_s))
    tx.emit(row.job_id, kind, shard_id=row.id, holder=row.holder, fence=row.fence, **data)


def _lasted_s(row: Row[Any], until: datetime) -> float:
    """How long a shard's lease has lasted; 0 where it has none."""
    if ShardState(row.state) is not ShardState.LEASED or row.leased_at is None:
        return 0.0
    return max(0.0, float((until - row.leased_at).total_seconds()))


def _storable(value: Any) -> Any:
    """What both databases accept as JSON: no NaN or infinity, no NUL character."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, str):
        return value.replace("\x00", "\ufffd")
    if isinstance(value, dict):
        return {k: _storable(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_storable(v) for v in value]
    return value
