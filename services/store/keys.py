"""API keys: created, looked up by their public id, revoked. Never the key itself, only its hash."""

from __future__ import annotations

from datetime import timedelta
from typing import Any

from sqlalchemy import Row, insert, select, update

from services.domain.access import ApiKey, Scope
from services.domain.errors import KeyNotFound
from services.store.database import Tx
from services.store.schema import api_keys

# `last_used_at` is for people who tidy up; a write per request would be a price for nothing.
_LAST_USED_TICK = timedelta(minutes=1)


def create(
    tx: Tx, key_id: str, key_hash: str, tenant: str, name: str, scopes: frozenset[Scope], expires_in_s: float | None
) -> None:
    """See `Store.create_key`."""
    expires_at = None if expires_in_s is None else tx.now + timedelta(seconds=expires_in_s)
    named = {"id": key_id, "tenant": tenant, "name": name, "scopes": sorted(scopes), "expires_at": expires_at}
    tx.run(insert(api_keys).values(hash=key_hash, created_at=tx.now, **named))


def get(tx: Tx, key_id: str, tenant: str | None = None) -> ApiKey:
    """See `Store.get_key`."""
    row = _find(tx, key_id)
    if row is None or (tenant is not None and row.tenant != tenant):
        raise KeyNotFound(f"there is no key {key_id!r}")
    return _key(row)


def find(tx: Tx, key_id: str) -> tuple[ApiKey, str, bool] | None:
    """See `Store.find_key`."""
    row = _find(tx, key_id)
    if row is None:
        return None
    valid = row.revoked_at is None and (row.expires_at is None or row.expires_at > tx.now)
    return _key(row), row.hash, valid


def list_all(tx: Tx, tenant: str | None, limit: int, after: str | None) -> tuple[list[ApiKey], str | None]:
    """See `Store.list_keys`."""
    query = select(api_keys).order_by(api_keys.c.id).limit(limit + 1)
    if tenant is not None:
        query = query.where(api_keys.c.tenant == tenant)
    if after is not None:
        query = query.where(api_keys.c.id > after)
    rows = tx.rows(query)
    return [_key(row) for row in rows[:limit]], rows[limit - 1].id if len(rows) > limit else None


def revoke(tx: Tx, key_id: str, tenant: str | None) -> None:
    """See `Store.revoke_key`."""
    if get(tx, key_id, tenant).revoked_at is None:
        still_valid = update(api_keys).where(api_keys.c.id == key_id, api_keys.c.revoked_at.is_(None))
        tx.run(still_valid.values(revoked_at=tx.now))


def touch(tx: Tx, key_id: str) -> None:
    """See `Store.touch_key`."""
    row = _find(tx, key_id)
    if row is not None and (row.last_used_at is None or row.last_used_at < tx.now - _LAST_USED_TICK):
        tx.run(update(api_keys).where(api_keys.c.id == key_id).values(last_used_at=tx.now))


def _find(tx: Tx, key_id: str) -> Row[Any] | None:
    return tx.first(select(api_keys).where(api_keys.c.id == key_id))


def _key(row: Row[Any]) -> ApiKey:
    return ApiKey(
        id=row.id,
        tenant=row.tenant,
        name=row.name,
        scopes=frozenset(Scope(scope) for scope in row.scopes),
        created_at=row.created_at,
        expires_at=row.expires_at,
        revoked_at=row.revoked_at,
        last_used_at=row.last_used_at,
    )
