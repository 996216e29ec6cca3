"""The transition of a retry: videos of an ended job that failed get new shards of the same job and output.

What is committed stays as it is. The new shards have the next ordinals; their records carry the number of the retry, by
which readers know that their rows take the place of the earlier ones.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from sqlalchemy import Row, bindparam, insert, select, update

from services.domain.control import RetrySelection
from services.domain.errors import JobNotRetryable, NothingToRetry
from services.domain.events import EventKind
from services.domain.models import JobSpec, ShardPlan, VideoRef, shard_id
from services.domain.states import JOB_TRANSITIONS, JobState, VideoStatus
from services.store.database import Tx
from services.store.jobs import lock_job, move_job
from services.store.planning import shard_row
from services.store.schema import shards, videos
from services.store.tenants import admit


def retry(tx: Tx, job_id: str, tenant: str | None, selection: RetrySelection) -> None:
    """See `Store.retry`."""
    job = lock_job(tx, job_id, tenant)
    state = JobState(job.state)
    if not state.terminal or JobState.RUNNING not in JOB_TRANSITIONS[state]:
        raise JobNotRetryable(f"job {job_id} is {state.value}: {_WHY_NOT.get(state, 'it has not ended yet')}")
    lost = (
        select(videos.c.key, videos.c.uri, videos.c.size_bytes, videos.c.etag, videos.c.status, videos.c.error_code)
        .where(
            videos.c.job_id == job_id,
            videos.c.status.in_([VideoStatus.FAILED.value, VideoStatus.QUARANTINED.value]),
        )
        .order_by(videos.c.key)
    )
    chosen = [row for row in tx.rows(lost) if (VideoStatus(row.status), row.error_code) in selection]
    if not chosen:
        raise NothingToRetry(f"no video of job {job_id} failed in the way that was asked for")
    admit(tx, job.tenant, jobs_more=1, videos_more=len(chosen))
    number = job.retries + 1
    spec = JobSpec.from_json(job.spec)
    plans = [ShardPlan(job.shards_total + i, videos_) for i, videos_ in enumerate(_packed(chosen, spec))]
    tx.run(insert(shards), [{**shard_row(job_id, plan), "retry": number} for plan in plans])
    tx.run(
        update(videos)
        .where(videos.c.job_id == job_id, videos.c.key == bindparam("p_key"))
        .values(
            shard_id=bindparam("p_shard_id"),
            position=bindparam("p_position"),
            status=VideoStatus.PENDING.value,
            deaths=0,
            death_log=None,
            error_code=None,
            result=None,
        ),
        [
            {"p_key": video.key, "p_shard_id": shard_id(job_id, plan.ordinal), "p_position": position}
            for plan in plans
            for position, video in enumerate(plan.videos)
        ],
    )
    quarantined = sum(row.status == VideoStatus.QUARANTINED.value for row in chosen)
    move_job(
        tx,
        job,
        JobState.RUNNING,
        event_data={"retry": number, "error_codes": sorted({row.error_code for row in chosen if row.error_code})},
        retries=number,
        shards_total=job.shards_total + len(plans),
        videos_failed=job.videos_failed - (len(chosen) - quarantined),
        videos_quarantined=job.videos_quarantined - quarantined,
        finished_at=None,
        failures_since=tx.now,
        swept=False,
    )
    tx.emit(job_id, EventKind.SHARDS_PLANNED, shards=len(plans), videos=len(chosen), retry=number)


_WHY_NOT = {
    JobState.SUCCEEDED: "none of its videos failed",
    JobState.FAILED: "its output is not complete; submit the videos again to another output",
    JobState.CANCELLED: "its output is not complete; submit the videos again to another output",
}


def _packed(rows: Sequence[Row[Any]], spec: JobSpec) -> Iterator[tuple[VideoRef, ...]]:
    """Shards of the job's usual size; a video that was quarantined is alone in its own, away from the innocent."""
    shard: list[VideoRef] = []
    size_bytes = 0
    for row in rows:
        video = VideoRef(row.key, row.uri, row.size_bytes, row.etag)
        if row.status == VideoStatus.QUARANTINED.value:
            yield (video,)
            continue
        full = len(shard) >= spec.shard_max_videos or size_bytes + video.size_bytes > spec.shard_max_input_bytes
        if shard and full:
            yield tuple(shard)
            shard, size_bytes = [], 0
        shard.append(video)
        size_bytes += video.size_bytes
    if shard:
        yield tuple(shard)
