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
    from services.store.database import Database, Tx

# Processes that start together upgrade one after the other.
_LOCK = 0x76697065


def upgrade(database: Database, revision: str = "head") -> None:
    """Bring the schema to a revision in one transaction. Safe to call from many processes at once.

    Raises:
        StoreUnavailable: The database does not answer.
    """

    def work(tx: Tx) -> None:
        if database.dialect == "postgresql":
            tx.run(select(func.pg_advisory_xact_lock(_LOCK)))
        config = _config()
        config.attributes["connection"] = tx.conn
        command.upgrade(config, revision)

    database.change_schema(work)


def current(database: Database) -> str | None:
    """The revision that the database is at, None for an empty one."""
    return database.read(lambda tx: MigrationContext.configure(tx.conn).get_current_revision())


def head() -> str | None:
    """The newest revision in this package."""
    return ScriptDirectory.from_config(_config()).get_current_head()


def _config() -> Config:
    config = Config()
    config.set_main_option("script_location", str(Path(__file__).parent).replace("%", "%%"))
    return config
