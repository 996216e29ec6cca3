"""Requests that are repeated under one key: the answer is kept in the transaction that did what was asked.

So a key is known if and only if its request had an effect, whatever crashes when: a request that was refused leaves
nothing behind, and one that was done cannot be done again.
"""

from __future__ import annotations

from datetime import timedelta
from typing import Any

from sqlalchemy import delete, func, insert, select

from services.domain.errors import IdempotencyConflict, IdempotencyInFlight
from services.store.database import Tx
from services.store.schema import idempotency_keys

KEPT = timedelta(days=7)


def hold(tx: Tx, tenant: str, key: str) -> None:
    """Keep others from working on a request with this key until the transaction ends.

    In SQLite there is nothing to do: one transaction writes at a time.

    Raises:
        IdempotencyInFlight: Another transaction works on one.
    """
    if tx.conn.dialect.name == "postgresql":
        lock = select(func.pg_try_advisory_xact_lock(func.hashtextextended(f"idempotency {tenant} {key}", 0)))
        if not tx.run(lock).scalar_one():
            raise in_flight(key)


def answer_of(tx: Tx, tenant: str, key: str, request_hash: str) -> dict[str, Any] | None:
    """What was answered to this request before; None if it is new.

    Raises:
        IdempotencyConflict: The key was used with another request.
    """
    tx.run(delete(idempotency_keys).where(idempotency_keys.c.created_at < tx.now - KEPT))
    c = idempotency_keys.c
    known = tx.first(select(c.request_hash, c.answer).where(c.tenant == tenant, c.key == key))
    if known is None:
        return None
    if known.request_hash != request_hash:
        raise IdempotencyConflict(f"Idempotency-Key {key!r} was used with another request; use a new key")
    answer: dict[str, Any] = known.answer
    return answer


def keep_answer(tx: Tx, tenant: str, key: str, request_hash: str, answer: dict[str, Any]) -> None:
    """Remember what this request is answered with."""
    named = {"tenant": tenant, "key": key, "request_hash": request_hash, "answer": answer}
    tx.run(insert(idempotency_keys).values(created_at=tx.now, **named))


def in_flight(key: str) -> IdempotencyInFlight:
    return IdempotencyInFlight(f"a request with Idempotency-Key {key!r} is being worked on; ask again in a moment")
