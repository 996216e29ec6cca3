"""Names of the events in a job's history. They are part of the public API: they never change their meaning."""

from __future__ import annotations

from enum import StrEnum

from services.domain.states import JobState


class EventKind(StrEnum):
    JOB_QUEUED = "job.queued"
    JOB_RUNNING = "job.running"  # also when it is resumed or retried
    JOB_PAUSED = "job.paused"  # with its reason
    JOB_FINALIZING = "job.finalizing"
    JOB_CANCELLING = "job.cancelling"
    JOB_SUCCEEDED = "job.succeeded"
    JOB_SUCCEEDED_WITH_ERRORS = "job.succeeded_with_errors"
    JOB_FAILED = "job.failed"
    JOB_CANCELLED = "job.cancelled"
    OUTPUT_PROBED = "output.probed"  # who decides a commit: the output, or the database
    JOB_UPDATED = "job.updated"  # its priority, a limit or its webhook was changed
    SHARDS_PLANNED = "shards.planned"  # a batch of shards was added
    PLANNING_FINISHED = "planning.finished"
    SHARD_LEASED = "shard.leased"
    SHARD_RELEASED = "shard.released"
    SHARD_EXPIRED = "shard.expired"
    SHARD_COMMITTED = "shard.committed"
    WEBHOOK_ABANDONED = "webhook.abandoned"  # an event was not taken by its receiver, however often it was sent
    VIDEO_BLAMED = "video.blamed"  # a worker process died while it worked on this video

    @property
    def terminal(self) -> bool:
        """Whether a job's history ends with this event, unless the job is retried."""
        return self in _TERMINAL


def ends_history(kind: str) -> bool:
    """Whether a job's history ends with an event of this name, unless the job is retried.

    A name from a newer release is not the end.
    """
    return kind in _TERMINAL


def job_event(state: JobState) -> EventKind:
    """The event that a job writes when it enters a state."""
    return EventKind(f"job.{state.value}")


_TERMINAL = {job_event(state) for state in JobState if state.terminal}
