"""Parts of rows as the domain's values, and back."""

from __future__ import annotations

from datetime import datetime
from typing import Any

from sqlalchemy import Row

from services.domain.control import JobControl
from services.domain.errors import InvalidRequest


def control_of(job: Row[Any]) -> JobControl:
    """A job's row as what can be changed about it."""
    return JobControl(
        priority=job.priority,
        deadline=job.deadline,
        max_slot_hours=None if job.max_slot_seconds is None else job.max_slot_seconds / 3600,
        max_failure_ratio=job.max_failure_ratio,
        failure_window=job.failure_window,
        webhook_url=job.webhook_url,
        webhook_secret=job.webhook_secret,
    )


def control_columns(control: JobControl, now: datetime) -> dict[str, Any]:
    """The other way round.

    Raises:
        InvalidRequest: The deadline has passed.
    """
    if control.deadline is not None and control.deadline <= now:
        raise InvalidRequest(f"the deadline {control.deadline.isoformat()} has passed already")
    hours = control.max_slot_hours
    return {
        "priority": control.priority,
        "deadline": control.deadline,
        "max_slot_seconds": None if hours is None else hours * 3600,
        "max_failure_ratio": control.max_failure_ratio,
        "failure_window": control.failure_window,
        "webhook_url": control.webhook_url,
        "webhook_secret": control.webhook_secret,
    }
