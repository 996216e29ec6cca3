"""The database can be the commit point, knows the digest of every record, and why each worker died."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects.postgresql import JSONB

revision = "0003"
down_revision = "0002"

_JSON = sa.JSON().with_variant(JSONB(), "postgresql")


def upgrade() -> None:
    op.add_column("jobs", sa.Column("create_once", sa.Boolean(), nullable=True))
    op.add_column("shards", sa.Column("record", sa.Text(), nullable=True))
    op.add_column("shards", sa.Column("record_sha256", sa.String(length=64), nullable=True))
    op.add_column("videos", sa.Column("death_log", _JSON, nullable=True))
    op.create_table(
        "tar_names",
        sa.Column("job_id", sa.String(length=40), nullable=False),
        sa.Column("name", sa.String(length=255), nullable=False),
        sa.Column("shard_id", sa.String(length=64), nullable=False),
        sa.Column("fence", sa.BigInteger(), nullable=False),
        sa.ForeignKeyConstraint(["job_id"], ["jobs.id"], name=op.f("fk_tar_names_job_id_jobs"), ondelete="CASCADE"),
        sa.PrimaryKeyConstraint("job_id", "name", name=op.f("pk_tar_names")),
    )


def downgrade() -> None:
    op.drop_table("tar_names")
    for table, column in (
        ("videos", "death_log"),
        ("shards", "record_sha256"),
        ("shards", "record"),
        ("jobs", "create_once"),
    ):
        op.drop_column(table, column)
