"""How long a claim takes in a large store: `python -m benchmarks.claim DATABASE_URL [--shards 100000]`.

Fills an empty database with jobs of several tenants, half of each committed, and then claims and releases. Beside the
fair claim it times, on the same rows, the oldest-job-first query that knows neither tenants nor priorities.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable

from sqlalchemy import exists, select, update

from services.domain.models import JobSpec, ShardPlan, VideoRef
from services.domain.states import JobState, ShardState
from services.store.database import Database, Tx
from services.store.schema import in_state, jobs, shards
from services.store.sql import SqlStore

_BATCH = 1000


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("database_url")
    parser.add_argument("--shards", type=int, default=100_000)
    parser.add_argument("--videos-each", type=int, default=10)
    parser.add_argument("--jobs", type=int, default=20)
    parser.add_argument("--tenants", type=int, default=5)
    parser.add_argument("--live", type=int, default=256)
    parser.add_argument("--repeat", type=int, default=100)
    given = parser.parse_args()
    store = SqlStore(given.database_url)
    _fill(store, given.jobs, given.tenants, given.shards // given.jobs, given.videos_each)
    database = Database(given.database_url)
    half = given.shards // given.jobs // 2
    database.write(
        lambda tx: tx.run(
            update(shards).where(shards.c.ordinal < half).values(state=ShardState.COMMITTED.value, committed_at=tx.now)
        )
    )
    store.claim("others", limit=given.live, ttl_s=86_400)

    def fair() -> None:
        for lease in store.claim("bench", limit=1, ttl_s=600):
            claimed.append((lease.shard_id, lease.fence))

    claimed: list[tuple[str, int]] = []
    _report("fair claim of one shard", fair, given.repeat)
    for shard_id, fence in claimed:
        store.release(shard_id, fence, "bench")
    _report("oldest job first, choice only", lambda: database.write(_oldest_first), given.repeat)
    database.close()
    store.close()


def _fill(store: SqlStore, num_jobs: int, num_tenants: int, shards_each: int, videos_each: int) -> None:
    for number in range(num_jobs):
        spec = JobSpec(("/in",), f"/out/{number}")
        job, _ = store.create_job(spec, tenant=f"tenant-{number % num_tenants}")
        fence = store.begin_planning(job.id, "bench", ttl_s=3600)
        assert fence is not None
        for first in range(0, shards_each, _BATCH):
            ordinals = range(first, min(first + _BATCH, shards_each))
            plans = [
                ShardPlan(i, tuple(VideoRef(f"v{i}-{k}", f"/in/v{i}-{k}.mp4", 1) for k in range(videos_each)))
                for i in ordinals
            ]
            store.add_shards(job.id, fence, plans, ttl_s=3600)
        store.finish_planning(job.id, fence)


def _oldest_first(tx: Tx) -> None:
    pending = in_state(shards.c.state, ShardState.PENDING)
    with_work = select(jobs.c.id).where(
        jobs.c.state == JobState.RUNNING.value, exists().where(shards.c.job_id == jobs.c.id, pending)
    )
    oldest = tx.run(with_work.order_by(jobs.c.id).limit(1)).scalar_one()
    free = select(shards.c.id).where(shards.c.job_id == oldest, pending).order_by(shards.c.ordinal).limit(1)
    tx.run(free.with_for_update(skip_locked=True)).all()


def _report(what: str, work: Callable[[], None], repeat: int) -> None:
    took_ms = []
    for _ in range(repeat):
        started = time.perf_counter()
        work()
        took_ms.append(1e3 * (time.perf_counter() - started))
    took_ms.sort()
    p99 = took_ms[min(repeat - 1, int(0.99 * repeat))]
    print(f"{what}: median {statistics.median(took_ms):.2f} ms, p99 {p99:.2f} ms over {repeat}")


if __name__ == "__main__":
    main()
