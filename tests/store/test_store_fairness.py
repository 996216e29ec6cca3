"""Who gets the next lease: tenants by their share, jobs by their priority, on every database."""

from __future__ import annotations

import os
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest
from store_helpers import begin_planning, plans, record, spec

from services.domain.control import JobControl, TenantLimits
from services.domain.models import Lease
from services.store.sql import SqlStore

ROOT = Path(__file__).resolve().parents[2]


def job_of(store: SqlStore, tenant: str, number: int = 20, priority: int = 0) -> str:
    output = f"/out/{tenant}/{len(store.list_jobs()[0])}"
    job, _ = store.create_job(spec(output), tenant=tenant, control=JobControl(priority=priority))
    fence = begin_planning(store, job.id)
    assert store.add_shards(job.id, fence, plans(number, 1), ttl_s=60)
    assert store.finish_planning(job.id, fence)
    return job.id


def served(store: SqlStore, leases: list[Lease]) -> Counter[str]:
    return Counter(store.get_job(lease.job_id).tenant for lease in leases)


def test_tenants_share_the_slots_whoever_came_first(store: SqlStore) -> None:
    job_of(store, "early", 50)
    job_of(store, "late")
    assert served(store, store.claim("a", limit=6, ttl_s=60)) == {"early": 3, "late": 3}
    job_of(store, "third")
    assert served(store, store.claim("a", limit=3, ttl_s=60)) == {"third": 3}, "it has least so far"


def test_shares_follow_the_weights(store: SqlStore) -> None:
    store.set_tenant_limits("big", TenantLimits(weight=3.0))
    for tenant in ("big", "small"):
        job_of(store, tenant)
    assert served(store, store.claim("a", limit=8, ttl_s=60)) == {"big": 6, "small": 2}


def test_what_one_tenant_cannot_use_is_for_the_others(store: SqlStore) -> None:
    job_of(store, "little", 1)
    job_of(store, "much", 20)
    assert served(store, store.claim("a", limit=6, ttl_s=60)) == {"little": 1, "much": 5}


@pytest.mark.parametrize("jobs_each", [1, 4])
def test_with_a_single_slot_tenants_take_turns(store: SqlStore, jobs_each: int) -> None:
    """Also where one of them has many short jobs."""
    for _ in range(jobs_each):
        job_of(store, "short", 4 // jobs_each)
    job_of(store, "long", 20)
    order = []
    for _ in range(6):
        (lease,) = store.claim("a", limit=1, ttl_s=60)
        order.append(store.get_job(lease.job_id).tenant)
        store.record_commit(record(lease))
    assert order == ["long", "short"] * 3 or order == ["short", "long"] * 3


def test_priority_counts_within_a_tenant_only(store: SqlStore) -> None:
    low, high = job_of(store, "t", 4), job_of(store, "t", 4, priority=5)
    other = job_of(store, "other", 4, priority=-5)
    leases = store.claim("a", limit=6, ttl_s=60)
    assert Counter(lease.job_id for lease in leases) == {high: 3, other: 3}
    store.change_job(low, {"priority": 9})
    assert {lease.job_id for lease in store.claim("a", limit=1, ttl_s=60) if lease.job_id != other} <= {low}


def test_a_job_whose_shards_were_given_back_comes_behind_the_tenants_others(store: SqlStore) -> None:
    troubled, fine = job_of(store, "t", 3, priority=5), job_of(store, "t", 3)
    (lease,) = store.claim("a", limit=1, ttl_s=60)
    assert lease.job_id == troubled
    store.release(lease.shard_id, lease.fence, "storage_error", wait_s=60)
    assert [lease.job_id for lease in store.claim("a", limit=5, ttl_s=60)] == sorted([fine] * 3 + [troubled] * 2)


def test_running_slots_are_limited(store: SqlStore) -> None:
    store.set_tenant_limits("t", TenantLimits(max_slots=2))
    job_of(store, "t")
    first = store.claim("a", limit=5, ttl_s=60)
    assert len(first) == 2
    assert store.claim("b", limit=5, ttl_s=60) == []
    store.record_commit(record(first[0]))
    assert len(store.claim("b", limit=5, ttl_s=60)) == 1
    store.set_tenant_limits("t", TenantLimits(max_slots=0))
    store.record_commit(record(first[1]))
    assert store.claim("b", limit=5, ttl_s=60) == []
    assert len(store.list_tenants()) == 1


_CLAIMER = """
import sys
from services.store.sql import SqlStore
store = SqlStore(sys.argv[1], migrate=False)
sys.stdin.readline()
for _ in range(10):
    for lease in store.claim(sys.argv[2], limit=2, ttl_s=600):
        print(lease.shard_id, flush=True)
"""


def test_processes_that_race_do_not_pass_the_limit(store: SqlStore, store_url: str) -> None:
    store.set_tenant_limits("t", TenantLimits(max_slots=5))
    job_of(store, "t", 40)
    job_of(store, "free", 40)
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", _CLAIMER, store_url, f"p{i}"],
            env=env,
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        for i in range(2)
    ]
    lines = [line for p in processes for line in p.communicate("go\n", timeout=120)[0].split()]
    assert [p.returncode for p in processes] == [0, 0]
    assert len(lines) == len(set(lines))
    taken = Counter(store.get_job(shard.rpartition("-")[0]).tenant for shard in lines)
    assert taken == {"t": 5, "free": 35}
