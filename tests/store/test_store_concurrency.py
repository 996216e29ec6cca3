"""Many at once: threads here, processes of their own, and what a reader sees meanwhile."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

from store_helpers import planned_job, record, spec

from services.domain.errors import IdempotencyInFlight
from services.domain.events import EventKind
from services.domain.models import Lease, ShardPlan, VideoRef
from services.domain.states import JobState
from services.store.database import Database, Tx
from services.store.sql import SqlStore

ROOT = Path(__file__).resolve().parents[2]


def at_once(*work: Callable[[], None]) -> None:
    """Run each in a thread of its own, started together; the first error is raised."""
    barrier = threading.Barrier(len(work))
    errors: list[BaseException] = []

    def run(each: Callable[[], None]) -> None:
        try:
            barrier.wait()
            each()
        except BaseException as error:
            errors.append(error)

    threads = [threading.Thread(target=run, args=(each,)) for each in work]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if errors:
        raise errors[0]


def test_every_shard_is_leased_once(store: SqlStore) -> None:
    planned_job(store, 60, videos_each=1)
    claimed: list[Lease] = []

    def agent(holder: str) -> Callable[[], None]:
        def work() -> None:
            while leases := store.claim(holder, limit=3, ttl_s=600):
                claimed.extend(leases)

        return work

    at_once(*(agent(f"a{i}") for i in range(6)))
    assert Counter(lease.ordinal for lease in claimed) == Counter(range(60))
    assert {lease.fence for lease in claimed} == {1}


_CLAIMER = """
import sys
from services.store.sql import SqlStore
store = SqlStore(sys.argv[1], migrate=False)
while leases := store.claim(sys.argv[2], limit=2, ttl_s=600):
    for lease in leases:
        print(lease.ordinal, lease.fence, flush=True)
"""


def test_processes_lease_every_shard_once(store: SqlStore, store_url: str) -> None:
    planned_job(store, 40, videos_each=1)
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", _CLAIMER, store_url]
    processes = [
        subprocess.Popen([*command, f"p{i}"], env=env, cwd=ROOT, stdout=subprocess.PIPE, text=True) for i in range(3)
    ]
    lines = [line for p in processes for line in p.communicate(timeout=120)[0].splitlines()]
    assert [p.returncode for p in processes] == [0, 0, 0]
    assert sorted(int(line.split()[0]) for line in lines) == list(range(40))
    assert {line.split()[1] for line in lines} == {"1"}


def test_a_whole_job_by_many_agents(store: SqlStore) -> None:
    """Claims, commits, give-backs, expiries and readers all at once; the counters come out exact."""
    job_id = planned_job(store, 24, videos_each=2)
    done = threading.Event()
    seen: list[int] = []

    def agent(holder: str, careless: bool) -> Callable[[], None]:
        def work() -> None:
            while not done.is_set():
                for lease in store.claim(holder, limit=2, ttl_s=600):
                    if careless and lease.attempt == 1:
                        store.release(lease.shard_id, lease.fence, "not today")
                    else:
                        store.record_commit(record(lease))
                        store.record_commit(record(lease))

        return work

    def keeper() -> None:
        while not done.is_set():
            store.expire_leases()
            job = store.next_finalizable()
            if job is not None:
                store.finish_job(job.id)
                done.set()

    def reader() -> None:
        """Reads by number as a stream does: nothing may turn up behind what was read."""
        while not done.is_set() or seen[-1:] != [e.seq for e in store.events(job_id)][-1:]:
            seen.extend(e.seq for e in store.events(job_id, after_seq=seen[-1] if seen else 0))

    at_once(agent("a", False), agent("b", True), agent("c", True), keeper, reader)
    job = store.get_job(job_id)
    assert job.state is JobState.SUCCEEDED
    assert (job.progress.shards_committed, job.progress.videos_succeeded, job.progress.frames_done) == (24, 48, 480)
    assert seen == [e.seq for e in store.events(job_id)]
    committed = [e.data["shard_id"] for e in store.events(job_id) if e.kind == "shard.committed"]
    assert len(committed) == len(set(committed)) == 24


def test_events_become_visible_in_the_order_of_their_numbers(store: SqlStore, store_url: str) -> None:
    """A transaction that took a number and is not committed yet holds back later numbers of the same job."""
    job_id = planned_job(store, 1)
    known = len(store.events(job_id))
    numbered, may_commit = threading.Event(), threading.Event()
    database = Database(store_url)

    def slow(tx: Tx) -> None:
        tx.emit(job_id, EventKind.SHARD_RELEASED, who="slow")
        tx.flush_events()
        numbered.set()
        assert may_commit.wait(60)

    def fast(tx: Tx) -> None:
        tx.emit(job_id, EventKind.SHARD_RELEASED, who="fast")

    slow_thread = threading.Thread(target=database.write, args=(slow,))
    fast_thread = threading.Thread(target=database.write, args=(fast,))
    slow_thread.start()
    assert numbered.wait(60)
    fast_thread.start()
    fast_thread.join(timeout=1)
    meanwhile = len(store.events(job_id))
    may_commit.set()
    slow_thread.join()
    fast_thread.join()
    database.close()
    assert meanwhile == known, "the later number must not be seen before the earlier one"
    assert [e.data.get("who") for e in store.events(job_id)[known:]] == ["slow", "fast"]


def test_one_owner_per_output_and_one_job_per_key(store: SqlStore) -> None:
    results: list[str] = []

    def submit() -> None:
        while True:
            try:
                results.append(store.create_job(spec(), idempotency_key="k")[0].id)
                return
            except IdempotencyInFlight:
                time.sleep(0.01)

    at_once(*[submit] * 6)
    assert len(set(results)) == 1
    assert len(store.list_jobs()[0]) == 1


def test_two_planners_that_take_turns_lose_no_video(store: SqlStore) -> None:
    """Each plans from what it finds, with a time so short that the other one takes over in the middle."""
    job, _ = store.create_job(spec())
    videos = [VideoRef(f"v{i:03}", f"/in/v{i:03}.mp4", 1) for i in range(60)]

    def planner(name: str) -> None:
        while (fence := store.begin_planning(job.id, name, ttl_s=0.001)) is not None or not store.get_job(
            job.id
        ).planned:
            if fence is None:
                continue
            first = store.get_job(job.id).progress.shards_total
            rows, _ = store.list_videos(job.id, limit=1000)
            there = {row.ref.key for row in rows}
            left = [video for video in videos if video.key not in there]
            for number in range(0, len(left), 3):
                plan = ShardPlan(first + number // 3, tuple(left[number : number + 3]))
                if not store.add_shards(job.id, fence, [plan], ttl_s=0.001):
                    break
            else:
                store.finish_planning(job.id, fence)

    at_once(lambda: planner("a"), lambda: planner("b"))
    progress = store.get_job(job.id).progress
    assert progress.videos_total == len(videos)
    assert [s.ordinal for s in store.list_shards(job.id)[0]] == list(range(progress.shards_total))


def test_cancelling_while_agents_claim(store: SqlStore) -> None:
    """However it interleaves: no lease is given out behind the cancellation, and the job ends."""
    for round_number in range(6):
        job_id = planned_job(store, 8, videos_each=1, output=f"/out{round_number}")
        claimed: list[Lease] = []
        at_once(
            lambda mine=claimed: mine.extend(store.claim("a", limit=4, ttl_s=600)),
            lambda mine=claimed: mine.extend(store.claim("b", limit=4, ttl_s=600)),
            lambda job_id=job_id: store.request_cancel(job_id),
        )
        assert store.claim("c", limit=9, ttl_s=600) == []
        for lease in claimed:
            store.release(lease.shard_id, lease.fence, "cancelled")
        assert store.get_job(job_id).state is JobState.CANCELLED
        assert {s.state.value for s in store.list_shards(job_id)[0]} == {"cancelled"}
