"""The lease protocol against a small model in memory: every order of calls that hypothesis finds."""

from __future__ import annotations

from dataclasses import dataclass, field

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    Bundle,
    RuleBasedStateMachine,
    consumes,
    invariant,
    multiple,
    rule,
    run_state_machine_as_test,
)
from sqlalchemy import text
from store_helpers import planned_job, record

from services.domain.control import RetrySelection
from services.domain.errors import JobNotCancellable, JobNotPausable, JobNotResumable, JobNotRetryable
from services.domain.models import Death, Lease, LeaseProgress
from services.domain.states import JobState, ShardState, VideoStatus
from services.store.database import Database
from services.store.sql import SqlStore

SHARDS = 3
HOLDERS = ["a", "b"]


@dataclass
class ModelShard:
    state: ShardState = ShardState.PENDING
    fence: int = 0
    holder: str = ""
    run_out: bool = False
    deaths: dict[str, int] = field(default_factory=dict)
    result: VideoStatus | None = None
    videos: int = 2
    retry: int = 0
    superseded: bool = False  # its videos failed and belong to a later shard now


class LeaseProtocol(RuleBasedStateMachine):
    """One job of three shards. `url` is set by the test."""

    url: str
    leases = Bundle("leases")

    def __init__(self) -> None:
        super().__init__()
        self.store = SqlStore(self.url, migrate=False)
        cleaner = Database(self.url)
        cleaner.write(lambda tx: tx.run(text("DELETE FROM jobs")))  # takes everything else with it
        cleaner.close()
        self.job_id = planned_job(self.store, SHARDS, videos_each=2)
        self.shards = [ModelShard() for _ in range(SHARDS)]
        self.job = JobState.RUNNING
        self.retries = 0

    def teardown(self) -> None:
        self.store.close()

    def current(self, lease: Lease) -> bool:
        shard = self.shards[lease.ordinal]
        return shard.state is ShardState.LEASED and shard.fence == lease.fence

    def end_lease(self, shard: ModelShard) -> None:
        goes_on = self.job in (JobState.RUNNING, JobState.PAUSED)
        shard.state = ShardState.PENDING if goes_on else ShardState.CANCELLED
        shard.run_out = False

    def settle(self) -> None:
        if self.job is JobState.CANCELLING and not any(s.state is ShardState.LEASED for s in self.shards):
            self.job = JobState.CANCELLED

    @rule(target=leases, holder=st.sampled_from(HOLDERS), limit=st.integers(0, SHARDS))
    def claim(self, holder: str, limit: int):
        got = self.store.claim(holder, limit=limit, ttl_s=600)
        pending = [i for i, s in enumerate(self.shards) if s.state is ShardState.PENDING]
        expected = pending[:limit] if self.job is JobState.RUNNING else []
        assert [lease.ordinal for lease in got] == expected
        for lease in got:
            shard = self.shards[lease.ordinal]
            shard.state, shard.holder, shard.fence = ShardState.LEASED, holder, shard.fence + 1
            assert (lease.fence, lease.attempt, lease.holder) == (shard.fence, shard.fence, holder)
            assert (lease.retry, len(lease.videos)) == (shard.retry, shard.videos)
            assert {key: len(deaths) for key, deaths in lease.spent.items()} == shard.deaths
        return multiple(*got)

    @rule(lease=leases, holder=st.sampled_from(HOLDERS), for_no_time=st.booleans())
    def renew(self, lease: Lease, holder: str, for_no_time: bool) -> None:
        report = LeaseProgress(lease.fence, lease.shard_id, frames_done=1)
        (answer,) = self.store.renew(holder, [report], ttl_s=0 if for_no_time else 600)
        shard = self.shards[lease.ordinal]
        if not self.current(lease) or shard.holder != holder:
            assert answer.verdict == "lost"
            return
        assert answer.verdict == {JobState.RUNNING: "continue", JobState.PAUSED: "pause"}.get(self.job, "cancel")
        shard.run_out = for_no_time

    @rule()
    def expire(self) -> None:
        run_out = [s for s in self.shards if s.run_out]
        assert self.store.expire_leases() == len(run_out)
        for shard in run_out:
            self.end_lease(shard)
        self.settle()

    @rule(lease=leases)
    def release(self, lease: Lease) -> None:
        self.store.release(lease.shard_id, lease.fence, "test")
        if self.current(lease):
            self.end_lease(self.shards[lease.ordinal])
            self.settle()

    @rule(lease=leases, video=st.integers(0, 1))
    def blame(self, lease: Lease, video: int) -> None:
        key = lease.videos[video].key
        shard = self.shards[lease.ordinal]
        deaths = {} if shard.superseded else shard.deaths
        if self.current(lease):
            deaths[key] = deaths.get(key, 0) + 1
        assert len(self.store.blame(lease.shard_id, lease.fence, key, Death("test"))) == deaths.get(key, 0)

    @rule(lease=leases, failed=st.booleans())
    def commit(self, lease: Lease, failed: bool) -> None:
        """Also with a lease that is not current: who created the record in object storage has won."""
        status = VideoStatus.FAILED if failed else VideoStatus.SUCCEEDED
        shard = self.shards[lease.ordinal]
        assert self.store.record_commit(record(lease, status)) == (shard.state is not ShardState.COMMITTED)
        if shard.state is not ShardState.COMMITTED:
            shard.state, shard.result, shard.run_out = ShardState.COMMITTED, status, False
            self.settle()

    @rule(lease=consumes(leases))
    def forget(self, lease: Lease) -> None:
        """The holder is gone without a word; its lease stays until it runs out."""

    @rule()
    def cancel(self) -> None:
        if self.job in (JobState.RUNNING, JobState.PAUSED, JobState.CANCELLING):
            if self.job is not JobState.CANCELLING:
                self.job = JobState.CANCELLING
                for shard in self.shards:
                    if shard.state is ShardState.PENDING:
                        shard.state = ShardState.CANCELLED
                self.settle()
            assert self.store.request_cancel(self.job_id).state is self.job
        else:
            with pytest.raises(JobNotCancellable):
                self.store.request_cancel(self.job_id)

    @rule()
    def pause(self) -> None:
        if self.job in (JobState.RUNNING, JobState.PAUSED):
            self.job = JobState.PAUSED
            assert self.store.request_pause(self.job_id).state is self.job
        else:
            with pytest.raises(JobNotPausable):
                self.store.request_pause(self.job_id)

    @rule()
    def resume(self) -> None:
        if self.job in (JobState.RUNNING, JobState.PAUSED):
            self.job = JobState.RUNNING
            assert self.store.resume(self.job_id).state is self.job
        else:
            with pytest.raises(JobNotResumable):
                self.store.resume(self.job_id)

    @rule()
    def retry(self) -> None:
        selection = RetrySelection(error_codes=("media_corrupt",))
        if self.job is not JobState.SUCCEEDED_WITH_ERRORS:
            with pytest.raises(JobNotRetryable):
                self.store.retry(self.job_id, selection)
            return
        lost = [s for s in self.shards if s.result is VideoStatus.FAILED and not s.superseded]
        for shard in lost:
            shard.superseded = True
        self.retries += 1
        self.shards.append(ModelShard(videos=sum(s.videos for s in lost), retry=self.retries))
        self.job = JobState.RUNNING
        assert self.store.retry(self.job_id, selection).state is self.job

    @rule()
    def finalise(self) -> None:
        job = self.store.next_finalizable()
        settled = all(s.state is ShardState.COMMITTED for s in self.shards)
        if self.job is JobState.RUNNING and settled:
            assert job is not None
            failed = any(s.result is VideoStatus.FAILED and not s.superseded for s in self.shards)
            self.job = JobState.SUCCEEDED_WITH_ERRORS if failed else JobState.SUCCEEDED
            assert self.store.finish_job(job.id).state is self.job
        else:
            assert job is None

    @invariant()
    def the_store_agrees(self) -> None:
        job = self.store.get_job(self.job_id)
        rows, _ = self.store.list_shards(self.job_id)
        assert job.state is self.job
        assert [(r.state, r.attempts) for r in rows] == [(s.state, s.fence) for s in self.shards]
        assert [r.holder for r in rows] == [s.holder if s.state is ShardState.LEASED else None for s in self.shards]
        committed = [s for s in self.shards if s.state is ShardState.COMMITTED]
        failed = [s for s in committed if s.result is VideoStatus.FAILED and not s.superseded]
        succeeded = [s for s in committed if s.result is VideoStatus.SUCCEEDED]
        assert job.progress.shards_committed == len(committed)
        assert job.progress.videos_failed == sum(s.videos for s in failed)
        assert job.progress.videos_succeeded == sum(s.videos for s in succeeded)
        assert job.retries == self.retries


def test_the_store_is_the_model(store: SqlStore, store_url: str) -> None:
    class OnThisDatabase(LeaseProtocol):
        url = store_url

    run_state_machine_as_test(
        OnThisDatabase,
        settings=settings(
            max_examples=12,
            stateful_step_count=25,
            deadline=None,
            derandomize=True,
            suppress_health_check=list(HealthCheck),
        ),
    )
