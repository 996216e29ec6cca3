"""What happens to jobs rather than to shards: planning, reconciling with the output, finalising."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable

from services.agent.backoff import Backoff
from services.agent.commits import Committer
from services.agent.config import AgentConfig
from services.domain.errors import ServiceError, code_and_message
from services.domain.models import Job
from services.domain.states import JobState
from services.observability.logging import context
from services.observability.metrics import Metrics
from services.planner import plan_next, write_plan
from services.store.base import Store

logger = logging.getLogger(__name__)

_FINALISE_TRIES = 8
_SWEEP_TRIES = 8


class JobKeeper:
    """Moves jobs along. One step at a time, from one thread; an error in one job is that job's alone."""

    def __init__(
        self,
        store: Store,
        committer: Committer,
        config: AgentConfig,
        metrics: Metrics,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._store = store
        self._committer = committer
        self._config = config
        self._metrics = metrics
        self._clock = clock
        self._planning = self._backoff()
        self._plan_after_s = 0.0

    def step(self) -> bool:
        """Plan a job and finalise a job, or tidy up after one; whether anything was done. Never raises."""
        planned = self._plan()
        finalised = self._finalise()
        return planned or finalised or self._sweep()

    def reconcile(self) -> None:
        """Let the database learn what running jobs have in their output that it missed. Never raises."""
        after: str | None = None
        while True:
            try:
                jobs, after = self._store.list_jobs(state=JobState.RUNNING, after=after)
            except Exception as error:
                logger.warning("could not list the running jobs to reconcile: %s", error)
                return
            for job in jobs:
                try:
                    self._committer.reconcile(job)
                except Exception as error:  # A retaken lease looks for its own record again.
                    logger.warning("could not reconcile %s: %s", job.id, error)
            if after is None:
                return

    def _plan(self) -> bool:
        if self._clock() < self._plan_after_s:
            return False
        try:
            busy = plan_next(
                self._store,
                self._config.holder,
                ttl_s=self._config.lease_ttl_s,
                rules=self._config.inputs,
                output_roots=self._config.output_roots,
                s3_endpoint_url=self._config.s3_endpoint_url,
                backoff_base_s=self._config.backoff_base_s,
                backoff_max_s=self._config.backoff_max_s,
            )
        except Exception as error:
            delay_s = self._planning.failed()
            self._plan_after_s = self._clock() + delay_s
            trace = not isinstance(error, ServiceError)
            logger.warning("planning failed, next try in %.1f s: %s", delay_s, error, exc_info=trace)
            return False
        self._planning.succeeded()
        return busy

    def _finalise(self) -> bool:
        try:
            job = self._store.next_finalizable()
        except Exception as error:
            logger.warning("could not look for jobs to finalise: %s", error)
            return False
        if job is None:
            return False
        with context(job=job.id):
            return self._finalise_job(job)

    def _finalise_job(self, job: Job) -> bool:
        started = self._clock()
        try:
            from services.dataset import finalise  # Slow to import; see `services.agent.commits`.

            scratch = self._config.scratch_dir / "finalise"
            scratch.mkdir(parents=True, exist_ok=True)
            output = self._committer.output(job.spec.output)
            write_plan(output, self._store, job.id, job.spec.config_hash)  # Earlier releases planned without it.
            finalise(
                output,
                job.id,
                job.spec,
                num_shards=job.progress.shards_total,
                num_videos=job.progress.videos_total,
                scratch=scratch,
            )
            done = self._store.finish_job(job.id)
        except Exception as error:
            self._not_finalised(job, error)
            return False
        else:
            self._metrics.stage_duration.labels(stage="finalise").observe(self._clock() - started)
            logger.info("%s: %s", job.id, done.state.value)
            return True

    def _not_finalised(self, job: Job, error: Exception) -> None:
        """Later, or never; meanwhile the other jobs have their turn."""
        foreseen = isinstance(error, ServiceError)
        try:
            if not isinstance(error, ServiceError) or error.retryable:
                deferral = self._store.defer_job(
                    job.id, base_s=self._config.backoff_base_s, max_s=self._config.backoff_max_s
                )
                if deferral.failures < _FINALISE_TRIES:
                    logger.warning(
                        "could not finalise, next try in %.1f s: %s", deferral.wait_s, error, exc_info=not foreseen
                    )
                    return
            logger.error("cannot be finalised: %s", error, exc_info=not foreseen)
            self._store.fail_job(job.id, *code_and_message(error))
        except Exception as second:
            logger.warning("could not say that finalising failed: %s", second)

    def _sweep(self) -> bool:
        """Remove what attempts that crashed or came second left in the output of a job that has ended.

        Best effort: the job is what it is, and an output that does not answer in the end keeps its rubbish.
        """
        try:
            job = self._store.next_unswept(quiet_s=2 * self._config.lease_ttl_s)
            if job is None:
                return False
            with context(job=job.id):
                if not self._swept(job):
                    return False
                self._store.finish_sweep(job.id)
        except Exception as error:
            logger.warning("could not look for outputs to tidy up: %s", error)
            return False
        return True

    def _swept(self, job: Job) -> bool:
        """Whether this job is done with."""
        try:
            from services.commit.gc import collect_garbage  # Slow to import; see `services.agent.commits`.

            abandoned = job.state in (JobState.FAILED, JobState.CANCELLED)
            if abandoned:  # What was decided just before the end counts, and its payload stays.
                self._committer.reconcile(job)
            collect_garbage(self._committer.output(job.spec.output), job.id, abandoned=abandoned)
        except Exception as error:
            deferral = self._store.defer_job(
                job.id, base_s=self._config.backoff_base_s, max_s=self._config.backoff_max_s
            )
            logger.warning("could not tidy up the output of %s: %s", job.id, error)
            return deferral.failures >= _SWEEP_TRIES
        return True

    def _backoff(self) -> Backoff:
        return Backoff(self._config.backoff_base_s, self._config.backoff_max_s)
