"""How a job is run: its priority, its limits, who hears about it; and what a tenant may use. Values only.

None of it decides a byte of the output, so unlike the job's specification it can be changed while the job runs.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from datetime import datetime
from enum import StrEnum
from typing import Any, Literal

from services.domain.errors import InputUnavailable
from services.domain.states import VideoStatus
from vipe_core import errors as engine_errors

ANY_TENANT = "*"
"""The name under which the limits of tenants lie that have none of their own."""

MAX_PRIORITY = 1000
DEFAULT_FAILURE_RATIO = 0.5
DEFAULT_FAILURE_WINDOW = 200


class PauseReason(StrEnum):
    """Why a job is paused. Part of the public API."""

    REQUESTED = "requested"
    DEADLINE = "deadline"  # its time is over
    SLOT_HOURS = "slot_hours"  # its budget is used up
    FAILURE_RATIO = "failure_ratio"  # too many of its videos fail: something is wrong that more work does not mend
    TENANT_VIDEOS = "tenant_videos"  # its plan does not fit into what its tenant may have in the queue


@dataclass(frozen=True, slots=True)
class JobControl:
    """What can be changed about a job until it has ended.

    Attributes:
        priority: Among the jobs of one tenant the highest goes first; between tenants the fair share decides.
        deadline: When it passes, the job is paused.
        max_slot_hours: Hours of worker slots, those of lost leases included, after which the job is paused.
        max_failure_ratio: The job is paused when a larger share of its last `failure_window` settled videos failed or
            was quarantined; None: never. Fewer settled videos than that pause nothing.
        failure_window: See `max_failure_ratio`.
        webhook_url: Who is told about every `job.*` event.
        webhook_secret: Name of the secret that signs what is sent there; the secret itself is in the settings.
    """

    priority: int = 0
    deadline: datetime | None = None
    max_slot_hours: float | None = None
    max_failure_ratio: float | None = DEFAULT_FAILURE_RATIO
    failure_window: int = DEFAULT_FAILURE_WINDOW
    webhook_url: str | None = None
    webhook_secret: str | None = None

    def to_json(self) -> dict[str, Any]:
        return {**asdict(self), "deadline": None if self.deadline is None else self.deadline.isoformat()}


DEFAULT_CONTROL = JobControl()


@dataclass(frozen=True, slots=True)
class RetrySelection:
    """Which videos of an ended job are tried again.

    Attributes:
        error_codes: Those that failed, or were quarantined, with one of these codes. Empty: as `kind` says.
        kind: `retryable`: those whose error says that another attempt can succeed. `quarantined`: those that killed
            their workers.
    """

    error_codes: tuple[str, ...] = ()
    kind: Literal["retryable", "quarantined"] = "retryable"

    def __contains__(self, video: tuple[VideoStatus, str | None]) -> bool:
        status, code = video
        if status not in (VideoStatus.FAILED, VideoStatus.QUARANTINED):
            return False
        if self.error_codes:
            return code in self.error_codes
        if self.kind == "quarantined":
            return status is VideoStatus.QUARANTINED
        return status is VideoStatus.FAILED and code in RETRYABLE_CODES


def _retryable_codes() -> frozenset[str]:
    engine = {
        kind.code
        for kind in vars(engine_errors).values()
        if isinstance(kind, type) and issubclass(kind, engine_errors.VipeError) and kind.retryable
    }
    return frozenset(engine | {"video_timeout", InputUnavailable.code})


RETRYABLE_CODES = _retryable_codes()
"""Codes of failed videos with which another attempt at the same input can succeed."""


@dataclass(frozen=True, slots=True)
class TenantLimits:
    """What one tenant may use. None: no limit.

    Attributes:
        weight: Share of the slots, relative to the other tenants that have work.
        max_slots: Most leases at a time.
        max_jobs: Most jobs that have not ended.
        max_videos: Most videos that are not settled, over all jobs that have not ended.
    """

    weight: float = 1.0
    max_slots: int | None = None
    max_jobs: int | None = None
    max_videos: int | None = None

    def __post_init__(self) -> None:
        if not 0 < self.weight < 1e6:
            raise ValueError(f"the weight of a tenant must be positive, got {self.weight}")
        for name in ("max_slots", "max_jobs", "max_videos"):
            value = getattr(self, name)
            if value is not None and value < 0:
                raise ValueError(f"{name} must not be negative, got {value}")


@dataclass(frozen=True, slots=True)
class Tenant:
    """A tenant, its limits and what it uses.

    Attributes:
        limits: Those that count for it: its own, or those of `*`.
        own_limits: Whether they are its own.
        slots: Live leases.
        open_jobs: Jobs that have not ended.
        open_videos: Their videos that are not settled.
        slot_seconds: Seconds of worker slots of all its jobs, since ever.
    """

    name: str
    limits: TenantLimits
    own_limits: bool
    slots: int = 0
    open_jobs: int = 0
    open_videos: int = 0
    slot_seconds: float = 0.0


@dataclass(frozen=True, slots=True)
class Delivery:
    """An event on its way to a job's webhook.

    Attributes:
        event_id: The same whenever the event is sent, so that the receiver can tell a repetition.
        body: What is sent and signed; the same bytes each time.
        attempt: 1 for the first.
    """

    event_seq: int
    job_id: str
    tenant: str
    url: str
    secret: str | None
    body: bytes
    attempt: int

    @property
    def event_id(self) -> str:
        return f"evt_{self.event_seq}"


Changes = Mapping[str, Any]
"""Fields of `JobControl` with their new values."""
