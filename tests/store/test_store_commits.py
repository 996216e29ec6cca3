"""Commits on every database: the first record counts, results are kept, a job ends and is swept."""

from __future__ import annotations

from dataclasses import replace

import pytest
from store_helpers import begin_planning, kinds, planned_job, plans, record, run_out, spec

from services.domain.errors import CommitConflict, InvalidTransition, JobNotFound
from services.domain.models import CommitRecord, LeaseProgress
from services.domain.states import JobState, ShardState, VideoStatus
from services.store.sql import SqlStore


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
