"""The migrations give the schema that the code uses, on an empty database, once, also when many start at once."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path

import pytest
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from sqlalchemy import inspect, text
from store_helpers import planned_job

from services.domain.errors import StoreUnavailable
from services.store import migrations
from services.store.database import Database
from services.store.schema import metadata
from services.store.sql import SqlStore, open_when_ready


def _indexes(database: Database) -> set[str]:
    """All indexes with their conditions, which Alembic does not compare."""
    found = inspect(database.engine)
    return {
        f"{index['name']} {index['column_names']} {index['unique']} "
        + " ".join(f"{name}={value}" for name, value in sorted(index.get("dialect_options", {}).items()))
        for table in metadata.tables
        for index in found.get_indexes(table)
    }


def test_the_migrated_schema_is_the_codes(new_store_url: Callable[[], str]) -> None:
    database, created = Database(new_store_url()), Database(new_store_url())
    created.write(lambda tx: metadata.create_all(tx.conn))
    assert migrations.current(database) is None
    migrations.upgrade(database)
    assert migrations.current(database) == migrations.head()
    with database.engine.connect() as conn:
        context = MigrationContext.configure(conn, opts={"compare_type": True})
        assert compare_metadata(context, metadata) == []
        checks = {c["name"] for table in metadata.tables for c in inspect(conn).get_check_constraints(table)}
    assert checks == {"ck_jobs_state", "ck_shards_state", "ck_videos_status"}
    assert _indexes(database) == _indexes(created)
    assert sum("where=" in index for index in _indexes(database)) == 6
    database.close()
    created.close()


def test_upgrading_keeps_what_is_there(store_url: str) -> None:
    store = SqlStore(store_url)
    job_id = planned_job(store)
    store.upgrade()
    assert store.get_job(job_id).progress.shards_total == 3
    store.close()


def test_jobs_of_the_first_release_are_still_there(store_url: str) -> None:
    database = Database(store_url)
    migrations.upgrade(database, "0001")
    row = {"id": "job_1", "tenant": "default", "output": "/out", "state": "queued", "spec": '{"inputs": ["/in"]}'}
    with database.engine.begin() as conn:
        names = ", ".join([*row, "created_at", "updated_at"])
        values = ", ".join([*(f":{name}" for name in row), "CURRENT_TIMESTAMP", "CURRENT_TIMESTAMP"])
        conn.execute(text(f"INSERT INTO jobs ({names}) VALUES ({values})"), row)
        used = "INSERT INTO idempotency_keys VALUES ('default', 'k', 'hash', 'job_1', CURRENT_TIMESTAMP)"
        conn.execute(text(used))
    migrations.upgrade(database)
    with database.engine.connect() as conn:
        assert conn.execute(text("SELECT id FROM jobs")).scalars().all() == ["job_1"]
    database.close()


def test_many_processes_start_at_once(store_url: str) -> None:
    errors: list[Exception] = []

    def start() -> None:
        try:
            SqlStore(store_url).close()
        except Exception as error:
            errors.append(error)

    threads = [threading.Thread(target=start) for _ in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert errors == []


def test_the_states_are_checked_by_the_database_too(store: SqlStore, store_url: str) -> None:
    job_id = planned_job(store)
    database = Database(store_url)
    with pytest.raises(Exception, match="ck_jobs_state"), database.engine.begin() as conn:
        conn.execute(text("UPDATE jobs SET state = 'bored' WHERE id = :id"), {"id": job_id})
    database.close()


def test_sqlite_is_opened_for_many_processes(tmp_path: Path) -> None:
    database = Database(f"sqlite:///{tmp_path}/new/folder/store.db")
    with database.engine.connect() as conn:
        pragmas = {name: conn.execute(text(f"PRAGMA {name}")).scalar_one() for name in ("journal_mode", "foreign_keys")}
        assert pragmas == {"journal_mode": "wal", "foreign_keys": 1}
        assert conn.execute(text("PRAGMA busy_timeout")).scalar_one() >= 10_000
    database.close()


@pytest.mark.parametrize("url", ["sqlite://", "sqlite:///:memory:", "mysql://host/db"])
def test_addresses_that_are_not_supported(url: str) -> None:
    with pytest.raises(ValueError, match="sqlite"):
        Database(url)


@pytest.mark.parametrize("url", ["sqlite:///{tmp}", "postgresql://127.0.0.1:9/nothing"])
def test_a_database_that_does_not_answer(tmp_path: Path, url: str) -> None:
    with pytest.raises(StoreUnavailable, match="does not answer"):
        SqlStore(url.format(tmp=tmp_path))


def test_a_database_that_comes_up_late_is_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    url, tries = f"sqlite:///{tmp_path}/late.db", []
    upgrade = SqlStore.upgrade

    def late(store: SqlStore) -> None:
        tries.append(1)
        if len(tries) < 3:
            raise StoreUnavailable("the database is starting up")
        upgrade(store)

    monkeypatch.setattr(SqlStore, "upgrade", late)
    monkeypatch.setattr("services.store.sql.time.sleep", lambda seconds: None)
    store = open_when_ready(url)
    store.ping()
    store.close()
    tries.clear()
    with pytest.raises(StoreUnavailable):
        open_when_ready(url, patience_s=0.0)


def test_two_stores_share_nothing(new_store_url: Callable[[], str]) -> None:
    first, second = SqlStore(new_store_url()), SqlStore(new_store_url())
    planned_job(first)
    assert second.list_jobs() == ([], None)
    first.close()
    second.close()
