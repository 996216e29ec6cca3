"""Jobs on every database: their creation, lists, cancelling, and what is read of them."""

from __future__ import annotations

import pytest
from store_helpers import begin_planning, kinds, planned_job, record, run_out, spec

from services.domain.errors import IdempotencyConflict, JobNotCancellable, JobNotFound, OutputInUse
from services.domain.models import LeaseProgress
from services.domain.states import JobState, ShardState
from services.store.sql import SqlStore


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
