"""The store's contract, on every database."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime

import pytest
from store_helpers import begin_planning, planned_job, plans, record, spec

from services.domain.errors import (
    CommitConflict,
    IdempotencyConflict,
    InvalidPageToken,
    InvalidTransition,
    JobNotCancellable,
    JobNotFound,
    OutputInUse,
    ShardNotFound,
)
from services.domain.models import CommitRecord, Death, LeaseProgress, ShardPlan, VideoRef
from services.domain.states import JobState, ShardState, VideoStatus
from services.store.sql import SqlStore


def kinds(store: SqlStore, job_id: str) -> list[str]:
    return [e.kind for e in store.events(job_id)]


def run_out(store: SqlStore, *, holder: str, shard_id: str, fence: int) -> None:
    """Let a lease run out without waiting: a renewal for no time at all."""
    assert store.renew(holder, [LeaseProgress(fence, shard_id)], ttl_s=0)[0].verdict != "lost"
    assert store.expire_leases() == 1


class TestJobs:
    def test_a_new_job_is_queued_with_its_spec(self, store: SqlStore) -> None:
        wanted = spec(inputs=("/a", "s3://b/c/"), attributes=("pose", "intrinsics"), name="näme")
        job, created = store.create_job(wanted, tenant="t")
        assert created
        assert (job.spec, job.state, job.tenant, job.planned) == (wanted, JobState.QUEUED, "t", False)
        assert job.created_at.utcoffset() is not None
        assert store.get_job(job.id) == job
        assert kinds(store, job.id) == ["job.queued"]

    def test_an_unknown_job(self, store: SqlStore) -> None:
        for call in (store.get_job, store.request_cancel, store.list_videos, store.list_shards, store.events):
            with pytest.raises(JobNotFound, match="job_x"):
                call("job_x")

    def test_a_tenant_sees_its_own_jobs_only(self, store: SqlStore) -> None:
        mine, _ = store.create_job(spec("/mine"), tenant="a")
        theirs, _ = store.create_job(spec("/theirs"), tenant="b")
        for call in (store.get_job, store.request_cancel, store.list_videos, store.list_shards, store.events):
            with pytest.raises(JobNotFound):
                call(theirs.id, tenant="a")
            call(mine.id, tenant="a")
            call(theirs.id)
        assert store.get_job(theirs.id).state is JobState.CANCELLED, "by the service itself"
        assert [job.id for job in store.list_jobs(tenant="a")[0]] == [mine.id]
        assert [job.id for job in store.list_jobs(tenant="a", state=JobState.CANCELLED)[0]] == [mine.id]
        assert len(store.list_jobs()[0]) == 2
        owner, _ = store.create_job(spec("/shared"), tenant="b")
        with pytest.raises(OutputInUse, match="another tenant") as refused:
            store.create_job(spec("/shared"), tenant="a")
        assert owner.id not in str(refused.value)

    def test_the_same_key_gives_the_same_job(self, store: SqlStore) -> None:
        first, created = store.create_job(spec(), idempotency_key="k")
        again, created_again = store.create_job(spec(), idempotency_key="k")
        assert (created, created_again) == (True, False)
        assert again.id == first.id
        with pytest.raises(IdempotencyConflict):
            store.create_job(spec(preset="other"), idempotency_key="k")
        other, _ = store.create_job(spec("/elsewhere"), tenant="other", idempotency_key="k")
        assert other.id != first.id

    @pytest.mark.parametrize("same", ["/out/", "/x/../out"])
    def test_an_output_has_one_owner(self, store: SqlStore, same: str) -> None:
        owner, _ = store.create_job(spec("/out"))
        with pytest.raises(OutputInUse, match=owner.id):
            store.create_job(spec(same))
        store.request_cancel(owner.id)
        store.create_job(spec(same))

    @pytest.mark.parametrize("how", ["fail", "cancel"])
    def test_an_output_stays_with_the_first_job_that_wrote_to_it(self, store: SqlStore, how: str) -> None:
        without_shards, _ = store.create_job(spec())
        store.fail_job(without_shards.id, "input_unavailable", "no such folder")
        owner = planned_job(store)
        if how == "fail":
            store.fail_job(owner, "storage_refused", "gone")
        else:
            store.request_cancel(owner)
        with pytest.raises(OutputInUse, match=f"{owner}.*choose another folder"):
            store.create_job(spec())

    def test_s3_outputs_have_one_spelling(self, store: SqlStore) -> None:
        store.create_job(spec("s3://bucket/prefix"))
        with pytest.raises(OutputInUse):
            store.create_job(spec("s3://bucket/prefix/"))

    def test_jobs_are_listed_newest_first_in_pages(self, store: SqlStore) -> None:
        ids = [store.create_job(spec(f"/out{i}"))[0].id for i in range(5)]
        assert ids == sorted(ids)
        seen: list[str] = []
        cursor: str | None = None
        while True:
            page, cursor = store.list_jobs(limit=2, after=cursor)
            seen += [job.id for job in page]
            if cursor is None:
                break
        assert seen == ids[::-1]
        store.request_cancel(ids[2])
        assert [job.id for job in store.list_jobs(state=JobState.CANCELLED)[0]] == [ids[2]]

    def test_the_oldest_unplanned_job_comes_first(self, store: SqlStore) -> None:
        assert store.next_unplanned("a") is None
        first, second = (store.create_job(spec(f"/out{i}"))[0].id for i in range(2))
        begin_planning(store, first, "a")
        unplanned = store.next_unplanned("a")
        assert unplanned is not None
        assert unplanned.id == first
        fence = begin_planning(store, first, "a")  # Planning that was cut off begins again.
        assert store.finish_planning(first, fence)
        assert store.begin_planning(first, "a", ttl_s=60) is None
        unplanned = store.next_unplanned("a")
        assert unplanned is not None
        assert unplanned.id == second


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


class TestCommitPoint:
    """The database decides where the output cannot."""

    def test_what_the_probe_found_is_settled_once(self, store: SqlStore) -> None:
        job, _ = store.create_job(spec())
        assert store.commit_point(job.id) is None
        old = begin_planning(store, job.id, ttl_s=0)
        fence = begin_planning(store, job.id, "other")
        assert store.settle_commit_point(job.id, old, True) is None
        assert store.settle_commit_point(job.id, fence, False) is False
        assert store.settle_commit_point(job.id, fence, True) is False, "all agents go by the first answer"
        assert store.commit_point(job.id) is False
        (event,) = [e.data for e in store.events(job.id) if e.kind == "output.probed"]
        assert event == {"create_once": False, "commit_point": "database"}
        store.add_shards(job.id, fence, plans(1), ttl_s=60)
        (lease,) = store.claim("a", limit=1, ttl_s=60)
        assert not lease.create_once
        with pytest.raises(JobNotFound):
            store.commit_point("nope")

    def test_a_tar_name_is_taken_once_in_a_job(self, store: SqlStore) -> None:
        planned_job(store, 2)
        first, second = store.claim("a", limit=2, ttl_s=0)
        assert first.create_once
        assert store.take_tar_name(first.shard_id, first.fence, ["x", "y"]) == "x"
        assert store.take_tar_name(first.shard_id, first.fence, ["x", "y"]) == "y"
        assert store.take_tar_name(second.shard_id, second.fence, ["x", "y"]) is None
        store.expire_leases()
        assert store.take_tar_name(first.shard_id, first.fence, ["z"]) is None, "its lease is lost"
        planned_job(store, 1, output="/other")
        (elsewhere,) = (x for x in store.claim("a", limit=3, ttl_s=60) if x.spec.output == "/other")
        assert store.take_tar_name(elsewhere.shard_id, elsewhere.fence, ["x"]) == "x"

    def test_the_first_record_of_a_current_lease_counts(self, store: SqlStore) -> None:
        job_id = planned_job(store, 1)
        (zombie,) = store.claim("a", limit=1, ttl_s=0)
        store.expire_leases()
        (lease,) = store.claim("b", limit=1, ttl_s=60)
        assert store.decide_commit(record(zombie)) is None
        assert store.decided_commit(lease.shard_id) is None
        winner = record(lease)
        assert store.decide_commit(winner) == winner.to_bytes()
        assert store.decide_commit(replace(winner, holder="again")) == winner.to_bytes()
        assert store.decide_commit(record(zombie)) == winner.to_bytes(), "who comes late learns what counts"
        assert store.decided_commits(job_id) == [winner.to_bytes()] == [store.decided_commit(lease.shard_id)]

        run_out(store, holder="b", shard_id=lease.shard_id, fence=lease.fence)
        (again,) = store.claim("c", limit=1, ttl_s=60)
        assert store.decide_commit(record(again)) == winner.to_bytes(), "it outlives the lease"
        assert store.record_commit(CommitRecord.from_bytes(winner.to_bytes()))
        assert store.decided_commits(job_id) == []
        assert store.decided_commit(lease.shard_id) is None
        assert store.decide_commit(record(again)) is None, "it is committed"


class TestCommit:
    def test_a_commit_is_recorded_once(self, store: SqlStore) -> None:
        job_id = planned_job(store, 2)
        ok, bad = store.claim("a", limit=2, ttl_s=60)
        assert store.record_commit(record(ok))
        assert not store.record_commit(record(ok))
        assert store.record_commit(record(bad, VideoStatus.FAILED))
        assert not store.holds(ok.shard_id, ok.fence)
        assert store.renew("a", [LeaseProgress(ok.fence, ok.shard_id)], ttl_s=60)[0].verdict == "lost"
        progress = store.get_job(job_id).progress
        assert (progress.shards_committed, progress.videos_succeeded, progress.videos_failed) == (2, 2, 2)
        assert progress.frames_done == 20
        assert kinds(store, job_id).count("shard.committed") == 2
        shard = store.list_shards(job_id)[0][0]
        assert (shard.state, shard.tar_name, shard.holder) == (ShardState.COMMITTED, "tar-0", None)

    def test_results_are_kept(self, store: SqlStore) -> None:
        job_id = planned_job(store, 2)
        ok, bad = store.claim("a", limit=2, ttl_s=60)
        store.record_commit(record(ok))
        store.record_commit(record(bad, VideoStatus.FAILED))
        (row, _), _ = store.list_videos(job_id, status=VideoStatus.SUCCEEDED)
        assert row.result is not None
        assert row.result.camera_params == (1.0, 2.0, 3.0, 4.0)
        assert row.result.quality == {"score": 0.5, "bad": None}, "what is not a number is no JSON"
        assert len(store.list_videos(job_id, error_code="media_corrupt")[0]) == 2
        assert store.list_videos(job_id, error_code="decode_timeout")[0] == []
        assert store.list_videos(job_id, status=VideoStatus.PENDING)[0] == []

    def test_the_record_wins_over_the_lease(self, store: SqlStore) -> None:
        """The zombie's record was created first in object storage: it is the truth."""
        planned_job(store, 1)
        (zombie,) = store.claim("a", limit=1, ttl_s=0)
        store.expire_leases()
        (loser,) = store.claim("b", limit=1, ttl_s=60)
        assert store.record_commit(record(zombie))
        assert not store.record_commit(record(loser))
        assert not store.holds(loser.shard_id, loser.fence)

    def test_the_reconciler_commits_a_pending_shard(self, store: SqlStore) -> None:
        job_id = planned_job(store, 2)
        (lease,) = store.claim("a", limit=1, ttl_s=0)
        store.expire_leases()
        assert [s.ordinal for s in store.uncommitted_shards(job_id)] == [0, 1]
        assert store.record_commit(record(lease))
        assert [s.ordinal for s in store.uncommitted_shards(job_id)] == [1]

    def test_foreign_records_are_refused(self, store: SqlStore) -> None:
        planned_job(store, 2)
        lease, other = store.claim("a", limit=2, ttl_s=60)
        with pytest.raises(CommitConflict):
            store.record_commit(record(lease, plan_hash="0" * 64))
        with pytest.raises(CommitConflict):
            store.record_commit(record(lease, fence=lease.fence + 1))
        with pytest.raises(CommitConflict):
            store.record_commit(record(lease, plan_hash=other.plan_hash))
        assert store.holds(lease.shard_id, lease.fence)

    @pytest.mark.parametrize(
        ("status", "end"),
        [
            (VideoStatus.SUCCEEDED, JobState.SUCCEEDED),
            (VideoStatus.FAILED, JobState.SUCCEEDED_WITH_ERRORS),
            (VideoStatus.QUARANTINED, JobState.SUCCEEDED_WITH_ERRORS),
        ],
    )
    def test_to_the_end(self, store: SqlStore, status: VideoStatus, end: JobState) -> None:
        job_id = planned_job(store, 2)
        leases = store.claim("a", limit=2, ttl_s=60)
        store.record_commit(record(leases[0]))
        assert store.next_finalizable() is None
        with pytest.raises(InvalidTransition):
            store.finish_job(job_id)
        store.record_commit(record(leases[1], status))
        for _ in range(2):
            job = store.next_finalizable()
            assert job is not None
            assert (job.id, job.state) == (job_id, JobState.FINALIZING)
        done = store.finish_job(job_id)
        assert done.state is end
        assert done.finished_at is not None
        assert store.finish_job(job_id) == done
        assert store.next_finalizable() is None
        assert kinds(store, job_id)[-2:] == ["job.finalizing", f"job.{end.value}"]

    def test_an_unplanned_job_is_not_finalised(self, store: SqlStore) -> None:
        job, _ = store.create_job(spec())
        store.add_shards(job.id, begin_planning(store, job.id), plans(1), ttl_s=60)
        (lease,) = store.claim("a", limit=1, ttl_s=60)
        store.record_commit(record(lease))
        assert store.next_finalizable() is None


class TestTidying:
    def test_a_finished_job_is_swept_once(self, store: SqlStore) -> None:
        job_id = planned_job(store, 1)
        (lease,) = store.claim("a", limit=1, ttl_s=60)
        store.record_commit(record(lease))
        store.next_finalizable()
        assert store.next_unswept(quiet_s=0) is None
        store.finish_job(job_id)
        assert store.next_unswept(quiet_s=600) == store.get_job(job_id)
        store.finish_sweep(job_id)
        assert store.next_unswept(quiet_s=600) is None

    def test_a_job_that_was_given_up_is_swept_when_nobody_works_on_it(self, store: SqlStore) -> None:
        job_id = planned_job(store, 1)
        (lease,) = store.claim("a", limit=1, ttl_s=60)
        store.fail_job(job_id, "storage_refused", "gone")
        assert store.next_unswept(quiet_s=0) is None
        store.release(lease.shard_id, lease.fence, "stopped")
        assert store.next_unswept(quiet_s=600) is None
        job = store.next_unswept(quiet_s=-1)
        assert job is not None
        assert job.id == job_id

    def test_a_job_without_shards_has_nothing_to_sweep(self, store: SqlStore) -> None:
        store.request_cancel(store.create_job(spec())[0].id)
        assert store.next_unswept(quiet_s=-1) is None


class TestCancel:
    def test_without_leases_at_once(self, store: SqlStore) -> None:
        queued, _ = store.create_job(spec("/a"))
        running = planned_job(store, 2, output="/b")
        for job_id in (queued.id, running):
            assert store.request_cancel(job_id).state is JobState.CANCELLED
            with pytest.raises(JobNotCancellable):
                store.request_cancel(job_id)
            assert kinds(store, job_id)[-2:] == ["job.cancelling", "job.cancelled"]
        assert store.claim("a", limit=9, ttl_s=60) == []

    @pytest.mark.parametrize("how", ["release", "expire", "commit"])
    def test_with_a_lease_when_it_ends(self, store: SqlStore, how: str) -> None:
        job_id = planned_job(store, 2)
        (lease,) = store.claim("a", limit=1, ttl_s=60)
        assert store.request_cancel(job_id).state is JobState.CANCELLING
        assert store.request_cancel(job_id).state is JobState.CANCELLING
        assert store.claim("b", limit=9, ttl_s=60) == []
        report = [LeaseProgress(lease.fence, lease.shard_id)]
        assert store.renew("a", report, ttl_s=60)[0].verdict == "cancel"
        assert store.expire_leases() == 0
        if how == "release":
            store.release(lease.shard_id, lease.fence, "cancelled")
        elif how == "expire":
            run_out(store, holder="a", shard_id=lease.shard_id, fence=lease.fence)
        else:
            assert store.record_commit(record(lease))
        assert store.get_job(job_id).state is JobState.CANCELLED
        last = ShardState.COMMITTED if how == "commit" else ShardState.CANCELLED
        assert [s.state for s in store.list_shards(job_id)[0]] == [last, ShardState.CANCELLED]

    def test_not_when_finalizing_or_ended(self, store: SqlStore) -> None:
        job_id = planned_job(store, 1)
        store.record_commit(record(store.claim("a", limit=1, ttl_s=60)[0]))
        store.next_finalizable()
        with pytest.raises(JobNotCancellable):
            store.request_cancel(job_id)
        store.finish_job(job_id)
        with pytest.raises(JobNotCancellable):
            store.request_cancel(job_id)


class TestReading:
    def test_progress_counts_live_leases(self, store: SqlStore) -> None:
        job_id = planned_job(store, 4, videos_each=2)
        assert store.get_job(job_id).progress.frames_expected is None
        first, second = store.claim("a", limit=2, ttl_s=60)
        store.record_commit(record(first, frames=10))
        report = LeaseProgress(second.fence, second.shard_id, "k", "slam", 1, 15, 40)
        store.renew("a", [report], ttl_s=60)
        progress = store.get_job(job_id).progress
        assert (progress.frames_done, progress.videos_done, progress.videos_succeeded) == (35, 3, 2)
        assert progress.frames_expected == 60 + 15 * 4, "20 and 40 known, 4 more videos at their mean of 15"
        assert progress.frames_per_s > 0
        assert progress.eta_s is not None
        assert progress.eta_s == pytest.approx(85 / progress.frames_per_s)
        store.release(second.shard_id, second.fence, "x")
        assert store.get_job(job_id).progress.frames_done == 20

    def test_counts(self, store: SqlStore) -> None:
        planned_job(store, 3)
        store.claim("a", limit=1, ttl_s=60)
        counts = store.counts()
        assert counts["jobs"]["running"] == 1
        assert counts["shards"] == {"pending": 2, "leased": 1, "committed": 0, "cancelled": 0}
        assert set(counts["jobs"]) == {s.value for s in JobState}

    def test_events_continue_after_a_number(self, store: SqlStore) -> None:
        job_id = planned_job(store, 1)
        planned_job(store, 1, output="/other")
        everything = store.events(job_id)
        assert [e.seq for e in everything] == sorted({e.seq for e in everything})
        assert {e.job_id for e in everything} == {job_id}
        assert store.events(job_id, after_seq=everything[1].seq) == everything[2:]
        assert store.events(job_id, limit=2) == everything[:2]

    def test_it_survives_a_restart(self, store: SqlStore, store_url: str) -> None:
        job_id = planned_job(store, 2)
        (lease,) = store.claim("a", limit=1, ttl_s=60)
        before = store.events(job_id)
        store.close()
        again = SqlStore(store_url)
        assert again.events(job_id) == before
        assert again.holds(lease.shard_id, lease.fence)
        again.ping()
        again.close()
