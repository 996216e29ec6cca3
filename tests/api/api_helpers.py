"""Playing the agent beside the API."""

from __future__ import annotations

import itertools
from typing import Any

import httpx

from services.domain.models import CommitRecord, Lease, ShardPlan, VideoRef, VideoResult
from services.domain.states import VideoStatus
from services.store.base import Store

_outputs = itertools.count()


def body(**changes: Any) -> dict[str, Any]:
    return {"inputs": ["/videos"], "output": f"/out/{next(_outputs)}", **changes}


def submit(http: httpx.Client, **changes: Any) -> str:
    answer = http.post("/v1/jobs", json=body(**changes))
    assert answer.status_code == 202, answer.text
    job_id: str = answer.json()["id"]
    return job_id


def plan(store: Store, job_id: str, shards: int = 2, videos_each: int = 2) -> None:
    fence = store.begin_planning(job_id, "planner", ttl_s=60)
    assert fence is not None
    store.add_shards(
        job_id,
        fence,
        [
            ShardPlan(i, tuple(VideoRef(f"s{i}v{k}", f"/videos/s{i}v{k}.mp4", 10) for k in range(videos_each)))
            for i in range(shards)
        ],
        ttl_s=60,
    )
    store.finish_planning(job_id, fence)


def claim(store: Store, job_id: str) -> list[Lease]:
    """The job's shards; other tests' jobs that are claimed on the way are given back."""
    mine = []
    for lease in store.claim("agent", limit=1000, ttl_s=600):
        if lease.job_id == job_id:
            mine.append(lease)
        else:
            store.release(lease.shard_id, lease.fence, "not this test's")
    return mine


def commit(store: Store, lease: Lease, *failed: str) -> None:
    results = []
    for v in lease.videos:
        if v.key in failed:
            error = {"error_code": "media_corrupt", "error_message": f"{v.uri} is broken"}
            results.append(VideoResult(v.key, v.uri, VideoStatus.FAILED, lease.attempt, **error))
        else:
            found: dict[str, Any] = {
                "num_frames": 7,
                "width": 640,
                "height": 480,
                "camera_model": "pinhole",
                "camera_params": (500.0, 500.0, 320.0, 240.0),
                "seconds": 1.5,
                "quality": {"reliable": "yes", "reasons": []},
            }
            results.append(VideoResult(v.key, v.uri, VideoStatus.SUCCEEDED, lease.attempt, **found))
    store.record_commit(
        CommitRecord(
            job_id=lease.job_id,
            shard_id=lease.shard_id,
            ordinal=lease.ordinal,
            plan_hash=lease.plan_hash,
            config_hash=lease.spec.config_hash,
            attempt=lease.attempt,
            fence=lease.fence,
            holder=lease.holder,
            tar_name=f"tar-{lease.ordinal}",
            objects=(),
            videos=tuple(results),
            retry=lease.retry,
        )
    )


def finish(store: Store, job_id: str, *failed: str) -> None:
    for lease in claim(store, job_id):
        commit(store, lease, *failed)
    while (job := store.next_finalizable()) is not None:
        store.finish_job(job.id)
        if job.id == job_id:
            return


def assert_problem(answer: httpx.Response, status: int, code: str) -> dict[str, Any]:
    """The answer is a complete RFC 9457 problem."""
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    problem: dict[str, Any] = answer.json()
    assert problem["type"] == f"urn:vipe:problem:{code}"
    assert problem["code"] == code
    assert problem["status"] == status
    assert problem["instance"] == answer.request.url.path
    assert problem["title"]
    assert problem["detail"]
    assert problem["request_id"] == answer.headers["x-request-id"]
    return problem
