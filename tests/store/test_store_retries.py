"""Retries of failed videos, on every database."""

from __future__ import annotations

from dataclasses import replace

import pytest
from store_helpers import planned_job, record

from services.domain.control import RetrySelection, TenantLimits
from services.domain.errors import CommitConflict, JobNotFound, JobNotRetryable, NothingToRetry, QuotaExceeded
from services.domain.models import CommitRecord, Death, Lease
from services.domain.states import JobState, VideoStatus
from services.store.sql import SqlStore

ALL = RetrySelection(error_codes=("media_corrupt", "video_timeout", "worker_died"))


def ended_job(store: SqlStore, *outcomes: tuple[VideoStatus, str], videos_each: int = 2) -> tuple[str, list[Lease]]:
    """A job of one shard for each outcome, finished."""
    job_id = planned_job(store, len(outcomes), videos_each)
    leases = store.claim("a", limit=len(outcomes), ttl_s=600)
    for lease, (status, code) in zip(leases, outcomes, strict=True):
        if code == "worker_died":
            store.blame(lease.shard_id, lease.fence, lease.videos[0].key, Death("signal 11"))
        assert store.record_commit(record(lease, status, error_code=code))
    assert store.next_finalizable() is not None
    store.finish_job(job_id)
    return job_id, leases


SUCCEEDED = (VideoStatus.SUCCEEDED, "")
CORRUPT = (VideoStatus.FAILED, "media_corrupt")
TIMEOUT = (VideoStatus.FAILED, "video_timeout")
KILLED = (VideoStatus.QUARANTINED, "worker_died")


def test_failed_videos_get_new_shards_of_the_same_job(store: SqlStore) -> None:
    job_id, first = ended_job(store, SUCCEEDED, CORRUPT, TIMEOUT)
    job = store.retry(job_id, ALL)
    assert (job.state, job.retries, job.finished_at) == (JobState.RUNNING, 1, None)
    progress = job.progress
    assert (progress.shards_total, progress.shards_committed) == (4, 3)
    assert (progress.videos_total, progress.videos_succeeded, progress.videos_failed) == (6, 2, 0)
    assert [e.kind for e in store.events(job_id)][-2:] == ["job.running", "shards.planned"]

    (lease,) = store.claim("b", limit=9, ttl_s=600)
    assert (lease.ordinal, lease.retry, lease.attempt) == (3, 1, 1)
    assert [v.key for v in lease.videos] == [v.key for old in first[1:] for v in old.videos]
    assert not store.record_commit(record(first[1], *CORRUPT[:1])), "an old record is known, and changes nothing"
    assert store.record_commit(record(lease))
    assert store.next_finalizable() is not None
    job = store.finish_job(job_id)
    assert job.state is JobState.SUCCEEDED
    assert (job.progress.videos_succeeded, job.progress.videos_failed) == (6, 0)
    assert {row.shard_id for row in store.list_videos(job_id)[0]} == {first[0].shard_id, lease.shard_id}


@pytest.mark.parametrize(
    ("selection", "shards"),
    [
        (RetrySelection(), [2]),
        (RetrySelection(kind="quarantined"), [3]),
        (RetrySelection(error_codes=("media_corrupt",)), [1]),
        (RetrySelection(error_codes=("worker_died", "video_timeout")), [2, 3]),
    ],
)
def test_what_is_tried_again(store: SqlStore, selection: RetrySelection, shards: list[int]) -> None:
    job_id, first = ended_job(store, SUCCEEDED, CORRUPT, TIMEOUT, KILLED)
    store.retry(job_id, selection)
    leases = store.claim("b", limit=9, ttl_s=600)
    chosen = sorted(v.key for lease in leases for v in lease.videos)
    assert chosen == sorted(v.key for number in shards for v in first[number].videos)


def test_a_quarantined_video_is_alone_and_has_a_clean_slate(store: SqlStore) -> None:
    job_id, _ = ended_job(store, SUCCEEDED, CORRUPT, KILLED)
    store.retry(job_id, ALL)
    leases = store.claim("b", limit=9, ttl_s=600)
    assert [len(lease.videos) for lease in leases] == [1, 1, 2]
    assert all(lease.spent == {} for lease in leases)


def test_a_retry_may_be_followed_by_another(store: SqlStore) -> None:
    job_id, _ = ended_job(store, SUCCEEDED, TIMEOUT)
    for number in (1, 2):
        store.retry(job_id, RetrySelection())
        (lease,) = store.claim("b", limit=9, ttl_s=600)
        assert (lease.ordinal, lease.retry) == (1 + number, number)
        store.record_commit(record(lease, VideoStatus.FAILED, error_code="video_timeout"))
        store.next_finalizable()
        assert store.finish_job(job_id).state is JobState.SUCCEEDED_WITH_ERRORS
        assert store.get_job(job_id).progress.videos_failed == 2


def test_a_record_must_be_of_the_retry_that_made_its_shard(store: SqlStore) -> None:
    job_id, _ = ended_job(store, SUCCEEDED, TIMEOUT)
    store.retry(job_id, RetrySelection())
    (lease,) = store.claim("b", limit=9, ttl_s=600)
    with pytest.raises(CommitConflict):
        store.record_commit(replace(record(lease), retry=0))


def test_only_a_job_that_ended_with_errors(store: SqlStore) -> None:
    running = planned_job(store, 1)
    for state in ("running", "paused", "cancelled"):
        if state == "paused":
            store.request_pause(running)
        if state == "cancelled":
            store.request_cancel(running)
        with pytest.raises(JobNotRetryable, match=state):
            store.retry(running, ALL)
    with pytest.raises(JobNotFound):
        store.retry("job_x", ALL)


def test_nothing_to_retry(store: SqlStore) -> None:
    job_id, _ = ended_job(store, SUCCEEDED, CORRUPT)
    with pytest.raises(NothingToRetry):
        store.retry(job_id, RetrySelection())
    with pytest.raises(JobNotFound):
        store.retry(job_id, ALL, tenant="other")
    assert store.get_job(job_id).state is JobState.SUCCEEDED_WITH_ERRORS


def test_the_tenants_limits_count_for_retries_too(store: SqlStore) -> None:
    job_id, _ = ended_job(store, SUCCEEDED, CORRUPT)
    store.set_tenant_limits("*", TenantLimits(max_jobs=0))
    with pytest.raises(QuotaExceeded):
        store.retry(job_id, ALL)


def test_a_sweep_that_ends_late_does_not_spare_the_retry_its_own(store: SqlStore) -> None:
    job_id, _ = ended_job(store, SUCCEEDED, CORRUPT)
    assert store.next_unswept(quiet_s=0) is not None
    store.retry(job_id, ALL)
    store.finish_sweep(job_id)  # of the output as it was before the retry
    (lease,) = store.claim("b", limit=9, ttl_s=600)
    store.record_commit(record(lease))
    store.next_finalizable()
    store.finish_job(job_id)
    unswept = store.next_unswept(quiet_s=0)
    assert unswept is not None
    assert unswept.id == job_id


def test_records_from_before_there_were_retries_are_read(store: SqlStore) -> None:
    planned_job(store, 1)
    written = record(store.claim("a", limit=1, ttl_s=60)[0])
    assert CommitRecord.from_bytes(written.to_bytes().replace(b' "retry": 0,\n', b"")).retry == 0
