"""Engine and transactions: here, and only here, is what differs between SQLite and PostgreSQL."""

from __future__ import annotations

import itertools
import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeVar

from sqlalchemy import (
    ColumnElement,
    Connection,
    CursorResult,
    Engine,
    Executable,
    Row,
    create_engine,
    event,
    func,
    insert,
    literal,
    literal_column,
    make_url,
    select,
    text,
)
from sqlalchemy.exc import DBAPIError, InterfaceError, OperationalError
from sqlalchemy.exc import TimeoutError as PoolTimeout

from services.domain.errors import StoreUnavailable
from services.domain.events import EventKind
from services.store import schema

_log = logging.getLogger(__name__)
_T = TypeVar("_T")

_SQLITE_PATIENCE_MS = 30_000
_SQLITE_CACHE_KIB = 256
_WRITE = "vipe_write"
_SCHEMA = "vipe_schema"
# PostgreSQL asks for these transactions to be run again: serialization failure, deadlock.
_RETRYABLE_SQLSTATES = {"40001", "40P01"}
_MAX_ATTEMPTS = 5


@dataclass(slots=True)
class Tx:
    """One transaction, with the database's time at its start.

    Events are kept and written as the last statements, under a lock per job that is held until the commit: sequence
    numbers of a job then become visible in order, so a reader that pages by number never misses one. Being last,
    the lock cannot be part of a deadlock.
    """

    conn: Connection
    now: datetime
    _events: list[dict[str, Any]] = field(default_factory=list)

    def run(self, statement: Executable, parameters: list[dict[str, Any]] | None = None) -> CursorResult[Any]:
        result: CursorResult[Any] = (
            self.conn.execute(statement) if parameters is None else self.conn.execute(statement, parameters)
        )
        return result

    def rows(self, statement: Executable) -> list[Row[Any]]:
        return list(self.run(statement))

    def first(self, statement: Executable) -> Row[Any] | None:
        return self.run(statement).first()

    def emit(self, job_id: str, kind: EventKind, **data: Any) -> None:
        self._events.append({"job_id": job_id, "kind": kind.value, "at": self.now, "data": data})

    def flush_events(self) -> None:
        if not self._events:
            return
        if self.conn.dialect.name == "postgresql":
            for job_id in sorted({e["job_id"] for e in self._events}):
                self.conn.execute(select(func.pg_advisory_xact_lock(func.hashtextextended(job_id, 0))))
        for of_jobs, batch in itertools.groupby(self._events, key=lambda e: e["kind"].startswith("job.")):
            if of_jobs:
                for each in batch:
                    self._write_job_event(each)
            else:
                self.conn.execute(insert(schema.events), list(batch))
        self._events.clear()

    def _write_job_event(self, values: dict[str, Any]) -> None:
        """Write an event together with its delivery, where the job has a webhook: neither exists without the other."""
        seq = self.conn.execute(insert(schema.events).values(**values).returning(schema.events.c.seq)).scalar_one()
        jobs, deliveries = schema.jobs.c, schema.webhook_deliveries
        due = select(literal(seq), jobs.id, literal(self.now, schema.UtcDateTime())).where(
            jobs.id == values["job_id"], jobs.webhook_url.is_not(None)
        )
        self.conn.execute(insert(deliveries).from_select(["event_seq", "job_id", "next_at"], due))


class Database:
    """Opens a database by its SQLAlchemy URL and runs transactions in it. Thread-safe.

    Args:
        url: `sqlite:////path/to/file.db` (a local disk: its write-ahead log does not work over network file systems)
            or `postgresql://user@host/name`.
    """

    def __init__(self, url: str) -> None:
        parsed = make_url(url)
        self.dialect = parsed.get_backend_name()
        self._writer = threading.Lock()
        if self.dialect == "sqlite":
            if not parsed.database or parsed.database == ":memory:":
                raise ValueError("the store needs a file: use sqlite:////absolute/path/vipe.db")
            Path(parsed.database).parent.mkdir(parents=True, exist_ok=True)
            self.engine = create_engine(parsed, pool_size=8, max_overflow=56)
            _prepare_sqlite(self.engine)
        elif self.dialect == "postgresql":
            if parsed.drivername == "postgresql":
                parsed = parsed.set(drivername="postgresql+psycopg")
            self.engine = create_engine(parsed, pool_size=8, max_overflow=24, pool_pre_ping=True)
        else:
            raise ValueError(f"database {self.dialect!r} is not supported: use sqlite or postgresql")

    def read(self, work: Callable[[Tx], _T]) -> _T:
        """Run a read-only transaction that sees one state of the database from start to end."""
        try:
            with self.engine.connect() as conn:
                if self.dialect == "postgresql":
                    conn = conn.execution_options(isolation_level="REPEATABLE READ", postgresql_readonly=True)
                with conn.begin():
                    return work(Tx(conn, self._now(conn)))
        except (OperationalError, InterfaceError, PoolTimeout) as error:
            raise _unavailable(error) from error

    def write(self, work: Callable[[Tx], _T]) -> _T:
        """Run a transaction that writes; `work` may run again after a deadlock, so it must not touch anything else."""
        for attempt in range(1, _MAX_ATTEMPTS + 1):
            try:
                return self._write_once(work)
            except (OperationalError, InterfaceError, PoolTimeout) as error:
                if attempt == _MAX_ATTEMPTS or _sqlstate(error) not in _RETRYABLE_SQLSTATES:
                    raise _unavailable(error) from error
                _log.info("transaction runs again after %s", _sqlstate(error))
                time.sleep(0.01 * attempt)
        raise AssertionError("unreachable")

    def change_schema(self, work: Callable[[Tx], None]) -> None:
        """Run a transaction that may replace tables.

        SQLite cannot change a constraint, so the table is made anew; with foreign keys on, dropping the old one would
        delete every row that refers to it. They are off meanwhile, and checked before the commit.
        """

        def checked(tx: Tx) -> None:
            work(tx)
            if self.dialect == "sqlite" and (broken := tx.first(text("PRAGMA foreign_key_check"))) is not None:
                raise RuntimeError(f"the migration left a row without the row that it refers to: {tuple(broken)}")

        try:
            self._write_once(checked, **{_SCHEMA: True})
        except (OperationalError, InterfaceError, PoolTimeout) as error:
            raise _unavailable(error) from error

    def close(self) -> None:
        self.engine.dispose()

    def _write_once(self, work: Callable[[Tx], _T], **options: bool) -> _T:
        writing = {_WRITE: True, **options}
        with self._turn(), self.engine.connect().execution_options(**writing) as conn, conn.begin():
            tx = Tx(conn, self._now(conn))
            result = work(tx)
            tx.flush_events()
            return result

    @contextmanager
    def _turn(self) -> Iterator[None]:
        """SQLite lets one transaction write; who waits for it sleeps and looks again, and some never get their turn.

        Threads of this process therefore queue here, and only processes meet in the file.
        """
        if self.dialect != "sqlite":
            yield
            return
        if not self._writer.acquire(timeout=_SQLITE_PATIENCE_MS / 1e3):
            raise StoreUnavailable("the database does not answer (others have been writing for too long); try again")
        try:
            yield
        finally:
            self._writer.release()

    def _now(self, conn: Connection) -> datetime:
        if self.dialect == "sqlite":
            clock: ColumnElement[str] = literal_column("strftime('%Y-%m-%d %H:%M:%f', 'now')")
            return datetime.fromisoformat(conn.execute(select(clock)).scalar_one()).replace(tzinfo=UTC)
        moment: datetime = conn.execute(select(func.clock_timestamp())).scalar_one()
        return moment.astimezone(UTC)


def _prepare_sqlite(engine: Engine) -> None:
    @event.listens_for(engine, "connect")
    def on_connect(dbapi_connection: Any, _record: Any) -> None:
        # We begin transactions ourselves: the driver's own begin comes too late for BEGIN IMMEDIATE and skips DDL.
        dbapi_connection.isolation_level = None
        cursor = dbapi_connection.cursor()
        for pragma in (
            f"busy_timeout = {_SQLITE_PATIENCE_MS}",
            "journal_mode = WAL",
            "synchronous = NORMAL",
            # Each connection has a cache of its own, and the system caches the file for all of them.
            f"cache_size = -{_SQLITE_CACHE_KIB}",
        ):
            cursor.execute(f"PRAGMA {pragma}")
        cursor.close()

    @event.listens_for(engine, "begin")
    def on_begin(conn: Connection) -> None:
        options = conn.get_execution_options()
        # This pragma does nothing inside of a transaction, so every transaction sets it to what it needs.
        conn.exec_driver_sql(f"PRAGMA foreign_keys = {'OFF' if options.get(_SCHEMA) else 'ON'}")
        # A writer that starts as a reader and is overtaken fails at once, without waiting: so it locks from the start.
        conn.exec_driver_sql("BEGIN IMMEDIATE" if options.get(_WRITE) else "BEGIN")


def _sqlstate(error: Exception) -> str | None:
    return getattr(error.orig, "sqlstate", None) if isinstance(error, DBAPIError) else None


def _unavailable(error: Exception) -> StoreUnavailable:
    cause = str(error.orig) if isinstance(error, DBAPIError) else str(error)
    reason = next(iter(cause.strip().splitlines()), type(error).__name__)
    return StoreUnavailable(f"the database does not answer ({reason}); try again")
