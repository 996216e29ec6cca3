"""The tables. `migrations/` creates them; a test holds the two together."""

from __future__ import annotations

from datetime import UTC, datetime
from enum import StrEnum

from sqlalchemy import (
    JSON,
    BigInteger,
    Boolean,
    CheckConstraint,
    Column,
    ColumnElement,
    DateTime,
    Dialect,
    Float,
    ForeignKey,
    Index,
    Integer,
    MetaData,
    String,
    Table,
    Text,
    TypeDecorator,
    UniqueConstraint,
    literal,
    text,
)
from sqlalchemy.dialects.postgresql import JSONB

from services.domain.states import JobState, ShardState, VideoStatus


class UtcDateTime(TypeDecorator[datetime]):
    """Aware UTC times: `timestamptz` in PostgreSQL, text of fixed width (so that it sorts) in SQLite."""

    impl = DateTime(timezone=True)
    cache_ok = True

    def process_bind_param(self, value: datetime | None, dialect: Dialect) -> datetime | None:
        if value is None:
            return None
        utc = value.astimezone(UTC)
        return utc.replace(tzinfo=None) if dialect.name == "sqlite" else utc

    def process_result_value(self, value: datetime | None, dialect: Dialect) -> datetime | None:
        if value is None:
            return None
        return value.replace(tzinfo=UTC) if value.tzinfo is None else value.astimezone(UTC)


Json = JSON().with_variant(JSONB(), "postgresql")

# SQLite numbers rows by itself only in a column declared INTEGER.
Sequence = BigInteger().with_variant(Integer(), "sqlite")

metadata = MetaData(
    naming_convention={
        "ix": "ix_%(table_name)s_%(column_0_N_name)s",
        "uq": "uq_%(table_name)s_%(column_0_N_name)s",
        "ck": "ck_%(table_name)s_%(constraint_name)s",
        "fk": "fk_%(table_name)s_%(column_0_name)s_%(referred_table_name)s",
        "pk": "pk_%(table_name)s",
    }
)


def _one_of(column: str, values: type[StrEnum]) -> CheckConstraint:
    names = ", ".join(f"'{value}'" for value in values)
    return CheckConstraint(f"{column} IN ({names})", name=column)


def in_state(column: ColumnElement[str], state: StrEnum) -> ColumnElement[bool]:
    """Compare with the state as a literal: with a bound value the planner could not use an index on that state only."""
    return column == literal(state.value, literal_execute=True)


def _count(name: str) -> Column[int]:
    return Column(name, BigInteger, nullable=False, server_default=text("0"))


jobs = Table(
    "jobs",
    metadata,
    Column("id", String(40), primary_key=True),
    Column("tenant", String(64), nullable=False),
    Column("spec", Json, nullable=False),
    Column("output", Text, nullable=False),
    Column("create_once", Boolean),  # whether the output decides between two writers; NULL until it was probed
    Column("state", String(32), nullable=False),
    Column("planned", Boolean, nullable=False, server_default=text("false")),
    # Who plans it, until when.
    Column("planning_fence", BigInteger, nullable=False, server_default=text("0")),
    Column("planning_holder", String(255)),
    Column("planning_expires_at", UtcDateTime),
    # Failures in a row to plan or to finalise it, since when, and when it has its next turn.
    Column("failures", Integer, nullable=False, server_default=text("0")),
    Column("failing_since", UtcDateTime),
    Column("not_before", UtcDateTime),
    Column("error_code", String(64)),
    Column("error_message", Text),
    Column("created_at", UtcDateTime, nullable=False),
    Column("updated_at", UtcDateTime, nullable=False),
    Column("started_at", UtcDateTime),
    Column("finished_at", UtcDateTime),
    Column("swept", Boolean, nullable=False, server_default=text("false")),  # its output is rid of rubbish
    # How it is run; see `services.domain.control`.
    Column("priority", Integer, nullable=False, server_default=text("0")),
    Column("deadline", UtcDateTime),
    Column("max_slot_seconds", Float),
    Column("max_failure_ratio", Float),
    Column("failure_window", Integer, nullable=False, server_default=text("200")),
    Column("failures_since", UtcDateTime),  # what was settled before does not count as failing any more
    Column("webhook_url", Text),
    Column("webhook_secret", String(128)),
    Column("pause_reason", String(32)),
    Column("pause_message", Text),
    Column("slot_seconds", Float, nullable=False, server_default=text("0")),  # of leases that have ended
    Column("retries", Integer, nullable=False, server_default=text("0")),
    # Counters, kept by the transactions that change what they count.
    _count("shards_total"),
    _count("shards_committed"),
    _count("videos_total"),
    _count("videos_succeeded"),
    _count("videos_failed"),
    _count("videos_quarantined"),
    _count("frames_committed"),
    _one_of("state", JobState),
    Index("ix_jobs_state_id", "state", "id"),
    Index("ix_jobs_tenant_id", "tenant", "id"),
    Index("ix_jobs_unswept", "id", sqlite_where=text("swept = 0"), postgresql_where=text("NOT swept")),
    # An output belongs to one job; one that ended before it had shards has left no trace in it.
    Index(
        "uq_jobs_output_owner",
        "output",
        unique=True,
        sqlite_where=text("state NOT IN ('failed', 'cancelled') OR shards_total > 0"),
        postgresql_where=text("state NOT IN ('failed', 'cancelled') OR shards_total > 0"),
    ),
)

tenants = Table(
    "tenants",
    metadata,
    Column("name", String(64), primary_key=True),
    Column("own_limits", Boolean, nullable=False, server_default=text("false")),
    Column("weight", Float, nullable=False, server_default=text("1")),
    Column("max_slots", Integer),
    Column("max_jobs", Integer),
    Column("max_videos", Integer),
    Column("served_at", UtcDateTime),  # when it got its last lease
)

idempotency_keys = Table(
    "idempotency_keys",
    metadata,
    Column("tenant", String(64), primary_key=True),
    Column("key", String(255), primary_key=True),
    Column("request_hash", String(64), nullable=False),
    Column("answer", Json, nullable=False),
    Column("created_at", UtcDateTime, nullable=False),
    Index("ix_idempotency_keys_created_at", "created_at"),
)

api_keys = Table(
    "api_keys",
    metadata,
    Column("id", String(16), primary_key=True),
    Column("tenant", String(64), nullable=False),
    Column("name", String(200), nullable=False),
    Column("hash", String(255), nullable=False),
    Column("scopes", Json, nullable=False),
    Column("created_at", UtcDateTime, nullable=False),
    Column("expires_at", UtcDateTime),
    Column("revoked_at", UtcDateTime),
    Column("last_used_at", UtcDateTime),
    Index("ix_api_keys_tenant_id", "tenant", "id"),
)

audit = Table(
    "audit",
    metadata,
    Column("seq", Sequence, primary_key=True, autoincrement=True),
    Column("at", UtcDateTime, nullable=False),
    Column("tenant", String(64)),  # none where nobody's key was refused
    Column("key_id", String(64)),
    Column("address", String(64), nullable=False),
    Column("request_id", String(128), nullable=False),
    Column("action", String(200), nullable=False),
    Column("object", Text, nullable=False),
    Column("status", Integer, nullable=False),
    Column("code", String(64)),
    Column("count", Integer, nullable=False),
    Index("ix_audit_tenant_seq", "tenant", "seq"),
    sqlite_autoincrement=True,
)

shards = Table(
    "shards",
    metadata,
    Column("id", String(64), primary_key=True),
    Column("job_id", ForeignKey("jobs.id", ondelete="CASCADE"), nullable=False),
    Column("ordinal", Integer, nullable=False),
    Column("state", String(16), nullable=False),
    Column("plan_hash", String(64), nullable=False),
    Column("num_videos", Integer, nullable=False),
    Column("input_bytes", BigInteger, nullable=False),
    # The lease, and what its holder reported last.
    Column("attempts", Integer, nullable=False, server_default=text("0")),
    Column("fence", BigInteger, nullable=False, server_default=text("0")),
    Column("holder", String(255)),
    Column("leased_at", UtcDateTime),
    Column("renewed_at", UtcDateTime),
    Column("lease_expires_at", UtcDateTime),
    Column("not_before", UtcDateTime),  # a shard that was given back waits until then
    Column("video_key", String(128)),
    Column("stage", String(64)),
    _count("videos_done"),
    _count("frames_done"),
    Column("frames_expected", BigInteger),
    # The commit.
    Column("tar_name", String(255)),
    Column("committed_at", UtcDateTime),
    Column("record", Text),  # decided here and not known to lie in the output; see `services.store.commits`
    Column("record_sha256", String(64)),
    Column("videos_lost", Integer, nullable=False, server_default=text("0")),  # failed and quarantined ones in it
    Column("retry", Integer, nullable=False, server_default=text("0")),  # which retry of the job made it
    _one_of("state", ShardState),
    UniqueConstraint("job_id", "ordinal"),
    Index("ix_shards_job_id_state_ordinal", "job_id", "state", "ordinal"),
    Index(
        "ix_shards_committed",
        "job_id",
        "committed_at",
        sqlite_where=text("state = 'committed'"),
        postgresql_where=text("state = 'committed'"),
    ),
    Index(
        "ix_shards_waiting",
        "job_id",
        "not_before",
        sqlite_where=text("state = 'pending'"),
        postgresql_where=text("state = 'pending'"),
    ),
    Index(
        "ix_shards_expiring",
        "lease_expires_at",
        sqlite_where=text("state = 'leased'"),
        postgresql_where=text("state = 'leased'"),
    ),
)

tar_names = Table(
    "tar_names",
    metadata,
    Column("job_id", ForeignKey("jobs.id", ondelete="CASCADE"), primary_key=True),
    Column("name", String(255), primary_key=True),
    Column("shard_id", String(64), nullable=False),
    Column("fence", BigInteger, nullable=False),
)

videos = Table(
    "videos",
    metadata,
    Column("job_id", ForeignKey("jobs.id", ondelete="CASCADE"), primary_key=True),
    Column("key", String(128), primary_key=True),
    Column("shard_id", ForeignKey("shards.id", ondelete="CASCADE"), nullable=False),
    Column("position", Integer, nullable=False),
    Column("uri", Text, nullable=False),
    Column("size_bytes", BigInteger, nullable=False),
    Column("etag", Text),
    Column("status", String(16), nullable=False),
    Column("deaths", Integer, nullable=False, server_default=text("0")),
    Column("death_log", Json),  # what is known of each of them
    Column("error_code", String(64)),
    Column("result", Json),
    _one_of("status", VideoStatus),
    UniqueConstraint("shard_id", "position"),
    Index("ix_videos_job_id_status_key", "job_id", "status", "key"),
    Index("ix_videos_job_id_error_code_key", "job_id", "error_code", "key"),
)

events = Table(
    "events",
    metadata,
    Column("seq", Sequence, primary_key=True, autoincrement=True),
    Column("job_id", ForeignKey("jobs.id", ondelete="CASCADE"), nullable=False),
    Column("at", UtcDateTime, nullable=False),
    Column("kind", String(64), nullable=False),
    Column("data", Json, nullable=False),
    Index("ix_events_job_id_seq", "job_id", "seq"),
    sqlite_autoincrement=True,
)

# Events that a webhook was not told about yet: written with the event, so neither is lost without the other.
webhook_deliveries = Table(
    "webhook_deliveries",
    metadata,
    Column("event_seq", ForeignKey("events.seq", ondelete="CASCADE"), primary_key=True, autoincrement=False),
    Column("job_id", ForeignKey("jobs.id", ondelete="CASCADE"), nullable=False),
    Column("attempts", Integer, nullable=False, server_default=text("0")),
    Column("next_at", UtcDateTime),  # when it is sent (again); none once it was taken or given up
    Column("delivered_at", UtcDateTime),
    Column("last_error", Text),
    Index("ix_webhook_deliveries_job_id", "job_id"),
    Index(
        "ix_webhook_deliveries_due",
        "next_at",
        sqlite_where=text("next_at IS NOT NULL"),
        postgresql_where=text("next_at IS NOT NULL"),
    ),
)
