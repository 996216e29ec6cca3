"""A database of the first release, with rows in every state, comes up to date and works on."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import datetime, timedelta
from typing import Any

import pytest
from sqlalchemy import MetaData, Table, insert, select
from store_helpers import plans, record, spec

from services.domain.control import RetrySelection
from services.domain.models import shard_id
from services.domain.states import JobState, ShardState, VideoStatus
from services.store import migrations
from services.store.database import Database
from services.store.sql import SqlStore

LONG_AGO = datetime(2024, 1, 1)
FIRST_STATES = (
    "queued",
    "running",
    "finalizing",
    "cancelling",
    "succeeded",
    "succeeded_with_errors",
    "failed",
    "cancelled",
)
TABLES = ("jobs", "shards", "videos", "events")


def job_id(state: str) -> str:
    return f"job_{FIRST_STATES.index(state):026d}"


def reflected(database: Database) -> dict[str, Table]:
    metadata = MetaData()
    metadata.reflect(database.engine, only=TABLES)
    return {name: metadata.tables[name] for name in TABLES}


def fill(database: Database) -> None:
    """One job in each state. The running one has a shard in each state that a running job's can have."""
    tables = reflected(database)
    rows: dict[str, list[dict[str, Any]]] = {name: [] for name in TABLES}
    for state in FIRST_STATES:
        committed = {"finalizing": 2, "succeeded": 2, "succeeded_with_errors": 2, "running": 1}.get(state, 0)
        shards = [] if state == "queued" else plans(3 if state == "running" else 2)
        lost = 2 if state == "succeeded_with_errors" else 0
        rows["jobs"].append(
            {
                "id": job_id(state),
                "tenant": "default" if state == "queued" else "team",
                "spec": spec(f"/out/{state}").to_json(),
                "output": f"/out/{state}",
                "state": state,
                "planned": bool(shards),
                "created_at": LONG_AGO,
                "updated_at": LONG_AGO,
                "started_at": LONG_AGO if shards else None,
                "shards_total": len(shards),
                "shards_committed": committed,
                "videos_total": 2 * len(shards),
                "videos_succeeded": 2 * committed - lost,
                "videos_failed": lost,
                "frames_committed": 10 * (2 * committed - lost),
            }
        )
        rows["events"].append({"job_id": job_id(state), "at": LONG_AGO, "kind": "job.queued", "data": {"name": ""}})
        for plan in shards:
            done, lost_here = plan.ordinal < committed, lost > 0 and plan.ordinal == 1
            shard_state = "committed" if done else "cancelled" if state in ("failed", "cancelled") else "pending"
            leased = plan.ordinal == 1 and state in ("running", "cancelling")
            rows["shards"].append(
                {
                    "id": shard_id(job_id(state), plan.ordinal),
                    "job_id": job_id(state),
                    "ordinal": plan.ordinal,
                    "state": "leased" if leased else "cancelled" if state == "cancelling" else shard_state,
                    "plan_hash": plan.plan_hash,
                    "num_videos": 2,
                    "input_bytes": 20,
                    "attempts": int(leased or done),
                    "fence": int(leased or done),
                    "holder": "old" if leased else None,
                    "leased_at": LONG_AGO if leased or done else None,
                    "lease_expires_at": LONG_AGO + timedelta(minutes=1) if leased else None,
                    "tar_name": f"tar-{plan.ordinal}" if done else None,
                    "committed_at": LONG_AGO if done else None,
                }
            )
            status = "failed" if lost_here else "succeeded" if done else "pending"
            rows["videos"] += [
                {
                    "job_id": job_id(state),
                    "key": video.key,
                    "shard_id": shard_id(job_id(state), plan.ordinal),
                    "position": position,
                    "uri": video.uri,
                    "size_bytes": video.size_bytes,
                    "etag": video.etag,
                    "status": status,
                    "deaths": 1 if status == "pending" else 0,
                    "error_code": "video_timeout" if lost_here else None,
                    "result": None,
                }
                for position, video in enumerate(plan.videos)
            ]
    with database.engine.begin() as conn:
        for name in TABLES:
            conn.execute(insert(tables[name]), rows[name])


def contents(database: Database, columns: dict[str, list[str]]) -> dict[str, list[tuple[Any, ...]]]:
    tables = reflected(database)
    with database.engine.connect() as conn:
        return {
            name: sorted(
                (tuple(row) for row in conn.execute(select(*(tables[name].c[c] for c in columns[name])))), key=repr
            )
            for name in TABLES
        }


@pytest.fixture
def old(store_url: str) -> Iterator[Database]:
    database = Database(store_url)
    migrations.upgrade(database, "0001")
    fill(database)
    yield database
    database.close()


def test_no_row_is_lost_or_changed(old: Database) -> None:
    columns = {name: [c.name for c in table.columns] for name, table in reflected(old).items()}
    before = contents(old, columns)
    assert {name: len(rows) for name, rows in before.items()} == {"jobs": 8, "shards": 15, "videos": 30, "events": 8}
    migrations.upgrade(old)
    assert contents(old, columns) == before
    migrations.upgrade(old)
    assert contents(old, columns) == before


def test_everything_that_was_under_way_goes_on(old: Database, store_url: str) -> None:
    store = SqlStore(store_url)
    assert {s: store.get_job(job_id(s)).state.value for s in FIRST_STATES} == {s: s for s in FIRST_STATES}
    assert {t.name for t in store.list_tenants()} == {"default", "team"}

    assert store.expire_leases() == 2
    assert store.get_job(job_id("cancelling")).state is JobState.CANCELLED
    running = store.get_job(job_id("running"))
    assert 59 < running.slot_seconds < 61, "what the lost lease has cost"
    leases = store.claim("new", limit=9, ttl_s=60)
    assert [(lease.ordinal, lease.fence, lease.attempt) for lease in leases] == [(1, 2, 2), (2, 1, 1)]
    assert len(leases[0].spent) == 2
    store.request_pause(running.id)
    store.resume(running.id)
    for lease in leases:
        assert store.record_commit(record(lease))

    ended = set()
    while (job := store.next_finalizable()) is not None:
        ended.add(store.finish_job(job.id).id)
    assert ended == {job_id("finalizing"), running.id}

    retried = store.retry(job_id("succeeded_with_errors"), RetrySelection())
    assert (retried.state, retried.progress.videos_failed) == (JobState.RUNNING, 0)
    (lease,) = store.claim("new", limit=9, ttl_s=60)
    assert (lease.ordinal, lease.retry, len(lease.videos)) == (2, 1, 2)
    assert store.record_commit(record(lease))
    again = store.next_finalizable()
    assert again is not None
    assert store.finish_job(again.id).state is JobState.SUCCEEDED

    unplanned = store.next_unplanned("planner")
    assert unplanned is not None
    assert unplanned.id == job_id("queued")
    fence = store.begin_planning(unplanned.id, "planner", ttl_s=60)
    assert fence is not None
    assert store.add_shards(unplanned.id, fence, plans(1), ttl_s=60)
    states = {s.state for s in store.list_shards(job_id("failed"))[0]}
    assert states == {ShardState.CANCELLED}
    assert len(store.list_videos(job_id("succeeded"), status=VideoStatus.SUCCEEDED)[0]) == 4
    store.close()
