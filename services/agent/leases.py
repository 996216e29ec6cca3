"""The leases that this agent holds: kept alive in bulk, and told to stop when they are not ours any more.

A lease has two clocks. The store's decides; ours, started before the last answered renewal, is the earlier one, so an
agent that cannot reach the store stops its work before anybody else may start it.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from enum import StrEnum

from services.agent.messages import SlotProgress
from services.domain.models import Lease, LeaseProgress, VideoResult
from services.domain.states import JobState
from services.observability.metrics import Metrics
from services.store.base import Store

logger = logging.getLogger(__name__)


class StopReason(StrEnum):
    """Why work on a lease ends early."""

    CANCELLED = "cancelled"  # the user cancelled the job
    PAUSED = "paused"  # the job was paused: what is finished stays in scratch, for when it is resumed
    LOST = "lost"  # the lease ran out or belongs to somebody else
    DRAINED = "drained"  # this agent is shutting down


class LiveLease:
    """A lease in use. The supervisor reports to it, the renewal thread reads it and may tell it to stop."""

    def __init__(self, lease: Lease, deadline_s: float) -> None:
        self.lease = lease
        self.deadline_s = deadline_s
        self._lock = threading.Lock()
        self._stop: StopReason | None = None
        self._closed = False
        self._results: tuple[VideoResult, ...] = ()
        self._position: Callable[[], SlotProgress] = SlotProgress

    @property
    def stop_reason(self) -> StopReason | None:
        return self._stop

    @property
    def closed(self) -> bool:
        """Whether the holder is done with it: renewing would only report as lost what was given away on purpose."""
        return self._closed

    def close(self) -> None:
        self._closed = True

    def stop(self, reason: StopReason) -> None:
        """The first reason stays, except that a lost lease must not be given back and a cancelled one keeps nothing."""
        with self._lock:
            for_good = reason in (StopReason.LOST, StopReason.CANCELLED)
            if self._stop is None or (self._stop in (StopReason.DRAINED, StopReason.PAUSED) and for_good):
                self._stop = reason

    def follow(self, results: tuple[VideoResult, ...], position: Callable[[], SlotProgress]) -> None:
        """What is finished, and where to look for the rest."""
        with self._lock:
            self._results, self._position = results, position

    def report(self) -> LeaseProgress:
        """Progress over the whole shard. Videos that nobody opened yet are expected to be as long as the known ones."""
        with self._lock:
            results, position = self._results, self._position()
        lengths = [result.num_frames or 0 for result in results]
        done = sum(lengths) + position.frames_done
        if position.frames_expected is not None:
            lengths.append(position.frames_expected)
        expected = round(sum(lengths) / len(lengths) * len(self.lease.videos)) if lengths else None
        return LeaseProgress(
            fence=self.lease.fence,
            shard_id=self.lease.shard_id,
            video_key=position.video_key,
            stage=position.stage,
            videos_done=len(results),
            frames_done=done,
            frames_expected=expected,
        )


class LeaseBook:
    """All live leases of one agent.

    Args:
        clock: Monotonic seconds.
    """

    def __init__(
        self, store: Store, holder: str, ttl_s: float, metrics: Metrics, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._store = store
        self._holder = holder
        self._ttl_s = ttl_s
        self._metrics = metrics
        self._clock = clock
        self._lock = threading.Lock()
        self._live: dict[str, LiveLease] = {}

    def claim(self, limit: int) -> list[LiveLease]:
        """Lease up to `limit` shards; they are renewed from now on."""
        asked_s = self._clock()
        leases = self._store.claim(self._holder, limit=limit, ttl_s=self._ttl_s)
        live = [LiveLease(lease, asked_s + self._ttl_s) for lease in leases]
        with self._lock:
            for entry in live:
                self._live[entry.lease.shard_id] = entry
        return live

    def drop(self, live: LiveLease) -> None:
        """Stop renewing."""
        with self._lock:
            if self._live.get(live.lease.shard_id) is live:
                del self._live[live.lease.shard_id]

    def all(self) -> list[LiveLease]:
        with self._lock:
            return list(self._live.values())

    def watch(self) -> None:
        """Renew ahead of time if a job does not run any more: its leases are to stop within seconds. Never raises."""
        working = [entry for entry in self.all() if not entry.closed and entry.stop_reason is None]
        try:
            states = self._store.job_states({entry.lease.job_id for entry in working})
        except Exception as error:
            logger.debug("could not look at the jobs: %s", error)  # The renewals say so, and act on it.
            return
        if any(states.get(entry.lease.job_id) is not JobState.RUNNING for entry in working):
            self.renew()

    def renew(self) -> None:
        """Renew every lease in one call and pass on what the store says. Never raises."""
        entries = [entry for entry in self.all() if not entry.closed]
        if not entries:
            self._metrics.frames_in_progress.set(0)
            return
        asked_s = self._clock()
        try:
            reports = [entry.report() for entry in entries]
            self._metrics.frames_in_progress.set(sum(report.frames_done for report in reports))
            renewals = self._store.renew(self._holder, reports, ttl_s=self._ttl_s)
        except Exception as error:
            self._metrics.lease_renew_failures.inc()
            logger.warning("could not renew %d leases: %s", len(entries), error)
            for entry in entries:
                if self._clock() >= entry.deadline_s:
                    entry.stop(StopReason.LOST)
            return
        verdicts = {renewal.shard_id: renewal.verdict for renewal in renewals}
        for entry in entries:
            match verdicts.get(entry.lease.shard_id, "lost"):
                case "continue":
                    entry.deadline_s = asked_s + self._ttl_s
                case "pause":
                    entry.deadline_s = asked_s + self._ttl_s
                    entry.stop(StopReason.PAUSED)
                case "cancel":
                    entry.deadline_s = asked_s + self._ttl_s
                    entry.stop(StopReason.CANCELLED)
                case "lost":
                    if not entry.closed:  # Otherwise it was committed or given back while the store answered.
                        self._metrics.lease_renew_failures.inc()
                        logger.warning("the lease of %s is lost", entry.lease.shard_id)
                        entry.stop(StopReason.LOST)
