"""Schema migrations, shipped in the package and run without a configuration file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from alembic import command
from alembic.config import Config
from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import func, select

if TYPE_CHECKING:
    from services.store.database import Database

# Processes that start together upgrade one after the other.
_LOCK = 0x76697065


def upgrade(database: Database, revision: str = "head") -> None:
    """Bring the schema to a revision in one transaction. Safe to call from many processes at once."""

    config = Config()
    config.set_main_option("script_location", str(Path(__file__).parent).replace("%", "%%"))
    with database.engine.connect().execution_options(vipe_write=True) as conn, conn.begin():
        if database.dialect == "postgresql":
            conn.execute(select(func.pg_advisory_xact_lock(_LOCK)))
        config.attributes["connection"] = conn
        command.upgrade(config, revision)


def current(database: Database) -> str | None:
    """The revision that the database is at, None for an empty one."""
    with database.engine.connect() as conn:
        return MigrationContext.configure(conn).get_current_revision()


def head() -> str | None:
    """The newest revision in this package."""
    config = Config()
    config.set_main_option("script_location", str(Path(__file__).parent).replace("%", "%%"))
    return ScriptDirectory.from_config(config).get_current_head()
