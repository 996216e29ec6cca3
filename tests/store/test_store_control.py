"""Pause, resume, change, and the limits that pause: on every database."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta

import pytest
from sqlalchemy import update
from store_helpers import begin_planning, planned_job, plans, record, spec

from services.domain.control import JobControl, PauseReason, TenantLimits
from services.domain.errors import (
    InvalidRequest,
    JobEnded,
    JobNotFound,
    JobNotPausable,
    JobNotResumable,
    QuotaExceeded,
)
from services.domain.models import LeaseProgress
from services.domain.states import JobState, ShardState, VideoStatus
from services.store import schema
from services.store.database import Database
from services.store.sql import SqlStore


def soon(seconds: float = 3600) -> datetime:
    return datetime.now(UTC) + timedelta(seconds=seconds)


def last_event(store: SqlStore, job_id: str) -> tuple[str, dict[str, object]]:
    event = store.events(job_id)[-1]
    return event.kind, event.data


def controlled_job(store: SqlStore, control: JobControl, number: int = 3, videos_each: int = 2) -> str:
    job, _ = store.create_job(spec(), control=control)
    fence = begin_planning(store, job.id)
    assert store.add_shards(job.id, fence, plans(number, videos_each), ttl_s=60)
    assert store.finish_planning(job.id, fence)
    return job.id


@contextmanager
def earlier(store_url: str, job_id: str, seconds: float) -> Iterator[None]:
    """Everything that was noted about a job happened `seconds` before."""
    database = Database(store_url)
    shards, jobs, by = schema.shards.c, schema.jobs.c, timedelta(seconds=seconds)
    try:
        for row in database.read(lambda tx: tx.rows(schema.shards.select().where(shards.job_id == job_id))):
            moved = {name: getattr(row, name) - by for name in ("leased_at", "committed_at") if getattr(row, name)}
            if moved:
                database.write(
                    lambda tx, row=row, moved=moved: tx.run(
                        update(schema.shards).where(shards.id == row.id).values(**moved)
                    )
                )
        job = database.read(lambda tx: tx.rows(schema.jobs.select().where(jobs.id == job_id)))[0]
        if job.deadline is not None:
            database.write(
                lambda tx: tx.run(update(schema.jobs).where(jobs.id == job_id).values(deadline=job.deadline - by))
            )
        yield
    finally:
        database.close()


class TestPause:
    def test_a_paused_job_gives_no_lease_and_calls_back_those_that_live(self, store: SqlStore) -> None:
        job_id = planned_job(store, 3)
        (lease,) = store.claim("a", limit=1, ttl_s=60)
        job = store.request_pause(job_id)
        assert (job.state, job.pause_reason) == (JobState.PAUSED, PauseReason.REQUESTED)
        assert store.claim("b", limit=9, ttl_s=60) == []
        assert store.job_states([job_id]) == {job_id: JobState.PAUSED}
        (renewal,) = store.renew("a", [LeaseProgress(lease.fence, lease.shard_id)], ttl_s=60)
        assert renewal.verdict == "pause"
        store.release(lease.shard_id, lease.fence, "paused")
        assert {s.state for s in store.list_shards(job_id)[0]} == {ShardState.PENDING}
        assert store.request_pause(job_id).state is JobState.PAUSED
        assert [e.kind for e in store.events(job_id)].count("job.paused") == 1
        assert store.counts()["paused"]["requested"] == 1

    def test_resumed_it_goes_on(self, store: SqlStore) -> None:
        job_id = planned_job(store, 2)
        store.request_pause(job_id)
        job = store.resume(job_id)
        assert (job.state, job.pause_reason, job.pause_message) == (JobState.RUNNING, None, None)
        assert last_event(store, job_id) == ("job.running", {"resumed": True, "paused_for": "requested"})
        assert len(store.claim("a", limit=9, ttl_s=60)) == 2
        assert store.resume(job_id).state is JobState.RUNNING

    def test_a_job_that_waits_can_be_paused_and_waits_again(self, store: SqlStore) -> None:
        job, _ = store.create_job(spec())
        store.request_pause(job.id)
        assert store.next_unplanned("a") is None
        assert store.begin_planning(job.id, "a", ttl_s=60) is None
        assert store.resume(job.id).state is JobState.QUEUED
        begin_planning(store, job.id)

    def test_a_planner_stops_and_another_goes_on_after_the_pause(self, store: SqlStore) -> None:
        job, _ = store.create_job(spec())
        first = begin_planning(store, job.id, "a", ttl_s=3600)
        assert store.add_shards(job.id, first, plans(1), ttl_s=3600)
        store.request_pause(job.id)
        assert not store.add_shards(job.id, first, plans(2), ttl_s=3600)
        assert not store.finish_planning(job.id, first)
        store.resume(job.id)
        second = begin_planning(store, job.id, "b")
        assert not store.add_shards(job.id, first, plans(2), ttl_s=60)
        assert store.add_shards(job.id, second, plans(2), ttl_s=60)
        assert store.finish_planning(job.id, second)

    def test_what_is_committed_meanwhile_counts_and_the_end_waits_for_the_resumption(self, store: SqlStore) -> None:
        job_id = planned_job(store, 1)
        (lease,) = store.claim("a", limit=1, ttl_s=60)
        store.request_pause(job_id)
        assert store.record_commit(record(lease))
        assert store.next_finalizable() is None
        store.resume(job_id)
        job = store.next_finalizable()
        assert job is not None
        assert job.id == job_id

    def test_a_paused_job_can_be_cancelled_or_fail(self, store: SqlStore) -> None:
        first, second = planned_job(store, 1), planned_job(store, 1, output="/other")
        store.request_pause(first)
        store.request_pause(second)
        assert store.request_cancel(first).state is JobState.CANCELLED
        store.fail_job(second, "storage_refused", "no")
        assert store.get_job(second).state is JobState.FAILED
        for ended in (first, second):
            with pytest.raises(JobNotPausable):
                store.request_pause(ended)
            with pytest.raises(JobNotResumable):
                store.resume(ended)

    def test_of_another_tenant_there_is_nothing_to_pause(self, store: SqlStore) -> None:
        job_id = planned_job(store, 1)
        for call in (store.request_pause, store.resume):
            with pytest.raises(JobNotFound):
                call(job_id, tenant="other")
        with pytest.raises(JobNotFound):
            store.change_job(job_id, {"priority": 1}, tenant="other")
        assert store.get_job(job_id).state is JobState.RUNNING


class TestChange:
    def test_a_job_keeps_how_it_is_run(self, store: SqlStore) -> None:
        control = JobControl(7, soon(), 12.5, 0.25, 50, "https://example.org/hook", "ours")
        job, _ = store.create_job(spec(), control=control)
        assert store.get_job(job.id).control == control

    def test_only_what_is_named_changes_and_only_once(self, store: SqlStore) -> None:
        job, _ = store.create_job(spec(), control=JobControl(priority=1, max_slot_hours=2.0))
        changed = store.change_job(job.id, {"priority": 5, "max_slot_hours": None})
        assert changed.control == JobControl(priority=5)
        assert last_event(store, job.id) == ("job.updated", {"priority": 5, "max_slot_hours": None})
        before = store.events(job.id)
        store.change_job(job.id, {"priority": 5})
        assert store.events(job.id) == before

    def test_a_deadline_lies_ahead(self, store: SqlStore) -> None:
        with pytest.raises(InvalidRequest, match="passed"):
            store.create_job(spec(), control=JobControl(deadline=soon(-1)))
        job, _ = store.create_job(spec())
        with pytest.raises(InvalidRequest, match="passed"):
            store.change_job(job.id, {"deadline": soon(-1)})

    def test_an_ended_job_stays_as_it_is(self, store: SqlStore) -> None:
        job, _ = store.create_job(spec())
        store.request_cancel(job.id)
        with pytest.raises(JobEnded):
            store.change_job(job.id, {"priority": 5})


class TestLimits:
    def test_a_deadline_pauses(self, store: SqlStore, store_url: str) -> None:
        job_id = controlled_job(store, JobControl(deadline=soon()))
        assert store.pause_over_limits() == 0
        with earlier(store_url, job_id, 7200):
            assert store.pause_over_limits() == 1
            assert store.pause_over_limits() == 0
        job = store.get_job(job_id)
        assert (job.state, job.pause_reason) == (JobState.PAUSED, PauseReason.DEADLINE)
        assert last_event(store, job_id)[1]["reason"] == "deadline"
        with pytest.raises(JobNotResumable, match="deadline"):
            store.resume(job_id)
        store.change_job(job_id, {"deadline": soon()})
        assert store.resume(job_id).state is JobState.RUNNING

    def test_slot_seconds_are_those_of_committed_released_lost_and_live_leases(
        self, store: SqlStore, store_url: str
    ) -> None:
        job_id = planned_job(store, 4)
        committed, released, lost, _live = store.claim("a", limit=4, ttl_s=3600)
        with earlier(store_url, job_id, 100):
            store.record_commit(record(committed))
            store.release(released.shard_id, released.fence, "test")
            store.renew("a", [LeaseProgress(lost.fence, lost.shard_id)], ttl_s=0)
            assert store.expire_leases() == 1
        used = store.get_job(job_id).slot_seconds
        assert 400 <= used < 460
        (tenant,) = store.list_tenants()
        assert (tenant.name, tenant.slots) == ("default", 1)
        assert 400 <= tenant.slot_seconds < 460
        store.record_commit(record(lost))  # It had ended: nothing is counted twice.
        assert store.get_job(job_id).slot_seconds < 460

    def test_a_budget_pauses_when_live_and_ended_leases_have_used_it_up(self, store: SqlStore, store_url: str) -> None:
        job_id = controlled_job(store, JobControl(max_slot_hours=1.0))
        store.claim("a", limit=2, ttl_s=36000)
        assert store.pause_over_limits() == 0
        with earlier(store_url, job_id, 1850):
            assert store.pause_over_limits() == 1
        job = store.get_job(job_id)
        assert job.pause_reason == PauseReason.SLOT_HOURS
        assert job.pause_message is not None
        assert "of 1 slot-hours" in job.pause_message
        with pytest.raises(JobNotResumable, match="slot-hours"):
            store.resume(job_id)
        store.change_job(job_id, {"max_slot_hours": 5.0})
        assert store.resume(job_id).state is JobState.RUNNING

    def test_a_job_with_nothing_left_to_do_is_not_paused(self, store: SqlStore, store_url: str) -> None:
        job_id = controlled_job(store, JobControl(deadline=soon()), number=1)
        store.record_commit(record(store.claim("a", limit=1, ttl_s=60)[0]))
        with earlier(store_url, job_id, 7200):
            assert store.pause_over_limits() == 0

    def test_too_many_failures_pause_with_a_report(self, store: SqlStore) -> None:
        job_id = controlled_job(store, JobControl(max_failure_ratio=0.5, failure_window=6), number=8)
        leases = store.claim("a", limit=8, ttl_s=600)
        for lease in leases[:2]:
            store.record_commit(record(lease, VideoStatus.FAILED))
        assert store.get_job(job_id).state is JobState.RUNNING, "four settled videos say nothing yet"
        store.record_commit(record(leases[2]))
        assert store.get_job(job_id).state is JobState.RUNNING, "it is looked at when something fails"
        store.record_commit(record(leases[3], VideoStatus.FAILED))
        job = store.get_job(job_id)
        assert (job.state, job.pause_reason) == (JobState.PAUSED, PauseReason.FAILURE_RATIO)
        assert job.pause_message == "4 of the last 6 videos failed (media_corrupt 4), more than 50%"
        kind, data = last_event(store, job_id)
        assert kind == "job.paused"
        assert (data["settled"], data["lost"], data["error_codes"]) == (6, 4, {"media_corrupt": 4})

        store.resume(job_id)
        for lease in leases[4:6]:
            store.record_commit(record(lease, VideoStatus.FAILED))
        assert store.get_job(job_id).state is JobState.RUNNING, "what was settled before does not count any more"
        store.record_commit(record(leases[6], VideoStatus.FAILED))
        assert store.get_job(job_id).state is JobState.PAUSED

    def test_a_share_that_is_allowed_pauses_nothing(self, store: SqlStore) -> None:
        job_id = controlled_job(store, JobControl(max_failure_ratio=None, failure_window=1), number=5)
        other = planned_job(store, 5, output="/other")
        for lease in store.claim("a", limit=10, ttl_s=600):
            if lease.ordinal < 4:
                store.record_commit(record(lease, VideoStatus.FAILED))
        assert store.get_job(job_id).state is JobState.RUNNING
        assert store.get_job(other).state is JobState.RUNNING, "the default looks at 200 videos"


class TestTenants:
    def test_limits_are_its_own_or_those_of_everybody(self, store: SqlStore) -> None:
        store.create_job(spec(), tenant="t")
        assert store.list_tenants()[0].limits == TenantLimits()
        everybody, own = TenantLimits(max_jobs=3), TenantLimits(2.0, 4, 5, 6)
        store.set_tenant_limits("*", everybody)
        store.set_tenant_limits("t", own)
        assert {t.name: (t.limits, t.own_limits) for t in store.list_tenants()} == {
            "*": (everybody, True),
            "t": (own, True),
        }
        store.set_tenant_limits("t", None)
        assert {t.name: t.limits for t in store.list_tenants()}["t"] == everybody

    def test_open_jobs_are_limited(self, store: SqlStore) -> None:
        store.set_tenant_limits("*", TenantLimits(max_jobs=2))
        first, _ = store.create_job(spec("/a"))
        store.create_job(spec("/b"))
        with pytest.raises(QuotaExceeded, match="2 open jobs of 2"):
            store.create_job(spec("/c"))
        store.create_job(spec("/c"), tenant="other")
        store.request_cancel(first.id)
        store.create_job(spec("/d"))

    def test_a_plan_that_does_not_fit_pauses_its_job(self, store: SqlStore) -> None:
        store.set_tenant_limits("*", TenantLimits(max_videos=5))
        job, _ = store.create_job(spec())
        fence = begin_planning(store, job.id)
        assert store.add_shards(job.id, fence, plans(2), ttl_s=60)
        assert not store.add_shards(job.id, fence, plans(3), ttl_s=60)
        job = store.get_job(job.id)
        assert (job.state, job.pause_reason) == (JobState.PAUSED, PauseReason.TENANT_VIDEOS)
        assert job.progress.shards_total == 2
        store.resume(job.id)
        store.record_commit(record(store.claim("a", limit=1, ttl_s=60)[0]))
        fence = begin_planning(store, job.id)
        assert store.add_shards(job.id, fence, plans(3), ttl_s=60)
