"""The store on SQLAlchemy: each method is one transaction of one of its modules."""

from __future__ import annotations

import hashlib
import json
import logging
import time
from collections.abc import Collection, Iterable, Sequence
from functools import partial

from pydantic import TypeAdapter
from sqlalchemy import select

from services.domain.access import ALL_SCOPES, DEFAULT_TENANT, ApiKey, AuditEntry, AuditEvent, Scope
from services.domain.control import DEFAULT_CONTROL, Changes, Delivery, JobControl, RetrySelection, Tenant, TenantLimits
from services.domain.errors import StoreUnavailable
from services.domain.keys import hash_key, new_key
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
)
from services.domain.redaction import redact
from services.domain.states import JobState, VideoStatus
from services.store import (
    audit,
    commits,
    idempotency,
    jobs,
    keys,
    leases,
    migrations,
    outbox,
    planning,
    reading,
    retries,
    tenants,
)
from services.store import (
    control as controls,
)
from services.store.base import Deferral, VideoRow
from services.store.database import Database, Tx

# The answer to a repeated request is a job as it was; a field that a later release adds has its default then.
_JOBS = TypeAdapter(Job)


_log = logging.getLogger(__name__)


def open_when_ready(url: str, patience_s: float = 60.0) -> SqlStore:
    """A store, as soon as its database answers: services of one host start together, and databases restart.

    Raises:
        StoreUnavailable: It does not answer within `patience_s`.
    """
    deadline = time.monotonic() + patience_s
    while True:
        try:
            return SqlStore(url)
        except StoreUnavailable as error:
            if time.monotonic() >= deadline:
                raise
            _log.warning("waiting for the database: %s", error)
            time.sleep(1.0)


class SqlStore:
    """`Store` on SQLite or PostgreSQL.

    Args:
        url: `sqlite:////absolute/path/vipe.db` or `postgresql://user@host/name`.
        migrate: Bring the schema to the newest revision first.

    Raises:
        StoreUnavailable: By every method, when the database does not answer.
    """

    def __init__(self, url: str, *, migrate: bool = True) -> None:
        self._db = Database(url)
        if migrate:
            self.upgrade()

    def upgrade(self) -> None:
        """Bring the schema to the newest revision."""
        migrations.upgrade(self._db)

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
        def create(tx: Tx) -> tuple[Job, bool]:
            if idempotency_key is None:
                return reading.get_job(tx, jobs.create_job(tx, spec, control, tenant)), True
            wanted = json.dumps([spec.to_json(), control.to_json()], sort_keys=True)
            request = request_hash or hashlib.sha256(wanted.encode()).hexdigest()
            idempotency.hold(tx, tenant, idempotency_key)
            known = idempotency.answer_of(tx, tenant, idempotency_key, request)
            if known is not None:
                return _JOBS.validate_python(known), False
            job = reading.get_job(tx, jobs.create_job(tx, spec, control, tenant))
            idempotency.keep_answer(tx, tenant, idempotency_key, request, _JOBS.dump_python(job, mode="json"))
            return job, True

        return self._db.write(create)

    def get_job(self, job_id: str, *, tenant: str | None = None) -> Job:
        return self._db.read(lambda tx: reading.get_job(tx, job_id, tenant))

    def list_jobs(
        self,
        *,
        tenant: str | None = None,
        limit: int = 50,
        after: str | None = None,
        state: JobState | None = None,
    ) -> tuple[list[Job], str | None]:
        return self._db.read(lambda tx: reading.list_jobs(tx, tenant, limit, after, state))

    def request_cancel(self, job_id: str, *, tenant: str | None = None) -> Job:
        self._db.write(lambda tx: jobs.request_cancel(tx, job_id, tenant))
        return self.get_job(job_id)

    # Control --------------------------------------------------------------------------------------------------------
    def change_job(self, job_id: str, changes: Changes, *, tenant: str | None = None) -> Job:
        self._db.write(lambda tx: controls.change_job(tx, job_id, tenant, changes))
        return self.get_job(job_id)

    def request_pause(self, job_id: str, *, tenant: str | None = None) -> Job:
        self._db.write(lambda tx: controls.request_pause(tx, job_id, tenant))
        return self.get_job(job_id)

    def resume(self, job_id: str, *, tenant: str | None = None) -> Job:
        self._db.write(lambda tx: controls.resume(tx, job_id, tenant))
        return self.get_job(job_id)

    def retry(self, job_id: str, selection: RetrySelection, *, tenant: str | None = None) -> Job:
        self._db.write(lambda tx: retries.retry(tx, job_id, tenant, selection))
        return self.get_job(job_id)

    def pause_over_limits(self) -> int:
        suspects = self._db.read(lambda tx: list(tx.run(controls.over_limits(tx.now)).scalars()))
        return sum(self._db.write(partial(controls.pause_over_limit, job_id=job_id)) for job_id in suspects)

    def job_states(self, job_ids: Collection[str]) -> dict[str, JobState]:
        return self._db.read(lambda tx: reading.job_states(tx, job_ids)) if job_ids else {}

    # Tenants --------------------------------------------------------------------------------------------------------
    def list_tenants(self) -> list[Tenant]:
        return self._db.read(tenants.list_tenants)

    def set_tenant_limits(self, name: str, limits: TenantLimits | None) -> None:
        self._db.write(lambda tx: tenants.set_limits(tx, name, limits))

    # Webhooks -------------------------------------------------------------------------------------------------------
    def take_deliveries(self, *, limit: int, ttl_s: float) -> list[Delivery]:
        return self._db.write(lambda tx: outbox.take(tx, limit, ttl_s)) if self.undelivered() else []

    def settle_delivery(self, delivery: Delivery, *, error: str | None, retry_in_s: float | None) -> None:
        self._db.write(lambda tx: outbox.settle(tx, delivery, error, retry_in_s))

    def undelivered(self) -> int:
        return self._db.read(outbox.undelivered)

    # Planning -------------------------------------------------------------------------------------------------------
    def next_unplanned(self, holder: str) -> Job | None:
        return self._db.read(lambda tx: reading.first_job(tx, reading.unplanned(holder, tx.now)))

    def begin_planning(self, job_id: str, holder: str, *, ttl_s: float) -> int | None:
        return self._db.write(lambda tx: planning.begin(tx, job_id, holder, ttl_s))

    def renew_planning(self, job_id: str, fence: int, *, ttl_s: float) -> bool:
        return self._db.write(lambda tx: planning.renew(tx, job_id, fence, ttl_s))

    def add_shards(self, job_id: str, fence: int, shards: Iterable[ShardPlan], *, ttl_s: float) -> bool:
        plans = list(shards)
        return self._db.write(lambda tx: planning.add_shards(tx, job_id, fence, plans, ttl_s))

    def finish_planning(self, job_id: str, fence: int) -> bool:
        return self._db.write(lambda tx: planning.finish(tx, job_id, fence))

    def fail_job(self, job_id: str, code: str, message: str, *, planning_fence: int | None = None) -> None:
        self._db.write(lambda tx: jobs.fail_job(tx, job_id, code, redact(message), planning_fence))

    def defer_job(self, job_id: str, *, base_s: float, max_s: float, planning_fence: int | None = None) -> Deferral:
        return self._db.write(lambda tx: jobs.defer_job(tx, job_id, base_s, max_s, planning_fence))

    # Leases ---------------------------------------------------------------------------------------------------------
    def claim(self, holder: str, *, limit: int, ttl_s: float) -> list[Lease]:
        return self._db.write(lambda tx: leases.claim(tx, holder, limit, ttl_s))

    def renew(self, holder: str, progress: Sequence[LeaseProgress], *, ttl_s: float) -> list[Renewal]:
        return self._db.write(lambda tx: leases.renew(tx, holder, progress, ttl_s)) if progress else []

    def holds(self, shard_id: str, fence: int) -> bool:
        return self._db.read(lambda tx: leases.holds(tx, shard_id, fence))

    def blame(self, shard_id: str, fence: int, video_key: str, death: Death) -> tuple[Death, ...]:
        return self._db.write(lambda tx: leases.blame(tx, shard_id, fence, video_key, death))

    def release(self, shard_id: str, fence: int, reason: str, *, wait_s: float = 0.0) -> None:
        self._db.write(lambda tx: leases.release(tx, shard_id, fence, reason, wait_s))

    def record_commit(self, record: CommitRecord) -> bool:
        return self._db.write(lambda tx: leases.record_commit(tx, record))

    def settle_commit_point(self, job_id: str, planning_fence: int, create_once: bool) -> bool | None:
        return self._db.write(lambda tx: commits.settle_commit_point(tx, job_id, planning_fence, create_once))

    def commit_point(self, job_id: str) -> bool | None:
        return self._db.read(lambda tx: commits.commit_point(tx, job_id))

    def take_tar_name(self, shard_id: str, fence: int, names: Sequence[str]) -> str | None:
        return self._db.write(lambda tx: commits.take_tar_name(tx, shard_id, fence, names))

    def decide_commit(self, record: CommitRecord) -> bytes | None:
        return self._db.write(lambda tx: commits.decide(tx, record))

    def decided_commit(self, shard_id: str) -> bytes | None:
        found = self._db.read(lambda tx: commits.decided_for(tx, shard_id))
        return None if found is None else found.encode()

    def decided_commits(self, job_id: str) -> list[bytes]:
        return [record.encode() for record in self._db.read(lambda tx: commits.decided(tx, job_id))]

    def expire_leases(self) -> int:
        jobs_to_look_at = self._db.read(leases.expirable_jobs)
        return sum(self._db.write(partial(leases.expire_job, job_id=job_id)) for job_id in jobs_to_look_at)

    # Finalising -----------------------------------------------------------------------------------------------------
    def next_finalizable(self) -> Job | None:
        while True:
            job = self._db.read(lambda tx: reading.first_job(tx, reading.finalizable(tx.now)))
            if job is None or job.state is JobState.FINALIZING:
                return job
            # Somebody else may have cancelled or failed it meanwhile: then look again.
            if self._db.write(partial(jobs.begin_finalizing, job_id=job.id)):
                return self.get_job(job.id)

    def finish_job(self, job_id: str) -> Job:
        self._db.write(lambda tx: jobs.finish_job(tx, job_id))
        return self.get_job(job_id)

    # Tidying --------------------------------------------------------------------------------------------------------
    def next_unswept(self, *, quiet_s: float) -> Job | None:
        return self._db.read(lambda tx: reading.first_job(tx, reading.unswept(tx.now, quiet_s)))

    def finish_sweep(self, job_id: str) -> None:
        self._db.write(lambda tx: jobs.finish_sweep(tx, job_id))

    # Access ---------------------------------------------------------------------------------------------------------
    def create_key(
        self,
        name: str,
        *,
        tenant: str = DEFAULT_TENANT,
        scopes: frozenset[Scope] = ALL_SCOPES,
        expires_in_s: float | None = None,
    ) -> tuple[ApiKey, str]:
        key_id, key = new_key()
        key_hash = hash_key(key)
        self._db.write(lambda tx: keys.create(tx, key_id, key_hash, tenant, name, scopes, expires_in_s))
        return self.get_key(key_id), key

    def get_key(self, key_id: str, *, tenant: str | None = None) -> ApiKey:
        return self._db.read(lambda tx: keys.get(tx, key_id, tenant))

    def find_key(self, key_id: str) -> tuple[ApiKey, str, bool] | None:
        return self._db.read(lambda tx: keys.find(tx, key_id))

    def list_keys(
        self, *, tenant: str | None = None, limit: int = 100, after: str | None = None
    ) -> tuple[list[ApiKey], str | None]:
        return self._db.read(lambda tx: keys.list_all(tx, tenant, limit, after))

    def revoke_key(self, key_id: str, *, tenant: str | None = None) -> ApiKey:
        self._db.write(lambda tx: keys.revoke(tx, key_id, tenant))
        return self.get_key(key_id, tenant=tenant)

    def touch_key(self, key_id: str) -> None:
        self._db.write(lambda tx: keys.touch(tx, key_id))

    def record_audit(self, entries: Sequence[AuditEntry]) -> None:
        self._db.write(lambda tx: audit.record(tx, entries))

    def audit(self, tenant: str, *, limit: int = 100, after: str | None = None) -> tuple[list[AuditEvent], str | None]:
        return self._db.read(lambda tx: audit.read(tx, tenant, limit, after))

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
        return self._db.read(lambda tx: reading.list_videos(tx, job_id, tenant, status, error_code, limit, after))

    def list_shards(
        self, job_id: str, *, tenant: str | None = None, limit: int = 100, after: str | None = None
    ) -> tuple[list[Shard], str | None]:
        return self._db.read(lambda tx: reading.list_shards(tx, job_id, tenant, limit, after))

    def planned_shards(self, job_id: str, *, first_ordinal: int = 0, limit: int = 1000) -> list[PlannedShard]:
        return self._db.read(lambda tx: reading.planned_shards(tx, job_id, first_ordinal, limit))

    def shard_digests(self, job_id: str, *, first_ordinal: int = 0, limit: int = 1000) -> list[ShardDigest]:
        return self._db.read(lambda tx: reading.shard_digests(tx, job_id, first_ordinal, limit))

    def uncommitted_shards(self, job_id: str) -> list[Shard]:
        return self._db.read(lambda tx: reading.uncommitted_shards(tx, job_id))

    def events(self, job_id: str, *, tenant: str | None = None, after_seq: int = 0, limit: int = 1000) -> list[Event]:
        return self._db.read(lambda tx: reading.list_events(tx, job_id, tenant, after_seq, limit))

    def counts(self) -> dict[str, dict[str, int]]:
        return self._db.read(reading.counts)

    def ping(self) -> None:
        self._db.read(lambda tx: tx.first(select(1)))

    def close(self) -> None:
        self._db.close()
