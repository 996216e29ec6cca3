"""Transitions of webhook deliveries: taken to be sent, taken by the receiver, sent again later, given up.

A delivery is written with its event (see `Tx.flush_events`). Whoever takes one to send it pushes its next turn back; if
he dies, the turn comes and somebody else sends it. So every event arrives at least once, from one sender at a time.
"""

from __future__ import annotations

import json
from datetime import timedelta

from sqlalchemy import func, select, update

from services.domain.control import Delivery
from services.domain.events import EventKind
from services.store.database import Tx
from services.store.jobs import lock_job
from services.store.schema import events, jobs, webhook_deliveries

_d = webhook_deliveries.c


def take(tx: Tx, limit: int, ttl_s: float) -> list[Delivery]:
    """See `Store.take_deliveries`."""
    due = select(_d.event_seq).where(_d.next_at <= tx.now).order_by(_d.next_at, _d.event_seq).limit(limit)
    chosen = list(tx.run(due.with_for_update(skip_locked=True)).scalars())
    if not chosen:
        return []
    tx.run(
        update(webhook_deliveries)
        .where(_d.event_seq.in_(chosen))
        .values(attempts=_d.attempts + 1, next_at=tx.now + timedelta(seconds=ttl_s))
    )
    found = (
        select(events, _d.attempts, jobs.c.tenant, jobs.c.webhook_url, jobs.c.webhook_secret)
        .join(webhook_deliveries, _d.event_seq == events.c.seq)
        .join(jobs, jobs.c.id == events.c.job_id)
        .where(events.c.seq.in_(chosen))
        .order_by(events.c.seq)
    )
    deliveries = []
    for row in tx.rows(found):
        if row.webhook_url is None:  # taken away since
            tx.run(update(webhook_deliveries).where(_d.event_seq == row.seq).values(next_at=None))
            continue
        message = {
            "id": f"evt_{row.seq}",
            "seq": row.seq,
            "job_id": row.job_id,
            "tenant": row.tenant,
            "at": row.at.isoformat(),
            "kind": row.kind,
            "data": row.data,
        }
        deliveries.append(
            Delivery(
                event_seq=row.seq,
                job_id=row.job_id,
                tenant=row.tenant,
                url=row.webhook_url,
                secret=row.webhook_secret,
                body=json.dumps(message, sort_keys=True).encode(),
                attempt=row.attempts,
            )
        )
    return deliveries


def settle(tx: Tx, delivery: Delivery, error: str | None, retry_in_s: float | None) -> None:
    """See `Store.settle_delivery`."""
    give_up = error is not None and retry_in_s is None
    if give_up:
        lock_job(tx, delivery.job_id)  # It writes an event.
    mine = (_d.event_seq == delivery.event_seq) & (_d.attempts == delivery.attempt) & _d.next_at.is_not(None)
    next_at = None if retry_in_s is None else tx.now + timedelta(seconds=retry_in_s)
    changed = tx.run(
        update(webhook_deliveries)
        .where(mine)
        .values(next_at=next_at, delivered_at=tx.now if error is None else None, last_error=error)
    )
    if give_up and changed.rowcount:
        tx.emit(
            delivery.job_id,
            EventKind.WEBHOOK_ABANDONED,
            event_id=delivery.event_id,
            attempts=delivery.attempt,
            error=error,
        )


def undelivered(tx: Tx) -> int:
    """How many deliveries wait."""
    return int(tx.run(select(func.count()).where(_d.next_at.is_not(None))).scalar_one())
