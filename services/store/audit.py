"""The audit trail: rows are added and read, never changed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, fields
from typing import Any

from sqlalchemy import Row, insert, or_, select

from services.domain.access import DEFAULT_TENANT, AuditEntry, AuditEvent
from services.domain.errors import InvalidPageToken
from services.store.database import Tx
from services.store.schema import audit

_FIELDS = [field.name for field in fields(AuditEntry)]


def record(tx: Tx, entries: Sequence[AuditEntry]) -> None:
    """See `Store.record_audit`."""
    tx.run(insert(audit), [{"at": tx.now, **asdict(entry)} for entry in entries])


def read(tx: Tx, tenant: str, limit: int, after: str | None) -> tuple[list[AuditEvent], str | None]:
    """See `Store.audit`."""
    mine = audit.c.tenant == tenant
    if tenant == DEFAULT_TENANT:
        mine = or_(mine, audit.c.tenant.is_(None))
    query = select(audit).where(mine).order_by(audit.c.seq.desc()).limit(limit + 1)
    if after is not None:
        if not after.isascii() or not after.isdigit() or len(after) > 18:
            raise InvalidPageToken("this page token was not given out for the audit trail")
        query = query.where(audit.c.seq < int(after))
    rows = tx.rows(query)
    return [_event(row) for row in rows[:limit]], str(rows[limit - 1].seq) if len(rows) > limit else None


def _event(row: Row[Any]) -> AuditEvent:
    return AuditEvent(row.seq, row.at, AuditEntry(**{name: getattr(row, name) for name in _FIELDS}))
