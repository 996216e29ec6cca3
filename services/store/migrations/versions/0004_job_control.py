"""Pause, retry, priority, limits of jobs and tenants, webhooks."""

from __future__ import annotations

from typing import Any

import sqlalchemy as sa
from alembic import op

revision = "0004"
down_revision = "0003"

_TIME = sa.DateTime(timezone=True)
_SEQUENCE = sa.BigInteger().with_variant(sa.Integer(), "sqlite")
_OLD_STATES = (
    "state IN ('queued', 'running', 'finalizing', 'cancelling', 'succeeded', 'succeeded_with_errors', "
    "'failed', 'cancelled')"
)
_STATES = _OLD_STATES.replace("'running', ", "'running', 'paused', ")


def upgrade() -> None:
    for table, columns in _columns().items():
        for column in columns:
            op.add_column(table, column)
    _replace_states(_STATES)
    op.create_table(
        "tenants",
        sa.Column("name", sa.String(length=64), nullable=False),
        sa.Column("own_limits", sa.Boolean(), server_default=sa.text("false"), nullable=False),
        sa.Column("weight", sa.Float(), server_default=sa.text("1"), nullable=False),
        sa.Column("max_slots", sa.Integer(), nullable=True),
        sa.Column("max_jobs", sa.Integer(), nullable=True),
        sa.Column("max_videos", sa.Integer(), nullable=True),
        sa.Column("served_at", _TIME, nullable=True),
        sa.PrimaryKeyConstraint("name", name=op.f("pk_tenants")),
    )
    op.execute("INSERT INTO tenants (name) SELECT DISTINCT tenant FROM jobs")
    op.create_table(
        "webhook_deliveries",
        sa.Column("event_seq", _SEQUENCE, autoincrement=False, nullable=False),
        sa.Column("job_id", sa.String(length=40), nullable=False),
        sa.Column("attempts", sa.Integer(), server_default=sa.text("0"), nullable=False),
        sa.Column("next_at", _TIME, nullable=True),
        sa.Column("delivered_at", _TIME, nullable=True),
        sa.Column("last_error", sa.Text(), nullable=True),
        sa.ForeignKeyConstraint(
            ["event_seq"], ["events.seq"], name=op.f("fk_webhook_deliveries_event_seq_events"), ondelete="CASCADE"
        ),
        sa.ForeignKeyConstraint(
            ["job_id"], ["jobs.id"], name=op.f("fk_webhook_deliveries_job_id_jobs"), ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("event_seq", name=op.f("pk_webhook_deliveries")),
    )
    op.create_index("ix_webhook_deliveries_job_id", "webhook_deliveries", ["job_id"])
    op.create_index(
        "ix_webhook_deliveries_due",
        "webhook_deliveries",
        ["next_at"],
        sqlite_where=sa.text("next_at IS NOT NULL"),
        postgresql_where=sa.text("next_at IS NOT NULL"),
    )


def downgrade() -> None:
    op.drop_table("webhook_deliveries")
    op.drop_table("tenants")
    op.execute("UPDATE jobs SET state = 'running' WHERE state = 'paused'")
    _replace_states(_OLD_STATES)
    for table, columns in _columns().items():
        for column in columns:
            op.drop_column(table, column.name)


def _replace_states(condition: str) -> None:
    """SQLite makes the table anew, which the upgrade allows for: it runs with foreign keys off."""
    name = op.f("ck_jobs_state")
    with op.batch_alter_table("jobs") as jobs:
        jobs.drop_constraint(name, type_="check")
        jobs.create_check_constraint(name, condition)


def _columns() -> dict[str, tuple[sa.Column[Any], ...]]:
    return {
        "jobs": (
            sa.Column("priority", sa.Integer(), server_default=sa.text("0"), nullable=False),
            sa.Column("deadline", _TIME, nullable=True),
            sa.Column("max_slot_seconds", sa.Float(), nullable=True),
            sa.Column("max_failure_ratio", sa.Float(), nullable=True),
            sa.Column("failure_window", sa.Integer(), server_default=sa.text("200"), nullable=False),
            sa.Column("failures_since", _TIME, nullable=True),
            sa.Column("webhook_url", sa.Text(), nullable=True),
            sa.Column("webhook_secret", sa.String(length=128), nullable=True),
            sa.Column("pause_reason", sa.String(length=32), nullable=True),
            sa.Column("pause_message", sa.Text(), nullable=True),
            sa.Column("slot_seconds", sa.Float(), server_default=sa.text("0"), nullable=False),
            sa.Column("retries", sa.Integer(), server_default=sa.text("0"), nullable=False),
        ),
        "shards": (
            sa.Column("videos_lost", sa.Integer(), server_default=sa.text("0"), nullable=False),
            sa.Column("retry", sa.Integer(), server_default=sa.text("0"), nullable=False),
        ),
    }
