"""The store's contract: the truth of intent. One function per transition, one transaction and one event each.

Implemented once with SQLAlchemy for SQLite and PostgreSQL. All methods are synchronous and thread-safe. Times are the
database's clock, UTC.

Methods that callers of the API reach take `tenant`: given, the jobs of other tenants do not exist for the call
(JobNotFound, left out of lists). None is the service itself, which sees all of them.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol

from services.domain.access import ALL_SCOPES, DEFAULT_TENANT, ApiKey, AuditEntry, AuditEvent, Scope
from services.domain.control import DEFAULT_CONTROL, Changes, Delivery, JobControl, RetrySelection, Tenant, TenantLimits
from services.domain.models import (
    CommitRecord,
    Death,
    Event,
    Job,
    JobSpec,
    Lease,
    LeaseProgress,
    PlannedShard,
    Renewal,
    Shard,
    ShardDigest,
    ShardPlan,
    VideoRef,
    VideoResult,
)
from services.domain.states import JobState, VideoStatus


@dataclass(frozen=True, slots=True)
class VideoRow:
    """A video of a job as the store knows it; `result` once its shard is committed."""

    ref: VideoRef
    shard_id: str
    status: VideoStatus
    result: VideoResult | None


@dataclass(frozen=True, slots=True)
class Deferral:
    """Why patience with a job may end.

    Attributes:
        failures: In a row, this one included.
        failing_s: Since the first of them.
        wait_s: Until the job's next turn.
    """

    failures: int
    failing_s: float
    wait_s: float


class Store(Protocol):
    # Jobs -----------------------------------------------------------------------------------------------------------
    def create_job(
        self,
        spec: JobSpec,
        *,
        control: JobControl = DEFAULT_CONTROL,
        tenant: str = DEFAULT_TENANT,
        idempotency_key: str | None = None,
        request_hash: str | None = None,
    ) -> tuple[Job, bool]:
        """A new queued job and True; or, for a key that the tenant used within 7 days, the job as it was, and False.

        Args:
            spec: What to do.
            control: How to run it.
            tenant: Whose job it is.
            idempotency_key: Kept in the transaction that creates the job.
            request_hash: What the key stands for; default: spec and control.

        Raises:
            IdempotencyConflict: The key was used with another request.
            IdempotencyInFlight: A request with this key is being worked on.
            InvalidRequest: The deadline has passed.
            QuotaExceeded: The tenant has as many open jobs or videos as it may have.
            OutputInUse: An earlier job has the same output. An output stays with its first job for ever; only a job
                that failed or was cancelled before it had shards frees it.
        """

    def get_job(self, job_id: str, *, tenant: str | None = None) -> Job:
        """With progress. Raises JobNotFound."""

    def list_jobs(
        self,
        *,
        tenant: str | None = None,
        limit: int = 50,
        after: str | None = None,
        state: JobState | None = None,
    ) -> tuple[list[Job], str | None]:
        """Newest first, and the cursor of the next page."""

    def request_cancel(self, job_id: str, *, tenant: str | None = None) -> Job:
        """Move to cancelling (a job without live leases is cancelled at once). Raises JobNotCancellable when ended."""

    # Control --------------------------------------------------------------------------------------------------------
    def change_job(self, job_id: str, changes: Changes, *, tenant: str | None = None) -> Job:
        """Give fields of the job's control new values. Nothing happens where they are what they were.

        Raises:
            JobEnded: It is too late.
            InvalidRequest: The new deadline has passed.
        """

    def request_pause(self, job_id: str, *, tenant: str | None = None) -> Job:
        """Queued or running -> paused: no lease of it is given out, and renewals ask for those that live.

        A job that is paused stays as it is. Raises JobNotPausable when it is too late.
        """

    def resume(self, job_id: str, *, tenant: str | None = None) -> Job:
        """Paused -> where it was. A job that waits or runs stays as it is.

        Raises:
            JobNotResumable: It is not paused, or the limit that paused it is still exceeded.
        """

    def retry(self, job_id: str, selection: RetrySelection, *, tenant: str | None = None) -> Job:
        """Succeeded with errors -> running, with new shards for the chosen videos; see `services.store.retries`.

        Raises:
            JobNotRetryable: It has not ended, or not in this state.
            NothingToRetry: No video is chosen.
            QuotaExceeded: The tenant has as many open jobs or videos as it may have.
        """

    def pause_over_limits(self) -> int:
        """Pause jobs that passed their deadline or used up their slot-hours; returns how many."""

    def job_states(self, job_ids: Collection[str]) -> dict[str, JobState]:
        """The states of some jobs, cheap enough to ask for every second."""

    # Tenants --------------------------------------------------------------------------------------------------------
    def list_tenants(self) -> list[Tenant]:
        """Every tenant that ever had a job or got limits, with what it uses; `*` among them if it has limits."""

    def set_tenant_limits(self, name: str, limits: TenantLimits | None) -> None:
        """Give a tenant limits of its own, or with None those of `*` again. `*` itself is a name here."""

    # Webhooks -------------------------------------------------------------------------------------------------------
    def take_deliveries(self, *, limit: int, ttl_s: float) -> list[Delivery]:
        """Events that are due to be sent, in their order. Nobody else gets them before `ttl_s` is over."""

    def settle_delivery(self, delivery: Delivery, *, error: str | None, retry_in_s: float | None) -> None:
        """Say how sending went. Without an error it is done; without a time to try again it is given up.

        Nothing happens if somebody else has taken it meanwhile.
        """

    def undelivered(self) -> int:
        """How many events wait to be sent."""

    # Planning -------------------------------------------------------------------------------------------------------
    # One planner at a time plans a job. Its fence grows with every `begin_planning`; what comes with a smaller one is
    # refused, so a planner that slept through the end of its time can neither leave a gap nor close the plan over one.
    def next_unplanned(self, holder: str) -> Job | None:
        """The oldest job that is queued, or running with planning unfinished, that does not wait and that no other live
        planner holds."""

    def begin_planning(self, job_id: str, holder: str, *, ttl_s: float) -> int | None:
        """Move queued -> running and give the planning fence.

        None if there is nothing to plan (cancelled, failed or planned meanwhile), if another planner's time runs, or if
        the job waits.
        """

    def renew_planning(self, job_id: str, fence: int, *, ttl_s: float) -> bool:
        """Extend the planner's time; False if it is not this planner's job any more."""

    def add_shards(self, job_id: str, fence: int, shards: Iterable[ShardPlan], *, ttl_s: float) -> bool:
        """Add planned shards with their videos and extend the planner's time.

        Shards that are there already are left as they are. False, and nothing is added, if it is not this planner's
        job any more: another one took it over, or it is cancelled, failed or planned.

        Raises:
            InvalidTransition: An ordinal is taken by a shard with other videos.
        """

    def finish_planning(self, job_id: str, fence: int) -> bool:
        """Close the plan; False, and nothing changes, if it is not this planner's job any more."""

    def fail_job(self, job_id: str, code: str, message: str, *, planning_fence: int | None = None) -> None:
        """Any live state -> failed; its leases are stopped through their renewals. A job that has ended stays as it is.

        Args:
            planning_fence: Given by a planner: nothing happens if it is not its job any more.
        """

    def defer_job(self, job_id: str, *, base_s: float, max_s: float, planning_fence: int | None = None) -> Deferral:
        """Count a failure to move the job along; planning and finalising leave it out for a while.

        The wait is `base_s`, doubled for each failure in a row, `max_s` at most. A planner's turn ends.

        Args:
            planning_fence: See `fail_job`.
        """

    # Leases ---------------------------------------------------------------------------------------------------------
    def claim(self, holder: str, *, limit: int, ttl_s: float) -> list[Lease]:
        """Lease pending shards. Fence and attempt grow by one with each lease of a shard.

        Whose they are is `services.store.fairness`'s matter: tenants share the slots, within a tenant priority counts.
        """

    def renew(self, holder: str, progress: Sequence[LeaseProgress], *, ttl_s: float) -> list[Renewal]:
        """Extend leases in bulk and learn which to stop."""

    def holds(self, shard_id: str, fence: int) -> bool:
        """Whether this lease is still the shard's current one (checked just before the commit point)."""

    def blame(self, shard_id: str, fence: int, video_key: str, death: Death) -> tuple[Death, ...]:
        """Count a worker death against a video; returns its deaths so far, oldest first. Survives the lease.

        A lease that is not current any more has no say: nothing is counted then.
        """

    def release(self, shard_id: str, fence: int, reason: str, *, wait_s: float = 0.0) -> None:
        """Give a lease back: the shard is pending again (or cancelled, if its job is being cancelled).

        Args:
            wait_s: For how long nobody may lease it.
        """

    def record_commit(self, record: CommitRecord) -> bool:
        """Mark a shard committed from its record. Idempotent; False if it was committed already.

        The record in object storage is the commit point, so the store follows it even if the lease ran out meanwhile.

        Raises:
            CommitConflict: The record has another plan, or a fence that was never given out.
        """

    # Where the output cannot decide between two writers, the shard's row does; see `services.store.commits`.
    def settle_commit_point(self, job_id: str, planning_fence: int, create_once: bool) -> bool | None:
        """Keep what the probe of a job's output found, once and for all agents; returns what counts.

        None, and nothing is kept, if it is not this planner's job any more.
        """

    def commit_point(self, job_id: str) -> bool | None:
        """Whether the output decides (True) or this database (False); None before the output was probed."""

    def take_tar_name(self, shard_id: str, fence: int, names: Sequence[str]) -> str | None:
        """Take the first of `names` that nobody took in this job, for ever. None if all are, or the lease is lost."""

    def decide_commit(self, record: CommitRecord) -> bytes | None:
        """The commit point: keep this record if the lease is current and none was kept. Returns the one that counts.

        None if there is none and the lease is not current any more.
        """

    def decided_commit(self, shard_id: str) -> bytes | None:
        """The record that was decided here and that `record_commit` was not told of yet."""

    def decided_commits(self, job_id: str) -> list[bytes]:
        """All of them of a job, in the order of its shards."""

    def expire_leases(self) -> int:
        """Requeue shards whose lease ran out; settle cancelling jobs that hold no lease any more."""

    # Finalising -----------------------------------------------------------------------------------------------------
    def next_finalizable(self) -> Job | None:
        """A planned running job whose shards are all settled (moved to finalizing), or one already finalizing.

        Jobs that wait are left out.
        """

    def finish_job(self, job_id: str) -> Job:
        """Finalizing -> succeeded, or succeeded_with_errors if any video failed."""

    # Tidying --------------------------------------------------------------------------------------------------------
    def next_unswept(self, *, quiet_s: float) -> Job | None:
        """The oldest job with shards that has ended and whose output was not rid of rubbish yet.

        A job that failed or was cancelled comes only once no lease of it is live and nothing was heard of one for
        `quiet_s`. Jobs that wait are left out.
        """

    def finish_sweep(self, job_id: str) -> None:
        """`next_unswept` names this job no more."""

    # Access ---------------------------------------------------------------------------------------------------------
    def create_key(
        self,
        name: str,
        *,
        tenant: str = DEFAULT_TENANT,
        scopes: frozenset[Scope] = ALL_SCOPES,
        expires_in_s: float | None = None,
    ) -> tuple[ApiKey, str]:
        """A new key, without its secret and as the text that its owner uses; the text is not kept."""

    def get_key(self, key_id: str, *, tenant: str | None = None) -> ApiKey:
        """A key without its secret. Raises KeyNotFound."""

    def find_key(self, key_id: str) -> tuple[ApiKey, str, bool] | None:
        """A key, the hash to hold it against, and whether it is neither revoked nor expired; None if unknown."""

    def list_keys(
        self, *, tenant: str | None = None, limit: int = 100, after: str | None = None
    ) -> tuple[list[ApiKey], str | None]:
        """In the order of their ids, and the cursor of the next page."""

    def revoke_key(self, key_id: str, *, tenant: str | None = None) -> ApiKey:
        """End a key for ever; revoking twice is no error. Raises KeyNotFound."""

    def touch_key(self, key_id: str) -> None:
        """Note that a key is in use, to the minute."""

    def record_audit(self, entries: Sequence[AuditEntry]) -> None:
        """Add to the audit trail."""

    def audit(self, tenant: str, *, limit: int = 100, after: str | None = None) -> tuple[list[AuditEvent], str | None]:
        """A tenant's trail, newest first, and the cursor of the next page; with what belongs to nobody for `default`,
        the tenant of who runs the service."""

    # Reading --------------------------------------------------------------------------------------------------------
    def list_videos(
        self,
        job_id: str,
        *,
        tenant: str | None = None,
        status: VideoStatus | None = None,
        error_code: str | None = None,
        limit: int = 100,
        after: str | None = None,
    ) -> tuple[list[VideoRow], str | None]:
        """In the order of their keys, and the cursor of the next page."""

    def list_shards(
        self, job_id: str, *, tenant: str | None = None, limit: int = 100, after: str | None = None
    ) -> tuple[list[Shard], str | None]: ...

    def planned_shards(self, job_id: str, *, first_ordinal: int = 0, limit: int = 1000) -> list[PlannedShard]:
        """What the plan says about the shards from an ordinal on, in their order."""

    def shard_digests(self, job_id: str, *, first_ordinal: int = 0, limit: int = 1000) -> list[ShardDigest]:
        """What is known of the records of the shards from an ordinal on, in their order. Raises JobNotFound."""

    def uncommitted_shards(self, job_id: str) -> list[Shard]:
        """Shards that are not committed, for the reconciler that compares with the records in object storage."""

    def events(
        self, job_id: str, *, tenant: str | None = None, after_seq: int = 0, limit: int = 1000
    ) -> list[Event]: ...

    def counts(self) -> dict[str, dict[str, int]]:
        """{"jobs": {state: n}, "shards": {state: n}, "paused": {reason: n}} for the gauges."""

    def ping(self) -> None:
        """Raises if the database does not answer."""

    def close(self) -> None: ...
