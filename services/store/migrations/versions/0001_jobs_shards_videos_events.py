"""Jobs, shards, videos, events."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects.postgresql import JSONB

revision = "0001"
down_revision = None

# A migration is frozen: it does not follow the types of the present schema.
_JSON = sa.JSON().with_variant(JSONB(), "postgresql")
_TIME = sa.DateTime(timezone=True)


def upgrade() -> None:
    op.create_table(
        "jobs",
        sa.Column("id", sa.String(length=40), nullable=False),
        sa.Column("tenant", sa.String(length=64), nullable=False),
        sa.Column("spec", _JSON, nullable=False),
        sa.Column("output", sa.Text(), nullable=False),
        sa.Column("state", sa.String(length=32), nullable=False),
        sa.Column("planned", sa.Boolean(), server_default=sa.text("false"), nullable=False),
        sa.Column("planning_fence", sa.BigInteger(), server_default=sa.text("0"), nullable=False),
        sa.Column("planning_holder", sa.String(length=255), nullable=True),
        sa.Column("planning_expires_at", _TIME, nullable=True),
        sa.Column("failures", sa.Integer(), server_default=sa.text("0"), nullable=False),
        sa.Column("failing_since", _TIME, nullable=True),
        sa.Column("not_before", _TIME, nullable=True),
        sa.Column("error_code", sa.String(length=64), nullable=True),
        sa.Column("error_message", sa.Text(), nullable=True),
        sa.Column("created_at", _TIME, nullable=False),
        sa.Column("updated_at", _TIME, nullable=False),
        sa.Column("started_at", _TIME, nullable=True),
        sa.Column("finished_at", _TIME, nullable=True),
        sa.Column("swept", sa.Boolean(), server_default=sa.text("false"), nullable=False),
        sa.Column("shards_total", sa.BigInteger(), server_default=sa.text("0"), nullable=False),
        sa.Column("shards_committed", sa.BigInteger(), server_default=sa.text("0"), nullable=False),
        sa.Column("videos_total", sa.BigInteger(), server_default=sa.text("0"), nullable=False),
        sa.Column("videos_succeeded", sa.BigInteger(), server_default=sa.text("0"), nullable=False),
        sa.Column("videos_failed", sa.BigInteger(), server_default=sa.text("0"), nullable=False),
        sa.Column("videos_quarantined", sa.BigInteger(), server_default=sa.text("0"), nullable=False),
        sa.Column("frames_committed", sa.BigInteger(), server_default=sa.text("0"), nullable=False),
        sa.CheckConstraint(
            "state IN ('queued', 'running', 'finalizing', 'cancelling', 'succeeded', 'succeeded_with_errors', "
            "'failed', 'cancelled')",
            name=op.f("ck_jobs_state"),
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_jobs")),
    )
    op.create_index("ix_jobs_state_id", "jobs", ["state", "id"])
    op.create_index(
        "ix_jobs_unswept",
        "jobs",
        ["id"],
        sqlite_where=sa.text("swept = 0"),
        postgresql_where=sa.text("NOT swept"),
    )
    op.create_index(
        "uq_jobs_output_owner",
        "jobs",
        ["output"],
        unique=True,
        sqlite_where=sa.text("state NOT IN ('failed', 'cancelled') OR shards_total > 0"),
        postgresql_where=sa.text("state NOT IN ('failed', 'cancelled') OR shards_total > 0"),
    )

    op.create_table(
        "events",
        sa.Column("seq", sa.BigInteger().with_variant(sa.Integer(), "sqlite"), autoincrement=True, nullable=False),
        sa.Column("job_id", sa.String(length=40), nullable=False),
        sa.Column("at", _TIME, nullable=False),
        sa.Column("kind", sa.String(length=64), nullable=False),
        sa.Column("data", _JSON, nullable=False),
        sa.ForeignKeyConstraint(["job_id"], ["jobs.id"], name=op.f("fk_events_job_id_jobs"), ondelete="CASCADE"),
        sa.PrimaryKeyConstraint("seq", name=op.f("pk_events")),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_events_job_id_seq", "events", ["job_id", "seq"])

    op.create_table(
        "idempotency_keys",
        sa.Column("tenant", sa.String(length=64), nullable=False),
        sa.Column("key", sa.String(length=255), nullable=False),
        sa.Column("spec_hash", sa.String(length=64), nullable=False),
        sa.Column("job_id", sa.String(length=40), nullable=False),
        sa.Column("created_at", _TIME, nullable=False),
        sa.ForeignKeyConstraint(
            ["job_id"], ["jobs.id"], name=op.f("fk_idempotency_keys_job_id_jobs"), ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("tenant", "key", name=op.f("pk_idempotency_keys")),
    )
    op.create_table(
        "shards",
        sa.Column("id", sa.String(length=64), nullable=False),
        sa.Column("job_id", sa.String(length=40), nullable=False),
        sa.Column("ordinal", sa.Integer(), nullable=False),
        sa.Column("state", sa.String(length=16), nullable=False),
        sa.Column("plan_hash", sa.String(length=64), nullable=False),
        sa.Column("num_videos", sa.Integer(), nullable=False),
        sa.Column("input_bytes", sa.BigInteger(), nullable=False),
        sa.Column("attempts", sa.Integer(), server_default=sa.text("0"), nullable=False),
        sa.Column("fence", sa.BigInteger(), server_default=sa.text("0"), nullable=False),
        sa.Column("holder", sa.String(length=255), nullable=True),
        sa.Column("leased_at", _TIME, nullable=True),
        sa.Column("renewed_at", _TIME, nullable=True),
        sa.Column("lease_expires_at", _TIME, nullable=True),
        sa.Column("not_before", _TIME, nullable=True),
        sa.Column("video_key", sa.String(length=128), nullable=True),
        sa.Column("stage", sa.String(length=64), nullable=True),
        sa.Column("videos_done", sa.BigInteger(), server_default=sa.text("0"), nullable=False),
        sa.Column("frames_done", sa.BigInteger(), server_default=sa.text("0"), nullable=False),
        sa.Column("frames_expected", sa.BigInteger(), nullable=True),
        sa.Column("tar_name", sa.String(length=255), nullable=True),
        sa.Column("committed_at", _TIME, nullable=True),
        sa.CheckConstraint("state IN ('pending', 'leased', 'committed', 'cancelled')", name=op.f("ck_shards_state")),
        sa.ForeignKeyConstraint(["job_id"], ["jobs.id"], name=op.f("fk_shards_job_id_jobs"), ondelete="CASCADE"),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_shards")),
        sa.UniqueConstraint("job_id", "ordinal", name=op.f("uq_shards_job_id_ordinal")),
    )
    op.create_index(
        "ix_shards_committed",
        "shards",
        ["job_id", "committed_at"],
        sqlite_where=sa.text("state = 'committed'"),
        postgresql_where=sa.text("state = 'committed'"),
    )
    op.create_index(
        "ix_shards_expiring",
        "shards",
        ["lease_expires_at"],
        sqlite_where=sa.text("state = 'leased'"),
        postgresql_where=sa.text("state = 'leased'"),
    )
    op.create_index(
        "ix_shards_waiting",
        "shards",
        ["job_id", "not_before"],
        sqlite_where=sa.text("state = 'pending'"),
        postgresql_where=sa.text("state = 'pending'"),
    )
    op.create_index("ix_shards_job_id_state_ordinal", "shards", ["job_id", "state", "ordinal"])

    op.create_table(
        "videos",
        sa.Column("job_id", sa.String(length=40), nullable=False),
        sa.Column("key", sa.String(length=128), nullable=False),
        sa.Column("shard_id", sa.String(length=64), nullable=False),
        sa.Column("position", sa.Integer(), nullable=False),
        sa.Column("uri", sa.Text(), nullable=False),
        sa.Column("size_bytes", sa.BigInteger(), nullable=False),
        sa.Column("etag", sa.Text(), nullable=True),
        sa.Column("status", sa.String(length=16), nullable=False),
        sa.Column("deaths", sa.Integer(), server_default=sa.text("0"), nullable=False),
        sa.Column("error_code", sa.String(length=64), nullable=True),
        sa.Column("result", _JSON, nullable=True),
        sa.CheckConstraint(
            "status IN ('pending', 'succeeded', 'failed', 'quarantined')", name=op.f("ck_videos_status")
        ),
        sa.ForeignKeyConstraint(["job_id"], ["jobs.id"], name=op.f("fk_videos_job_id_jobs"), ondelete="CASCADE"),
        sa.ForeignKeyConstraint(
            ["shard_id"], ["shards.id"], name=op.f("fk_videos_shard_id_shards"), ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("job_id", "key", name=op.f("pk_videos")),
        sa.UniqueConstraint("shard_id", "position", name=op.f("uq_videos_shard_id_position")),
    )
    op.create_index("ix_videos_job_id_error_code_key", "videos", ["job_id", "error_code", "key"])
    op.create_index("ix_videos_job_id_status_key", "videos", ["job_id", "status", "key"])


def downgrade() -> None:
    for table in ("videos", "shards", "idempotency_keys", "events", "jobs"):
        op.drop_table(table)
