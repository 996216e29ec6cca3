"""One slot's state machine: what to do next with a lease, whom to blame for a death, and when to give up.

    open -> (annotate a video)* -> pack -> commit -> discard
              | died: blame, restart, try the video again after the others of its shard
              | over its wall budget: kill, restart, try the video once more at the end, then `video_timeout`
              | storage down: back off, then give the lease back

Coordinated caps keep one bad part from taking the rest with it. A video that kills the worker is tried last and is
quarantined after `max_worker_deaths`, or after fewer in different places. A slot on which workers die in a row
is itself the suspect and is fenced before it can quarantine the innocent. Where a slot has seen nothing but the deaths
of one video, it cannot tell which of the two is bad: before its last try the shard is given back, so that another slot
may say. A slot that begins anew, after a fence too, condemns nobody before it has done other work or tried for itself.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal, TypeVar

from services.agent.backoff import Backoff, GiveBacks, exponential_s
from services.agent.commits import Committer
from services.agent.config import AgentConfig
from services.agent.executor import Died, SlotHandle
from services.agent.gpus import GpuShares, Want
from services.agent.leases import LiveLease, StopReason
from services.agent.messages import (
    Annotated,
    AnnotateVideo,
    Answer,
    Cancelled,
    DiscardShard,
    Failed,
    Grant,
    Opened,
    OpenShard,
    Packed,
    PackShard,
    Task,
)
from services.agent.slot import failed_row
from services.agent.traffic import TrafficMetrics
from services.domain.errors import InputUnavailable, ServiceError
from services.domain.models import Death, Lease, VideoRef, VideoResult
from services.domain.states import VideoStatus
from services.observability.logging import context
from services.observability.metrics import Metrics
from services.store.base import Store
from vipe_core.errors import OutOfDeviceMemory

logger = logging.getLogger(__name__)

WORKER_DIED = "worker_died"
VIDEO_TIMEOUT = "video_timeout"

_POLL_S = 0.2

ResultT = TypeVar("ResultT")


@dataclass(frozen=True, slots=True)
class ShardOutcome:
    """How work on a lease ended.

    Attributes:
        kind: `committed`, also by somebody else; `stopped` by the live lease's stop reason; `given_back` for another
            attempt; `job_failed`: no attempt at any shard of this job can succeed.
        fenced: The slot must not be used for a while.
    """

    kind: Literal["committed", "stopped", "given_back", "job_failed"]
    reason: str = ""
    message: str = ""
    fenced: bool = False


class _Ended(Exception):
    """Unwinds to `work` with the outcome."""

    def __init__(self, outcome: ShardOutcome) -> None:
        super().__init__(outcome.reason)
        self.outcome = outcome


@dataclass(frozen=True, slots=True)
class _TimedOut:
    """The task in flight went over its wall budget and was killed."""

    budget_s: float


class Supervisor:
    """Runs leases on one slot, one after another. All methods from one thread.

    Args:
        clock: Monotonic seconds.
        sleep: Waits; both are seams for tests.
        shares: Of the GPUs that slots share; None without GPUs.
    """

    def __init__(
        self,
        handle: SlotHandle,
        store: Store,
        committer: Committer,
        give_backs: GiveBacks,
        config: AgentConfig,
        metrics: Metrics,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
        shares: GpuShares | None = None,
    ) -> None:
        self._handle = handle
        self._store = store
        self._committer = committer
        self._give_backs = give_backs
        self._config = config
        self._metrics = metrics
        self._traffic = TrafficMetrics(metrics)
        self._clock = clock
        self._sleep = sleep
        self._shares = shares
        self._alive = False
        self._suspicious: list[str] = []
        self._proved = False
        self._tried: set[str] = set()
        self._born_s = 0.0
        self._videos = 0
        self._grown_from_bytes = 0
        self._rss_bytes = 0

    def work(self, live: LiveLease) -> ShardOutcome:
        """Bring a lease to its end. Gives the lease back or lets it go as the outcome says; never raises."""
        lease = live.lease
        with context(job=lease.job_id, shard=lease.shard_id):
            try:
                outcome = self._shard(live)
            except _Ended as ended:
                outcome = ended.outcome
            except Exception as error:
                logger.exception("work on %s failed", lease.shard_id)
                outcome = self._unforeseen(lease, error)
            live.close()
            self._let_go(lease, outcome)
            return outcome

    def start(self) -> bool:
        """Start the worker process if there is none; False if it does not start."""
        if self._alive:
            return True
        try:
            died = self._handle.start(self._config.start_timeout_s)
        except Exception as error:
            logger.exception("the executor failed")
            died = Died(f"{type(error).__name__}: {error}")
        if died is None:
            self._alive = True
            self._born_s, self._videos, self._grown_from_bytes = self._clock(), 0, 0
            return True
        self._metrics.actor_restarts.labels(reason="start_failed").inc()
        logger.error("a worker process did not start: %s", died.detail)
        self._handle.kill()
        return False

    def stop(self) -> None:
        """End the worker process."""
        self._handle.kill()
        self._alive = False

    def pardon(self) -> None:
        """Give a fenced slot another chance."""
        self._suspicious.clear()
        self._proved = False
        self._tried.clear()

    # The shard ------------------------------------------------------------------------------------------------------

    def _shard(self, live: LiveLease) -> ShardOutcome:
        lease = live.lease
        if lease.attempt > 1 and self._persist(lambda: self._committer.settled(lease)):
            return ShardOutcome("committed", "found in the output")
        deaths = dict(lease.spent)
        results: dict[str, VideoResult] = self._opened(live, {})
        pack_deaths = 0
        while True:
            self._annotate_all(live, results, deaths)
            live.follow(tuple(results.values()), self._handle.progress)
            ordered = tuple(results[video.key] for video in lease.videos)
            tar_name = self._persist(lambda: self._committer.tar_name(lease))
            answer = self._run(live, PackShard(lease, ordered, tar_name), lambda: self._config.pack_budget_s)
            match answer:
                case Packed(payload):
                    self._metrics.stage_duration.labels(stage="pack").observe(payload.build_s)
                    self._metrics.stage_duration.labels(stage="upload").observe(payload.upload_s)
                    return self._commit(live, answer)
                case Died() | _TimedOut():
                    pack_deaths += 1
                    self._suspect(f"{lease.shard_id}/pack")
                    if pack_deaths >= self._config.max_worker_deaths:
                        message = f"{lease.shard_id}: the worker died or hung {pack_deaths} times while packing"
                        raise self._given_back(live, Failed(WORKER_DIED, message, True, "shard"))
                    results = self._opened(live, results)
                case Failed():
                    raise self._given_back(live, answer)
                case _:
                    raise TypeError(f"unexpected answer {type(answer).__name__} to a pack task")

    def _annotate_all(
        self, live: LiveLease, results: dict[str, VideoResult], deaths: dict[str, tuple[Death, ...]]
    ) -> None:
        """Fill `results` until every video of the lease has one."""
        lease = live.lease
        tries: dict[str, int] = {}
        timeouts: dict[str, int] = {}
        wants: dict[str, Want] = {}
        storage = self._backoff()
        while missing := [video for video in lease.videos if video.key not in results]:
            # Those that have killed a worker go last: the others are safe by then, and the slot has proved itself.
            video = min(missing, key=lambda v: len(deaths.get(v.key, ())) + timeouts.get(v.key, 0))
            if self._is_poison(video.key, deaths.get(video.key, ())):
                results[video.key] = self._quarantined(video, lease, deaths[video.key])
                continue
            if self._worn_out():
                self._metrics.actor_restarts.labels(reason="recycled").inc()
                self.stop()
                self._replace(results, self._opened(live, results))
            live.follow(tuple(results.values()), self._handle.progress)
            with context(video=video.key):
                answer = self._annotate(live, video, wants.get(video.key, Want()))
                match answer:
                    case Annotated(result):
                        results[video.key] = result
                        self._trust()
                        storage.succeeded()
                    case Failed(code=OutOfDeviceMemory.code) if self._shares is not None:
                        self._trust()
                        wider = self._shares.plan.wider(wants.get(video.key, Want()), answer.needed_bytes)
                        if answer.needed_bytes is None:
                            # What failed half-way may hold memory for good.
                            self._metrics.actor_restarts.labels(reason=OutOfDeviceMemory.code).inc()
                            self.stop()
                            self._replace(results, self._opened(live, results))
                        if wider is None:
                            whole_gb = self._shares.plan.bytes_of(self._shares.plan.per_gpu) / 1e9
                            message = f"{answer.message}; a whole GPU here has {whole_gb:.1f} GB for one video"
                            results[video.key] = failed_row(video, lease.attempt, answer.code, message)
                        else:
                            logger.warning("%s; another try with %s", answer.message, wider)
                            wants[video.key] = wider
                    case Failed(scope="video"):
                        self._trust()
                        tries[video.key] = tries.get(video.key, 0) + 1
                        if answer.detail:
                            logger.error("%s\n%s", answer.message, answer.detail)
                        if not answer.retryable or tries[video.key] >= self._config.max_video_tries:
                            logger.info("failed with %s: %s", answer.code, answer.message)
                            results[video.key] = failed_row(video, lease.attempt, answer.code, answer.message)
                    case Failed(scope="storage"):
                        self._trust()
                        delay_s = storage.failed()
                        if answer.retryable and storage.failures < self._config.storage_tries:
                            logger.warning("storage failed, next try in %.1f s: %s", delay_s, answer.message)
                            self._pause(live, delay_s)
                        elif self._give_backs.exhausted(lease.shard_id):
                            results[video.key] = failed_row(video, lease.attempt, InputUnavailable.code, answer.message)
                            storage.succeeded()
                        else:
                            raise self._given_back(live, answer)
                    case Failed():
                        raise self._given_back(live, answer)
                    case _TimedOut(budget_s):
                        # Once it may have been the machine: a disk that hung, a process that somebody stopped.
                        timeouts[video.key] = timeouts.get(video.key, 0) + 1
                        if timeouts[video.key] >= self._config.max_video_tries:
                            message = f"{video.uri}: no result within {budget_s:.0f} s; the worker was killed"
                            results[video.key] = failed_row(video, lease.attempt, VIDEO_TIMEOUT, message)
                        self._replace(results, self._opened(live, results))
                    case Died():
                        self._died_on(live, video, answer, deaths)
                        self._replace(results, self._opened(live, results))
                    case _:
                        raise TypeError(f"unexpected answer {type(answer).__name__} to an annotate task")

    def _annotate(self, live: LiveLease, video: VideoRef, want: Want) -> Answer | Died | _TimedOut:
        """Annotate a video, on a GPU with what it is given of its memory, which may have to be waited for."""
        budget_s = partial(self._budget_s, video)
        if self._shares is None:
            return self._run(live, AnnotateVideo(live.lease, video), budget_s)
        self._restart(live)  # Only a process has a GPU.
        grant = Grant(self._shares.plan.bytes_of(want.shares), want.low_memory)
        with self._shares.held(self._handle.place, want.shares, partial(_go_on, live)):
            return self._run(live, AnnotateVideo(live.lease, video, grant), budget_s)

    def _opened(self, live: LiveLease, known: dict[str, VideoResult]) -> dict[str, VideoResult]:
        """Open the shard on a live process: what is finished on its node, and rows that need no artifacts."""
        for _ in range(self._config.max_slot_deaths):
            # A process that died while it was idle shows here, before there is a video to blame.
            answer = self._run(live, OpenShard(live.lease), lambda: self._config.pack_budget_s)
            if isinstance(answer, Opened):
                results = {r.key: r for r in known.values() if r.status is not VideoStatus.SUCCEEDED}
                results.update({r.key: r for r in answer.results if r.key not in results})
                return results
            if isinstance(answer, Failed):
                raise self._given_back(live, answer)
        message = f"{live.lease.shard_id}: the worker died again and again before it began"
        raise self._given_back(live, Failed(WORKER_DIED, message, True, "shard"))

    def _commit(self, live: LiveLease, packed: Packed) -> ShardOutcome:
        """Write the record, then tell the database. A drain or a cancellation does not stop what is this close."""
        started = time.perf_counter()
        outcome = self._persist(lambda: self._committer.write(live.lease, packed.payload))
        if outcome.record is None:
            return ShardOutcome("stopped", StopReason.LOST)
        record = outcome.record
        live.close()  # The database is about to end the lease: a renewal would call it lost.
        self._persist(lambda: self._committer.record(record))
        self._metrics.stage_duration.labels(stage="commit").observe(time.perf_counter() - started)
        return ShardOutcome("committed", outcome.kind)

    def _persist(self, step: Callable[[], ResultT]) -> ResultT:
        """Retry a step of the commit while storage or the database do not answer."""
        backoff = self._backoff()
        while True:
            try:
                return step()
            except ServiceError as error:
                if not error.retryable:
                    raise _Ended(ShardOutcome("job_failed", error.code, str(error))) from error
                delay_s = backoff.failed()
                if backoff.failures >= self._config.storage_tries:
                    raise _Ended(ShardOutcome("given_back", error.code, str(error))) from error
                logger.warning("could not commit, next try in %.1f s: %s", delay_s, error)
                self._sleep(delay_s)

    # One task -------------------------------------------------------------------------------------------------------

    def _run(self, live: LiveLease, task: Task, budget_s: Callable[[], float]) -> Answer | Died | _TimedOut:
        """Hand a task to the worker and watch it: its end, its budget, and whether the lease must be stopped.

        Raises:
            _Ended: The lease was stopped; the worker does not work on it any more.
        """
        self._restart(live)
        started = self._clock()
        self._handle.submit(task)
        stop_since: float | None = None
        while True:
            outcome = self._handle.poll(_POLL_S)
            now = self._clock()
            if isinstance(outcome, Died):
                self._alive = False
                self._handle.kill()
                if live.stop_reason is not None:
                    raise _Ended(ShardOutcome("stopped", live.stop_reason))
                self._metrics.actor_restarts.labels(reason="died").inc()
                return outcome
            if outcome is not None:
                self._traffic.add(outcome.traffic)
                if isinstance(task, AnnotateVideo):
                    self._videos += 1
                    self._rss_bytes = outcome.rss_bytes
                    self._grown_from_bytes = self._grown_from_bytes or outcome.rss_bytes
                if isinstance(outcome.answer, Cancelled):
                    raise _Ended(ShardOutcome("stopped", live.stop_reason or "interrupted"))
                return outcome.answer
            if live.stop_reason is not None:
                stop_since = now if stop_since is None else stop_since
                self._handle.cancel()
                if now - stop_since > self._config.cancel_grace_s:
                    self.stop()
                    raise _Ended(ShardOutcome("stopped", live.stop_reason))
            elif now - started > (allowed_s := budget_s()):
                self._metrics.actor_restarts.labels(reason=VIDEO_TIMEOUT).inc()
                logger.error("%s went over its budget of %.0f s and is killed", type(task).__name__, allowed_s)
                self.stop()
                return _TimedOut(allowed_s)  # The budget depends on the progress, which goes with the process.

    def _restart(self, live: LiveLease) -> None:
        backoff = self._backoff()
        while not self.start():
            delay_s = backoff.failed()
            if backoff.failures >= self._config.max_slot_deaths:
                raise _Ended(ShardOutcome("given_back", "no_worker", "no worker process starts"))
            self._pause(live, delay_s)

    def _budget_s(self, video: VideoRef) -> float:
        """Wall budget of a video; grows once the engine knows how many frames there are."""
        config = self._config
        fetch_s = video.size_bytes / config.fetch_min_bytes_per_s
        frames = self._handle.progress().frames_expected or 0
        return config.video_budget_base_s + fetch_s + config.video_budget_per_frame_s * frames

    # Blame ----------------------------------------------------------------------------------------------------------

    def _died_on(self, live: LiveLease, video: VideoRef, died: Died, deaths: dict[str, tuple[Death, ...]]) -> None:
        if died.preempted:
            logger.warning("the machine of a worker was taken away; its video is not blamed: %s", died.detail)
            return
        self._tried.add(video.key)
        before = deaths.get(video.key, ())
        first = not before
        lease = live.lease
        death = Death(died.detail[:200], self._handle.place, lease.holder, lease.attempt)
        deaths[video.key] = self._blame(lease, video, death, before)
        logger.error(
            "the worker died (%d of %d): %s", len(deaths[video.key]), self._config.max_worker_deaths, died.detail
        )
        again = video.key in self._suspicious
        if first or self._suspicious:  # A known killer alone says nothing new about the slot.
            self._suspect(video.key)
        if again and len(deaths[video.key]) == self._config.max_worker_deaths - 1:
            raise self._given_back(live, Failed(WORKER_DIED, f"{video.uri}: another slot is asked", True, "shard"))

    def _blame(self, lease: Lease, video: VideoRef, death: Death, before: tuple[Death, ...]) -> tuple[Death, ...]:
        """Count the death where it survives this process; if the store does not answer, at least here."""
        at_least = (*before, death)
        try:
            counted = self._store.blame(lease.shard_id, lease.fence, video.key, death)
        except Exception as error:
            logger.warning("could not record the death: %s", error)
            return at_least
        return counted if len(counted) >= len(at_least) else at_least

    def _trust(self) -> None:
        """The worker came through a task: whatever died here before, it was not for the slot's sake alone."""
        self._suspicious.clear()
        self._proved = True

    def _is_poison(self, key: str, deaths: tuple[Death, ...]) -> bool:
        """Dead in two places, it is the video and not the place. In one place it takes more deaths, and a slot that
        was there and has done other work since, or has tried for itself since it began anew."""
        places = {death.place for death in deaths if death.place}
        if len(places) >= self._config.max_death_places:
            return True
        seen_here = not places or self._handle.place in places
        may_say = key not in self._suspicious and (self._proved or key in self._tried)
        return len(deaths) >= self._config.max_worker_deaths and seen_here and may_say

    def _worn_out(self) -> bool:
        """Whether the worker process has done enough: leaks of drivers and decoders end with it."""
        config = self._config
        if not self._alive or self._videos == 0:
            return False
        reasons = {
            "videos": 0 < config.recycle_videos <= self._videos,
            "age": 0 < config.recycle_age_s <= self._clock() - self._born_s,
            "memory": 0 < config.recycle_growth_bytes <= self._rss_bytes - self._grown_from_bytes,
        }
        for reason in (reason for reason, worn_out in reasons.items() if worn_out):
            logger.info("the worker is replaced after %d videos: %s", self._videos, reason)
            return True
        return False

    def _suspect(self, key: str) -> None:
        self._suspicious.append(key)
        if len(self._suspicious) >= self._config.max_slot_deaths:
            logger.error(
                "this slot is fenced: the worker died %d times in a row (%s)",
                len(self._suspicious),
                ", ".join(sorted(set(self._suspicious))),
            )
            raise _Ended(ShardOutcome("given_back", "slot_fenced", "the worker keeps dying", fenced=True))

    def _quarantined(self, video: VideoRef, lease: Lease, deaths: tuple[Death, ...]) -> VideoResult:
        message = (
            f"{video.uri}: the worker process died {len(deaths)} times on this video, the last time: "
            f"{deaths[-1].reason}; it is not tried again"
        )
        logger.error("quarantined: %s", message)
        row = failed_row(video, lease.attempt, WORKER_DIED, message)
        return replace(row, status=VideoStatus.QUARANTINED, deaths=deaths)

    # Endings --------------------------------------------------------------------------------------------------------

    def _given_back(self, live: LiveLease, failed: Failed) -> _Ended:
        """How the lease ends, as the scope of a failure asks; to be raised."""
        if failed.detail:
            logger.error("%s\n%s", failed.message, failed.detail)
        exhausted = failed.scope == "shard" and self._give_backs.exhausted(live.lease.shard_id)
        if failed.scope == "job" or exhausted:
            return _Ended(ShardOutcome("job_failed", failed.code, failed.message))
        return _Ended(ShardOutcome("given_back", failed.code, failed.message))

    def _unforeseen(self, lease: Lease, error: Exception) -> ShardOutcome:
        """How a lease ends whose work failed outside of every task: not for ever in the same way."""
        if isinstance(error, ServiceError):
            kind: Literal["given_back", "job_failed"] = "given_back" if error.retryable else "job_failed"
            return ShardOutcome(kind, error.code, str(error))
        kind = "job_failed" if self._give_backs.exhausted(lease.shard_id) else "given_back"
        first_line = next(iter(str(error).splitlines()), "no message")
        return ShardOutcome(kind, "internal_error", f"{lease.shard_id}: {type(error).__name__}: {first_line}")

    def _let_go(self, lease: Lease, outcome: ShardOutcome) -> None:
        """Settle a lease that is not worked on any more. What the store does not hear now, expiry repairs later."""
        logger.info("%s: %s %s %s", lease.shard_id, outcome.kind, outcome.reason, outcome.message)
        if outcome.kind == "given_back":
            self._give_backs.add(lease.shard_id)
        else:
            self._give_backs.forget(lease.shard_id)
        try:
            if outcome.kind == "job_failed":
                self._store.fail_job(lease.job_id, outcome.reason, outcome.message)
            if outcome.kind != "committed" and outcome.reason != StopReason.LOST:
                self._store.release(lease.shard_id, lease.fence, outcome.reason, wait_s=self._wait_s(lease, outcome))
        except Exception as error:
            logger.warning("could not give %s back, its lease will run out: %s", lease.shard_id, error)
        if outcome.kind in ("committed", "job_failed") or outcome.reason in (StopReason.LOST, StopReason.CANCELLED):
            self._discard(lease)

    def _wait_s(self, lease: Lease, outcome: ShardOutcome) -> float:
        """How long a shard that was given back rests; what was only stopped can go on at once."""
        if outcome.kind != "given_back":
            return 0.0
        return exponential_s(lease.attempt - 1, self._config.backoff_base_s, self._config.backoff_max_s)

    def _discard(self, lease: Lease) -> None:
        """Remove the scratch of a lease, if there is a process that can; otherwise the next sweep does."""
        if not self._alive:
            return
        try:
            self._handle.submit(DiscardShard(lease))
            outcome = self._handle.poll(self._config.start_timeout_s)
        except Exception as error:
            logger.warning("could not remove the scratch of %s: %s", lease.shard_id, error)
            outcome = None
        if outcome is None or isinstance(outcome, Died):
            self.stop()

    def _pause(self, live: LiveLease, seconds: float) -> None:
        """Wait, but not longer than the lease may be worked on."""
        until = self._clock() + seconds
        while (left := until - self._clock()) > 0:
            _go_on(live)
            self._sleep(min(_POLL_S, left))

    def _backoff(self) -> Backoff:
        return Backoff(self._config.backoff_base_s, self._config.backoff_max_s)

    @staticmethod
    def _replace(results: dict[str, VideoResult], fresh: dict[str, VideoResult]) -> None:
        results.clear()
        results.update(fresh)


def _go_on(live: LiveLease) -> None:
    if live.stop_reason is not None:
        raise _Ended(ShardOutcome("stopped", live.stop_reason))
