"""The agent's loop: keep slots busy with leases, keep leases alive, keep jobs moving, and never stop for one of them.

Threads: `agent` owns the executor and claims work; one per slot supervises it; `agent-renew` renews every lease in one
call; `agent-jobs` plans and finalises, which can take long; `agent-webhooks` sends what jobs have to tell. The agent
holds no truth: killed at any point, its leases run out, and whoever takes them finds what is committed in the output
and what is finished in the scratch folder.
"""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections import Counter
from enum import StrEnum

from services.agent.backoff import Backoff, GiveBacks
from services.agent.commits import Committer
from services.agent.config import AgentConfig
from services.agent.executor import Executor, SlotHandle
from services.agent.jobs import JobKeeper
from services.agent.leases import LeaseBook, LiveLease, StopReason
from services.agent.supervisor import ShardOutcome, Supervisor
from services.agent.webhooks import WebhookSender
from services.domain.errors import StoreUnavailable
from services.observability.metrics import Metrics
from services.store.base import Store

logger = logging.getLogger(__name__)

_COUNTS_INTERVAL_S = 5.0


class SlotState(StrEnum):
    STARTING = "starting"
    IDLE = "idle"
    BUSY = "busy"
    FENCED = "fenced"
    LOST = "lost"  # no process starts any more


class Agent:
    """One agent. `start` returns at once; `stop` gives back what is unfinished and ends every worker process.

    Args:
        store: Jobs and leases; thread-safe, closed by the caller after `stop`.
        executor: Where the slots come from.
    """

    def __init__(self, store: Store, config: AgentConfig, executor: Executor, metrics: Metrics) -> None:
        self._store = store
        self._config = config
        self._executor = executor
        self._metrics = metrics
        self._leases = LeaseBook(store, config.holder, config.lease_ttl_s, metrics)
        self._committer = Committer(store, metrics, config.s3_endpoint_url)
        self._give_backs = GiveBacks(config.max_give_backs)
        self._jobs = JobKeeper(store, self._committer, config, metrics)
        self._webhooks = WebhookSender(store, config.webhook_secrets, config.webhook_policy, metrics)
        self._work: queue.SimpleQueue[LiveLease] = queue.SimpleQueue()
        self._stopping = threading.Event()
        self._drained = threading.Event()
        self._wake = threading.Event()
        self._lock = threading.Lock()
        self._states: dict[int, SlotState] = {}
        self._claims = Backoff(config.backoff_base_s, config.backoff_max_s)
        self._claim_after_s = 0.0
        self._recoveries = self._new_backoff()
        self._recover_after_s = 0.0
        self._thread: threading.Thread | None = None

    @property
    def holder(self) -> str:
        """Under which name this agent holds leases."""
        return self._config.holder

    @property
    def ready(self) -> bool:
        """Whether at least one slot can work."""
        with self._lock:
            return any(state in (SlotState.IDLE, SlotState.BUSY) for state in self._states.values())

    def start(self) -> None:
        """Start working, in threads of this process."""
        if self._thread is not None:
            raise RuntimeError("an agent is started once")
        self._thread = threading.Thread(target=self._run, name="agent", daemon=True)
        self._thread.start()

    def stop(self, timeout_s: float = 60.0) -> None:
        """Stop within `cancel_grace_s` and what the executor needs. Unfinished shards are given back at once."""
        self._stopping.set()
        self._wake.set()
        if self._thread is not None:
            self._thread.join(timeout_s)
            if self._thread.is_alive():
                logger.error("the agent did not stop within %.0f s; its leases will run out", timeout_s)

    # The main thread ------------------------------------------------------------------------------------------------

    def _run(self) -> None:
        if not self._start_executor():
            return
        slots = self._executor.slots()
        with self._lock:
            self._states = dict.fromkeys(range(len(slots)), SlotState.STARTING)
        self._publish_slots()
        slot_threads = [
            threading.Thread(target=self._tend, args=(number, handle), name=f"agent-slot-{number}", daemon=True)
            for number, handle in enumerate(slots)
        ]
        renewals = threading.Thread(target=self._renew, name="agent-renew", daemon=True)
        jobs = threading.Thread(target=self._keep_jobs, name="agent-jobs", daemon=True)
        webhooks = threading.Thread(
            target=self._webhooks.run, args=(self._stopping, self._config.poll_s), name="agent-webhooks", daemon=True
        )
        for thread in (*slot_threads, renewals, jobs, webhooks):
            thread.start()
        logger.info("agent %s: %d slots, device %s", self.holder, len(slots), self._config.device)
        self._claim_until_stopped()

        for live in self._leases.all():
            live.stop(StopReason.DRAINED)
        for thread in slot_threads:
            thread.join()
        self._give_back_unclaimed()
        self._drained.set()
        renewals.join()
        self._executor.stop()
        # Planning and finalising can be deep in somebody else's call; both are done over when they are cut off.
        jobs.join(self._config.cancel_grace_s)
        webhooks.join(self._config.cancel_grace_s)
        logger.info("agent %s has stopped", self.holder)

    def _start_executor(self) -> bool:
        backoff = self._new_backoff()
        while not self._stopping.is_set():
            try:
                self._executor.start()
            except Exception as error:
                delay_s = backoff.failed()
                logger.exception("the executor did not start, next try in %.1f s: %s", delay_s, error)
                self._stopping.wait(delay_s)
            else:
                return True
        return False

    def _recover_executor(self) -> None:
        """Start the executor anew when its machinery is gone, or not one slot gets a process: then it is not the slots.

        Slots that are at work find their processes gone, blame nobody and go on when there is something to go on with.
        """
        now = time.monotonic()
        if now < self._recover_after_s:
            return
        gone = not self._executor.healthy()
        with self._lock:
            states = set(self._states.values())
        if not gone and states != {SlotState.LOST}:
            self._recoveries.succeeded()
            return
        why = "Ray's head is gone" if gone else "no worker process starts in any slot"
        logger.error("%s: the executor is started anew", why)
        try:
            self._executor.restart()
        except Exception as error:
            delay_s = self._recoveries.failed()
            self._recover_after_s = time.monotonic() + delay_s
            logger.exception("the executor did not start, next try in %.1f s: %s", delay_s, error)
            return
        self._metrics.executor_restarts.inc()
        # The slots need their time to start before anything can be said of them.
        self._recover_after_s = 0.0 if gone else time.monotonic() + self._config.start_timeout_s
        with self._lock:
            self._states = dict.fromkeys(self._states, SlotState.STARTING)
        self._publish_slots()

    def _claim_until_stopped(self) -> None:
        next_expiry_s = next_counts_s = 0.0
        while not self._stopping.is_set():
            now = time.monotonic()
            try:
                self._recover_executor()
                if now >= next_expiry_s:
                    next_expiry_s = now + self._config.lease_ttl_s / 3
                    expired = self._store.expire_leases()
                    self._metrics.lease_expired.inc(expired)
                if now >= next_counts_s:
                    next_counts_s = now + _COUNTS_INTERVAL_S
                    if paused := self._store.pause_over_limits():
                        logger.warning("paused %d jobs at their deadline or budget", paused)
                    self._publish_store()
                if now >= self._claim_after_s:
                    self._claim()
            except Exception as error:
                delay_s = self._claims.failed()
                self._claim_after_s = now + delay_s
                logger.warning("the store failed, next look for work in %.1f s: %s", delay_s, error)
            self._wake.wait(self._config.poll_s)
            self._wake.clear()

    def _claim(self) -> None:
        with self._lock:
            idle = sum(state is SlotState.IDLE for state in self._states.values())
        wanted = idle - self._work.qsize()
        if wanted > 0:
            for live in self._leases.claim(wanted):
                logger.info(
                    "leased %s: %d videos, attempt %d", live.lease.shard_id, len(live.lease.videos), live.lease.attempt
                )
                self._work.put(live)

    def _give_back_unclaimed(self) -> None:
        while True:
            try:
                live = self._work.get_nowait()
            except queue.Empty:
                return
            self._leases.drop(live)
            try:
                self._store.release(live.lease.shard_id, live.lease.fence, StopReason.DRAINED)
            except Exception as error:
                logger.warning("could not give %s back, its lease will run out: %s", live.lease.shard_id, error)

    # The other threads ----------------------------------------------------------------------------------------------

    def _tend(self, number: int, handle: SlotHandle) -> None:
        supervisor = Supervisor(
            handle,
            self._store,
            self._committer,
            self._give_backs,
            self._config,
            self._metrics,
            shares=self._executor.shares,
        )
        backoff = self._new_backoff()
        while not self._stopping.is_set():
            try:
                self._tend_once(number, supervisor, backoff)
            except Exception:
                # A slot that lost its thread would be gone for good, and nobody would notice.
                logger.exception("slot %d stumbled and goes on", number)
                self._stopping.wait(backoff.failed())
        supervisor.stop()

    def _tend_once(self, number: int, supervisor: Supervisor, backoff: Backoff) -> None:
        if not supervisor.start():
            self._enter(number, SlotState.LOST if backoff.failures else SlotState.STARTING)
            self._stopping.wait(backoff.failed())
            return
        backoff.succeeded()
        self._enter(number, SlotState.IDLE)
        try:
            live = self._work.get(timeout=0.5)
        except queue.Empty:
            return
        self._enter(number, SlotState.BUSY)
        try:
            outcome = supervisor.work(live)
        finally:
            self._leases.drop(live)  # Or it would be renewed for ever, with nobody working on it.
        self._after(outcome)
        if outcome.fenced:
            supervisor.stop()
            self._enter(number, SlotState.FENCED)
            self._stopping.wait(self._config.fence_cooloff_s)
            supervisor.pardon()

    def _after(self, outcome: ShardOutcome) -> None:
        """Claim the next shard at once, or later where the database does not answer.

        Whatever else is wrong is that shard's matter: it waits, and others have their turn.
        """
        if outcome.kind == "given_back" and outcome.reason == StoreUnavailable.code:
            self._claim_after_s = time.monotonic() + self._claims.failed()
        elif outcome.kind == "committed":
            self._claims.succeeded()
        self._wake.set()

    def _renew(self) -> None:
        # Beyond `stopping`: slots that are still giving back must not lose their leases meanwhile.
        period_s = self._config.lease_ttl_s / 3
        next_renewal_s = time.monotonic() + period_s
        while not self._drained.wait(min(self._config.poll_s, period_s)):
            try:
                if time.monotonic() >= next_renewal_s:
                    next_renewal_s = time.monotonic() + period_s
                    self._leases.renew()
                else:
                    self._leases.watch()
            except Exception:
                logger.exception("renewing the leases failed")

    def _keep_jobs(self) -> None:
        self._jobs.reconcile()
        while not self._stopping.is_set():
            try:
                busy = self._jobs.step()
            except Exception:
                logger.exception("looking after the jobs failed")
                busy = False
            if busy:
                self._wake.set()
            else:
                self._stopping.wait(self._config.poll_s)

    def _enter(self, number: int, state: SlotState) -> None:
        with self._lock:
            if self._states.get(number) is state:
                return
            self._states[number] = state
        self._publish_slots()
        if state is SlotState.IDLE:
            self._wake.set()

    def _publish_store(self) -> None:
        self._metrics.set_counts(self._store.counts())
        self._metrics.set_tenants(self._store.list_tenants())
        self._metrics.webhooks_waiting.set(self._store.undelivered())

    def _publish_slots(self) -> None:
        with self._lock:
            counts = Counter(self._states.values())
        for state in SlotState:
            self._metrics.actors.labels(role="slot", state=state.value).set(counts[state])

    def _new_backoff(self) -> Backoff:
        return Backoff(self._config.backoff_base_s, self._config.backoff_max_s)
