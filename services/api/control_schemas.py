"""What can be said about how a job is run: when it is created, and later."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, AwareDatetime, BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from services.domain.control import (
    DEFAULT_FAILURE_RATIO,
    DEFAULT_FAILURE_WINDOW,
    MAX_PRIORITY,
    JobControl,
    RetrySelection,
)

_YEARS = range(2000, 3000)


def _text(value: object) -> object:
    if value is not None and not isinstance(value, str):
        raise ValueError("write a time as RFC 3339 has it, like 2030-01-31T12:00:00Z")
    return value


def _storable_time(value: datetime) -> datetime:
    if value.year not in _YEARS:
        raise ValueError(f"the year must lie between {_YEARS.start} and {_YEARS.stop - 1}")
    return value.astimezone(UTC)


Deadline = Annotated[AwareDatetime, Field(strict=False), BeforeValidator(_text), AfterValidator(_storable_time)]
Priority = Annotated[int, Field(ge=-MAX_PRIORITY, le=MAX_PRIORITY)]
SlotHours = Annotated[float, Field(gt=0, le=1e9, allow_inf_nan=False)]
Ratio = Annotated[float, Field(ge=0, lt=1, allow_inf_nan=False)]
Window = Annotated[int, Field(ge=1, le=10_000)]

_PRIORITY = "Among the jobs of one tenant the highest goes first."
_DEADLINE = "When it passes, the job is paused. Null: none."
_SLOT_HOURS = "Hours of worker slots after which the job is paused, lost ones included. Null: no budget."
_RATIO = "The job is paused when more of its last `failure_window` settled videos failed. Null: never."
_WINDOW = "See `max_failure_ratio`; fewer settled videos pause nothing."
_WEBHOOK = "Who is told about every `job.*` event. Null: nobody."


class Webhook(BaseModel):
    """Where the events of a job are sent, signed."""

    model_config = ConfigDict(extra="forbid", strict=True)

    url: str = Field(min_length=1, max_length=2048, description="`https://...`, to a public address.")
    secret: str = Field(
        pattern=r"^[a-z0-9][a-z0-9_-]{0,62}$", description="Name of one of the tenant's secrets in the settings."
    )


class ControlFields(BaseModel):
    """The part of a new job that says how to run it."""

    priority: Priority = Field(default=0, description=_PRIORITY)
    deadline: Deadline | None = Field(default=None, description=_DEADLINE)
    max_slot_hours: SlotHours | None = Field(default=None, description=_SLOT_HOURS)
    max_failure_ratio: Ratio | None = Field(default=DEFAULT_FAILURE_RATIO, description=_RATIO)
    failure_window: Window = Field(default=DEFAULT_FAILURE_WINDOW, description=_WINDOW)
    webhook: Webhook | None = Field(default=None, description=_WEBHOOK)

    def to_control(self) -> JobControl:
        return JobControl(
            priority=self.priority,
            deadline=self.deadline,
            max_slot_hours=self.max_slot_hours,
            max_failure_ratio=self.max_failure_ratio,
            failure_window=self.failure_window,
            webhook_url=None if self.webhook is None else self.webhook.url,
            webhook_secret=None if self.webhook is None else self.webhook.secret,
        )


class JobChanges(BaseModel):
    """New values; what is left out stays as it is."""

    model_config = ConfigDict(extra="forbid", strict=True, json_schema_extra={"examples": [{"priority": 10}]})

    priority: Priority = Field(default=0, description=_PRIORITY)
    deadline: Deadline | None = Field(default=None, description=_DEADLINE)
    max_slot_hours: SlotHours | None = Field(default=None, description=_SLOT_HOURS)
    max_failure_ratio: Ratio | None = Field(default=None, description=_RATIO)
    failure_window: Window = Field(default=DEFAULT_FAILURE_WINDOW, description=_WINDOW)
    webhook: Webhook | None = Field(default=None, description=_WEBHOOK)

    def named(self) -> dict[str, Any]:
        """The fields of `JobControl` that the request names, with their new values."""
        changes = {name: getattr(self, name) for name in self.model_fields_set - {"webhook"}}
        if "webhook" in self.model_fields_set:
            changes["webhook_url"] = None if self.webhook is None else self.webhook.url
            changes["webhook_secret"] = None if self.webhook is None else self.webhook.secret
        return changes


class RetryRequest(BaseModel):
    """Which videos to try again: those that failed with one of `error_codes`, or those that `select` names."""

    model_config = ConfigDict(
        extra="forbid", strict=True, json_schema_extra={"examples": [{"error_codes": ["input_unavailable"]}]}
    )

    error_codes: list[Annotated[str, Field(pattern=r"^[a-z0-9_]{1,64}$")]] = Field(
        default_factory=list, max_length=50, description="Stable codes, as the videos of the job have them."
    )
    select: Literal["retryable", "quarantined"] = Field(
        default="retryable",
        description="`retryable`: failed with a code that another attempt can cure. `quarantined`: those that killed "
        "their workers.",
    )

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        if self.error_codes and "select" in self.model_fields_set:
            raise ValueError("give error_codes or select, not both")
        return self

    def to_selection(self) -> RetrySelection:
        return RetrySelection(tuple(self.error_codes), self.select)


class ControlView(BaseModel):
    """How a job is run; the secret of its webhook is only named."""

    model_config = ConfigDict(from_attributes=True)

    priority: int
    deadline: datetime | None
    max_slot_hours: float | None
    max_failure_ratio: float | None
    failure_window: int
    webhook_url: str | None
    webhook_secret: str | None = Field(description="The name of the secret.")
