"""From uploaded tars to a shard that exists, and back from a record in the output to a database that missed it.

`services.commit` brings the tar writer and its heavy libraries along, so it is imported when it is first needed: an API
that carries an agent must not start slowly for it.
"""

from __future__ import annotations

import logging
import threading
from typing import TYPE_CHECKING

from services.agent.traffic import TrafficMetrics
from services.domain.errors import CommitConflict, StorageError
from services.domain.models import CommitRecord, Job, Lease
from services.observability.metrics import Metrics
from services.planner import write_plan
from services.storage import ObjectStore, open_store
from services.store.base import Store

if TYPE_CHECKING:
    from services.commit.protocol import CommitOutcome, PreparedPayload

logger = logging.getLogger(__name__)

_MAX_OPEN_OUTPUTS = 64


class Committer:
    """The agent's side of the commit protocol. Thread-safe."""

    def __init__(self, store: Store, metrics: Metrics, s3_endpoint_url: str | None = None) -> None:
        self._store = store
        self._metrics = metrics
        self._traffic = TrafficMetrics(metrics)
        self._s3_endpoint_url = s3_endpoint_url
        self._lock = threading.Lock()
        self._outputs: dict[str, ObjectStore] = {}
        self._planned: dict[str, int] = {}

    def output(self, uri: str) -> ObjectStore:
        """The output location; one client per location, kept."""
        with self._lock:
            store = self._outputs.pop(uri, None)
            if store is None:
                store = open_store(uri, endpoint_url=self._s3_endpoint_url, observer=self._traffic)
            self._outputs[uri] = store
            while len(self._outputs) > _MAX_OPEN_OUTPUTS:
                del self._outputs[next(iter(self._outputs))]
            return store

    def write(self, lease: Lease, payload: PreparedPayload) -> CommitOutcome:
        """The commit point. Idempotent; see `services.commit.protocol.write_record` for what it raises."""
        from services.commit.protocol import write_decided, write_record

        output = self.output(lease.spec.output)
        self._extend_plan(output, lease)
        try:
            if lease.create_once:
                outcome = write_record(output, payload, lambda: self._store.holds(lease.shard_id, lease.fence))
            else:
                outcome = write_decided(output, payload, self._store.decide_commit)
        except CommitConflict:
            self._metrics.commit_conflicts.labels(result="conflict").inc()
            raise
        if outcome.kind != "committed":
            self._metrics.commit_conflicts.labels(result=outcome.kind).inc()
            logger.warning("commit of %s: %s", lease.shard_id, outcome.kind)
        return outcome

    def tar_name(self, lease: Lease) -> str | None:
        """A tar name for one packing of a shard; None where the output decides who takes it.

        Raises:
            StorageError: All names that this lease may try are taken, or it is not current any more.
        """
        from services.commit.protocol import tar_names

        if lease.create_once:
            return None
        name = self._store.take_tar_name(lease.shard_id, lease.fence, tar_names(lease))
        if name is None:
            raise StorageError(f"no tar name for shard {lease.shard_id}: all are taken, or its lease is lost")
        return name

    def record(self, record: CommitRecord) -> bool:
        """Tell the database what the output says, and count it if the database did not know."""
        new = self._store.record_commit(record)
        if new:
            for video in record.videos:
                self._metrics.observe_video(video)
            logger.info("committed %s: %d videos, %d frames", record.shard_id, len(record.videos), record.frames)
        return new

    def settled(self, lease: Lease) -> bool:
        """Whether an earlier attempt committed this shard without living to say so; if so the database learns it.

        Raises:
            CommitConflict: The record belongs to another plan.
        """
        from services.commit.reconcile import committed_record

        output = self.output(lease.spec.output)
        if not lease.create_once:
            self._put_decided(output, lease.job_id, self._store.decided_commit(lease.shard_id))
        found = committed_record(output, lease.job_id, lease.shard_id)
        if found is None:
            return False
        self.record(found)
        return True

    def reconcile(self, job: Job) -> int:
        """Compare a job's open shards with the records in its output; returns how many the database had missed."""
        from services.commit.reconcile import committed_records

        open_shards = {shard.id for shard in self._store.uncommitted_shards(job.id)}
        if not open_shards:
            return 0
        output, missed = self.output(job.spec.output), 0
        for decided in self._store.decided_commits(job.id):
            self._put_decided(output, job.id, decided)
        for record in committed_records(output, job.id):
            if record.shard_id in open_shards and self.record(record):
                missed += 1
        if missed:
            logger.info("found %d committed shards of %s that the database had missed", missed, job.id)
        return missed

    def _extend_plan(self, output: ObjectStore, lease: Lease) -> None:
        """A shard that was added to a plan that was complete, by a retry: the output must expect its record first."""
        from services.commit.plan import read_plan

        with self._lock:
            planned = self._planned.get(lease.job_id, 0)
        if lease.ordinal < planned:
            return
        head = read_plan(output, lease.job_id, lambda shard: None)
        if not head.complete:  # Its planner is still at it.
            return
        planned = head.shards
        if lease.ordinal >= planned:
            write_plan(output, self._store, lease.job_id, lease.spec.config_hash)
            planned = lease.ordinal + 1
        with self._lock:
            self._planned[lease.job_id] = planned
            while len(self._planned) > _MAX_OPEN_OUTPUTS:
                del self._planned[next(iter(self._planned))]

    @staticmethod
    def _put_decided(output: ObjectStore, job_id: str, decided: bytes | None) -> None:
        """Put a record that the database decided where readers look for it. Its holder may have died before."""
        from services.commit.layout import commit_key
        from services.commit.protocol import read_record

        if decided is None:
            return
        record = read_record(decided, f"of {job_id} in the database")
        key = commit_key(record.job_id, record.shard_id)
        if output.head(key) is None:
            output.put_bytes(key, decided)
