"""Short ways to build the store's values in tests."""

from __future__ import annotations

from services.domain.models import CommitRecord, JobSpec, Lease, LeaseProgress, ShardPlan, VideoRef, VideoResult
from services.domain.states import VideoStatus
from services.store.base import Store


def spec(output: str = "/out", **changes: object) -> JobSpec:
    return JobSpec(**{"inputs": ("/in",), "output": output, **changes})


def plans(number: int, videos_each: int = 2) -> list[ShardPlan]:
    return [
        ShardPlan(i, tuple(VideoRef(f"s{i}v{k}", f"/in/s{i}v{k}.mp4", 10, f"tag{k}") for k in range(videos_each)))
        for i in range(number)
    ]


def begin_planning(store: Store, job_id: str, holder: str = "planner", ttl_s: float = 60) -> int:
    fence = store.begin_planning(job_id, holder, ttl_s=ttl_s)
    assert fence is not None
    return fence


def planned_job(store: Store, number: int = 3, videos_each: int = 2, output: str = "/out") -> str:
    job, _ = store.create_job(spec(output))
    fence = begin_planning(store, job.id)
    assert store.add_shards(job.id, fence, plans(number, videos_each), ttl_s=60)
    assert store.finish_planning(job.id, fence)
    return job.id


def record(
    lease: Lease,
    status: VideoStatus = VideoStatus.SUCCEEDED,
    frames: int = 10,
    fence: int | None = None,
    plan_hash: str | None = None,
    error_code: str = "media_corrupt",
) -> CommitRecord:
    failed = status is not VideoStatus.SUCCEEDED
    return CommitRecord(
        job_id=lease.job_id,
        shard_id=lease.shard_id,
        ordinal=lease.ordinal,
        plan_hash=lease.plan_hash if plan_hash is None else plan_hash,
        config_hash=lease.spec.config_hash,
        attempt=lease.attempt,
        fence=lease.fence if fence is None else fence,
        holder=lease.holder,
        tar_name=None if failed else f"tar-{lease.ordinal}",
        objects=(),
        videos=tuple(
            VideoResult(
                v.key,
                v.uri,
                status,
                lease.attempt,
                error_code=error_code if failed else None,
                error_message="broken" if failed else None,
                num_frames=None if failed else frames,
                camera_params=None if failed else (1.0, 2.0, 3.0, 4.0),
                quality=None if failed else {"score": 0.5, "bad": float("nan")},
            )
            for v in lease.videos
        ),
        retry=lease.retry,
    )


def kinds(store: Store, job_id: str) -> list[str]:
    return [e.kind for e in store.events(job_id)]


def run_out(store: Store, *, holder: str, shard_id: str, fence: int) -> None:
    """Let a lease run out without waiting: a renewal for no time at all."""
    assert store.renew(holder, [LeaseProgress(fence, shard_id)], ttl_s=0)[0].verdict != "lost"
    assert store.expire_leases() == 1
