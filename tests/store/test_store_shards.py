"""Shards on every database: planned, leased, given back."""

from __future__ import annotations

from datetime import datetime

import pytest
from store_helpers import begin_planning, kinds, planned_job, plans, record, run_out, spec

from services.domain.errors import InvalidPageToken, InvalidTransition, ShardNotFound
from services.domain.models import Death, LeaseProgress, ShardPlan, VideoRef
from services.domain.states import JobState, ShardState
from services.store.sql import SqlStore


class TestPlanning:
    def test_shards_are_added_once(self, store: SqlStore) -> None:
        job, _ = store.create_job(spec())
        fence = begin_planning(store, job.id)
        assert store.add_shards(job.id, fence, plans(2), ttl_s=60)
        assert store.add_shards(job.id, fence, plans(3), ttl_s=60)
        assert store.finish_planning(job.id, fence)
        assert not store.add_shards(job.id, fence, plans(9), ttl_s=60)
        progress = store.get_job(job.id).progress
        assert (progress.shards_total, progress.videos_total) == (3, 6)
        assert kinds(store, job.id) == [
            "job.queued",
            "job.running",
            "shards.planned",
            "shards.planned",
            "planning.finished",
        ]

    def test_lists_have_pages(self, store: SqlStore) -> None:
        job_id = planned_job(store, 5, 2)
        page, cursor = store.list_shards(job_id, limit=3)
        rest, end = store.list_shards(job_id, limit=3, after=cursor)
        assert [s.ordinal for s in page + rest] == [0, 1, 2, 3, 4]
        assert end is None
        with pytest.raises(InvalidPageToken):
            store.list_shards(job_id, after="x")
        rows, cursor = store.list_videos(job_id, limit=7)
        rest_rows, end = store.list_videos(job_id, limit=7, after=cursor)
        assert [r.ref for r in rows + rest_rows] == [v for plan in plans(5) for v in plan.videos]
        assert end is None

    def test_a_job_cancelled_meanwhile_is_not_planned(self, store: SqlStore) -> None:
        job, _ = store.create_job(spec())
        fence = begin_planning(store, job.id)
        assert store.request_cancel(job.id).state is JobState.CANCELLED
        assert not store.add_shards(job.id, fence, plans(2), ttl_s=60)
        assert not store.renew_planning(job.id, fence, ttl_s=60)
        assert not store.finish_planning(job.id, fence)
        assert store.begin_planning(job.id, "planner", ttl_s=60) is None
        assert store.list_shards(job.id) == ([], None)

    def test_one_planner_at_a_time(self, store: SqlStore) -> None:
        job, _ = store.create_job(spec())
        begin_planning(store, job.id, "a")
        assert store.next_unplanned("b") is None
        assert store.begin_planning(job.id, "b", ttl_s=60) is None
        ours = store.next_unplanned("a")
        assert ours is not None
        assert ours.id == job.id

    def test_a_planner_that_was_replaced_has_no_say(self, store: SqlStore) -> None:
        job, _ = store.create_job(spec())
        slow = begin_planning(store, job.id, "slow", ttl_s=0)
        assert store.add_shards(job.id, slow, plans(1), ttl_s=0), "nobody replaced it yet"
        fast = begin_planning(store, job.id, "fast")
        other = ShardPlan(1, (VideoRef("late", "/in/late.mp4", 1),))
        assert not store.add_shards(job.id, slow, [other], ttl_s=60)
        assert not store.renew_planning(job.id, slow, ttl_s=60)
        assert not store.finish_planning(job.id, slow)
        store.fail_job(job.id, "input_unavailable", "out of date", planning_fence=slow)
        assert store.add_shards(job.id, fast, plans(2), ttl_s=60)
        assert store.finish_planning(job.id, fast)
        job = store.get_job(job.id)
        assert (job.state, job.progress.videos_total) == (JobState.RUNNING, 4)

    def test_a_shard_never_takes_the_place_of_another(self, store: SqlStore) -> None:
        job, _ = store.create_job(spec())
        fence = begin_planning(store, job.id)
        store.add_shards(job.id, fence, plans(1), ttl_s=60)
        other = ShardPlan(0, (VideoRef("late", "/in/late.mp4", 1),))
        with pytest.raises(InvalidTransition, match="shard 0"):
            store.add_shards(job.id, fence, [other], ttl_s=60)

    def test_a_job_that_fails_to_move_along_waits(self, store: SqlStore) -> None:
        first, second = (store.create_job(spec(f"/out{i}"))[0].id for i in range(2))
        fence = begin_planning(store, first)
        assert store.defer_job(first, base_s=600, max_s=1000, planning_fence=fence + 1).failures == 0, "not its turn"
        deferral = store.defer_job(first, base_s=600, max_s=1000, planning_fence=fence)
        assert (deferral.failures, deferral.failing_s, deferral.wait_s) == (1, 0.0, 600)
        unplanned = store.next_unplanned("planner")
        assert unplanned is not None
        assert unplanned.id == second
        assert store.begin_planning(first, "planner", ttl_s=60) is None
        assert store.defer_job(first, base_s=600, max_s=1000).wait_s == 1000
        assert store.defer_job(first, base_s=0, max_s=1000).failures == 3
        fence = begin_planning(store, first, "other")
        assert store.add_shards(first, fence, plans(1), ttl_s=60)
        assert store.defer_job(first, base_s=0, max_s=0).failures == 1, "it got along in between"

    def test_a_job_that_cannot_be_finalised_waits(self, store: SqlStore) -> None:
        job_id = planned_job(store, 1)
        (lease,) = store.claim("a", limit=1, ttl_s=60)
        store.record_commit(record(lease))
        assert store.next_finalizable() is not None
        store.defer_job(job_id, base_s=600, max_s=600)
        assert store.next_finalizable() is None

    def test_failing_a_job(self, store: SqlStore) -> None:
        job_id = planned_job(store, 2)
        (lease,) = store.claim("a", limit=1, ttl_s=60)
        store.fail_job(job_id, "output_in_use", "the reason")
        job = store.get_job(job_id)
        assert (job.state, job.error_code, job.error_message) == (JobState.FAILED, "output_in_use", "the reason")
        assert job.finished_at is not None
        assert store.claim("a", limit=9, ttl_s=60) == []
        assert store.renew("a", [LeaseProgress(lease.fence, lease.shard_id)], ttl_s=60)[0].verdict == "cancel"
        store.release(lease.shard_id, lease.fence, "stopped")
        assert {s.state for s in store.list_shards(job_id)[0]} == {ShardState.CANCELLED}
        store.fail_job(job_id, "other", "too late")
        assert store.get_job(job_id).error_code == "output_in_use"


class TestLeases:
    def test_what_was_given_back_waits_and_its_job_comes_last(self, store: SqlStore) -> None:
        troubled, good = planned_job(store, 3, output="/a"), planned_job(store, 2, output="/b")
        (lease,) = store.claim("a", limit=1, ttl_s=60)
        store.release(lease.shard_id, lease.fence, "storage_error", wait_s=600)
        got = store.claim("a", limit=9, ttl_s=60)
        assert [(g.job_id, g.ordinal) for g in got] == [(troubled, 1), (troubled, 2), (good, 0), (good, 1)]
        for other in got:
            store.release(other.shard_id, other.fence, "drained")
        (first,) = store.claim("a", limit=1, ttl_s=60)
        assert first.job_id == good

    def test_a_lease_carries_the_plan(self, store: SqlStore) -> None:
        job_id = planned_job(store, 2)
        (lease,) = store.claim("a", limit=1, ttl_s=60)
        (plan, _) = plans(2)
        assert (lease.job_id, lease.ordinal, lease.videos) == (job_id, 0, plan.videos)
        assert (lease.plan_hash, lease.spec) == (plan.plan_hash, spec())
        assert (lease.attempt, lease.fence, lease.holder, lease.spent) == (1, 1, "a", {})
        shard = store.list_shards(job_id)[0][0]
        assert (shard.state, shard.holder, shard.attempts) == (ShardState.LEASED, "a", 1)
        assert shard.lease_expires_at == lease.expires_at

    def test_older_jobs_are_served_first(self, store: SqlStore) -> None:
        first, second = planned_job(store, 2, output="/a"), planned_job(store, 2, output="/b")
        assert [(x.job_id, x.ordinal) for x in store.claim("a", limit=3, ttl_s=60)] == [
            (first, 0),
            (first, 1),
            (second, 0),
        ]
        assert store.claim("a", limit=0, ttl_s=60) == []

    def test_an_expired_shard_gets_a_larger_fence_and_the_old_one_is_out(self, store: SqlStore) -> None:
        planned_job(store, 1)
        (old,) = store.claim("a", limit=1, ttl_s=0)
        assert store.holds(old.shard_id, old.fence), "nobody took it yet"
        assert store.expire_leases() == 1
        assert not store.holds(old.shard_id, old.fence)
        (new,) = store.claim("b", limit=1, ttl_s=60)
        assert (new.fence, new.attempt) == (old.fence + 1, 2)
        report = [LeaseProgress(old.fence, old.shard_id, frames_done=7)]
        assert store.renew("a", report, ttl_s=60)[0].verdict == "lost"
        store.release(old.shard_id, old.fence, "late")
        assert store.blame(old.shard_id, old.fence, old.videos[0].key, Death("late")) == ()
        assert store.holds(new.shard_id, new.fence)
        assert store.expire_leases() == 0

    def test_renewing(self, store: SqlStore) -> None:
        planned_job(store, 2)
        first, second = store.claim("a", limit=2, ttl_s=0)
        renewals = store.renew(
            "a",
            [
                LeaseProgress(first.fence, first.shard_id),
                LeaseProgress(second.fence + 1, second.shard_id),
                LeaseProgress(1, "unknown"),
            ],
            ttl_s=60,
        )
        assert [(r.shard_id, r.verdict) for r in renewals] == [
            (first.shard_id, "continue"),
            (second.shard_id, "lost"),
            ("unknown", "lost"),
        ]
        assert store.renew("b", [LeaseProgress(first.fence, first.shard_id)], ttl_s=60)[0].verdict == "lost"
        assert store.expire_leases() == 1
        assert store.holds(first.shard_id, first.fence)

    def test_released_shards_are_pending_again(self, store: SqlStore) -> None:
        planned_job(store, 1)
        (lease,) = store.claim("a", limit=1, ttl_s=60)
        store.release(lease.shard_id, lease.fence, "preempted")
        (again,) = store.claim("b", limit=1, ttl_s=60)
        assert again.fence == lease.fence + 1
        with pytest.raises(ShardNotFound):
            store.release("nope", 1, "x")

    def test_deaths_survive_the_lease(self, store: SqlStore) -> None:
        job_id = planned_job(store, 1)
        (lease,) = store.claim("a", limit=1, ttl_s=60)
        key = lease.videos[1].key
        (first,) = store.blame(lease.shard_id, lease.fence, key, Death("SIGKILL", "h/slot-0", "a", 1))
        assert (first.reason, first.place, first.holder, first.attempt) == ("SIGKILL", "h/slot-0", "a", 1)
        assert datetime.fromisoformat(first.at).tzinfo is not None, "the database's clock says when"
        run_out(store, holder="a", shard_id=lease.shard_id, fence=lease.fence)
        (again,) = store.claim("b", limit=1, ttl_s=60)
        assert again.spent == {key: (first,)}
        both = store.blame(again.shard_id, again.fence, key, Death("SIGSEGV\0", "h/slot-1", "b", 2))
        assert [death.reason.rstrip("\0\ufffd") for death in both] == ["SIGKILL", "SIGSEGV"]
        blamed = [e.data for e in store.events(job_id) if e.kind == "video.blamed"]
        assert [(d["video_key"], d["deaths"], d["reason"]) for d in blamed] == [
            (key, 1, "SIGKILL"),
            (key, 2, "SIGSEGV\ufffd"),
        ]
        with pytest.raises(ShardNotFound):
            store.blame(again.shard_id, again.fence, "nope", Death("x"))
