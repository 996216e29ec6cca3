"""States of jobs and shards, and the only transitions there are."""

from __future__ import annotations

from enum import StrEnum


class JobState(StrEnum):
    QUEUED = "queued"  # accepted, not planned yet
    RUNNING = "running"  # shards exist or are being added
    PAUSED = "paused"  # no new leases; leased shards are given back, and nothing is planned until it is resumed
    FINALIZING = "finalizing"  # every shard is settled; the index is being written
    CANCELLING = "cancelling"  # no new leases; leased shards are being stopped
    SUCCEEDED = "succeeded"
    SUCCEEDED_WITH_ERRORS = "succeeded_with_errors"  # complete, but some videos have an error row
    FAILED = "failed"  # no usable output: planning failed, or the output cannot be written
    CANCELLED = "cancelled"

    @property
    def terminal(self) -> bool:
        return self in _TERMINAL


_TERMINAL = {JobState.SUCCEEDED, JobState.SUCCEEDED_WITH_ERRORS, JobState.FAILED, JobState.CANCELLED}

JOB_TRANSITIONS: dict[JobState, frozenset[JobState]] = {
    JobState.QUEUED: frozenset({JobState.RUNNING, JobState.PAUSED, JobState.FAILED, JobState.CANCELLING}),
    JobState.RUNNING: frozenset({JobState.FINALIZING, JobState.PAUSED, JobState.FAILED, JobState.CANCELLING}),
    # Resumed: to where it was.
    JobState.PAUSED: frozenset({JobState.QUEUED, JobState.RUNNING, JobState.FAILED, JobState.CANCELLING}),
    JobState.FINALIZING: frozenset({JobState.SUCCEEDED, JobState.SUCCEEDED_WITH_ERRORS, JobState.FAILED}),
    JobState.CANCELLING: frozenset({JobState.CANCELLED}),
    JobState.SUCCEEDED: frozenset(),
    JobState.SUCCEEDED_WITH_ERRORS: frozenset({JobState.RUNNING}),  # retried: its failed videos have new shards
    JobState.FAILED: frozenset(),
    JobState.CANCELLED: frozenset(),
}


class ShardState(StrEnum):
    PENDING = "pending"
    LEASED = "leased"
    COMMITTED = "committed"
    CANCELLED = "cancelled"


class VideoStatus(StrEnum):
    PENDING = "pending"
    SUCCEEDED = "succeeded"
    FAILED = "failed"  # a typed error of the input or the engine
    QUARANTINED = "quarantined"  # it killed the worker more often than allowed
