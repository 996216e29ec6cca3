"""Whose shards are leased next.

Between tenants: the one with the fewest live leases for its weight, and among equals the one that got its last lease
longest ago. So tenants with work share the slots by their weights; and a tenant without a lease is served after each of
the others was served once at most, so none starves, however few slots there are.

Among the jobs of a tenant: those with shards that wait after a release come last (what is wrong with them must not keep
the slots busy), then the highest priority first, then the oldest. Within a job: in the order of its shards.

The queries read indexes of what is leased and of what is pending, job by job; their cost depends on the jobs that run
and the leases that live, not on how many shards or videos there are.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass, replace
from datetime import UTC, datetime

from sqlalchemy import exists, or_, select, update

from services.domain.control import TenantLimits
from services.domain.states import JobState, ShardState
from services.store.database import Tx
from services.store.schema import in_state, jobs, shards, tenants
from services.store.tenants import limits_of, lock_tenants, slots_in_use

_NEVER = datetime.min.replace(tzinfo=UTC)
_PENDING = in_state(shards.c.state, ShardState.PENDING)


def lock_claimable(tx: Tx, limit: int) -> list[str]:
    """Up to `limit` pending shards of running jobs, locked; those that another claim holds are left out."""
    waiting = _jobs_with_work(tx)
    if not waiting:
        return []
    rows = tx.rows(select(tenants).where(tenants.c.name.in_(sorted(waiting))))
    limits = limits_of(tx, rows)
    # Two claims at once could each think that there is room. Tenants without a limit wait for nobody.
    if capped := [name for name in sorted(limits) if limits[name].max_slots is not None]:
        limits.update(lock_tenants(tx, capped))
    in_use = slots_in_use(tx)
    turns = {row.name: _Turn(limits[row.name], in_use.get(row.name, 0), row.served_at or _NEVER) for row in rows}
    chosen: list[str] = []
    served: set[str] = set()
    while len(chosen) < limit:
        shares = _shares({name: turns[name] for name in waiting}, limit - len(chosen))
        if not shares:
            break
        for name, number in shares.items():
            got = _lock_shards(tx, waiting[name], number, chosen)
            chosen += got
            turns[name].in_use += len(got)
            if got:
                served.add(name)
            if len(got) < number:
                del waiting[name]  # Nothing more of it can be had now: what it leaves is shared anew.
    _note_service(tx, sorted(served))
    return chosen


@dataclass(slots=True)
class _Turn:
    limits: TenantLimits
    in_use: int
    served_at: datetime

    @property
    def full(self) -> bool:
        return self.limits.max_slots is not None and self.in_use >= self.limits.max_slots

    @property
    def key(self) -> tuple[float, datetime]:
        return self.in_use / self.limits.weight, self.served_at


def _shares(turns: dict[str, _Turn], number: int) -> dict[str, int]:
    """How many of `number` leases each tenant gets if all have enough shards, one lease after the other."""
    order = [(turn.key, name, replace(turn)) for name, turn in turns.items() if not turn.full]
    heapq.heapify(order)
    shares: dict[str, int] = {}
    while order and sum(shares.values()) < number:
        _, name, turn = order[0]
        shares[name] = shares.get(name, 0) + 1
        turn.in_use += 1
        if turn.full:
            heapq.heappop(order)
        else:
            heapq.heapreplace(order, (turn.key, name, turn))
    return shares


def _jobs_with_work(tx: Tx) -> dict[str, list[str]]:
    """Tenant -> its running jobs with pending shards, in the order in which they are served."""
    of_job = shards.c.job_id == jobs.c.id
    with_work = (
        select(jobs.c.tenant, jobs.c.id)
        .where(jobs.c.state == JobState.RUNNING.value, exists().where(of_job, _PENDING))
        .order_by(exists().where(of_job, _PENDING, shards.c.not_before > tx.now), jobs.c.priority.desc(), jobs.c.id)
    )
    found: dict[str, list[str]] = {}
    for row in tx.rows(with_work):
        found.setdefault(row.tenant, []).append(row.id)
    return found


def _lock_shards(tx: Tx, job_ids: list[str], number: int, taken: list[str]) -> list[str]:
    """Up to `number` shards of a tenant's jobs.

    Job by job, so that each query reads a few entries of an index instead of sorting all that is pending. Each asks
    again whether its job runs: it may have been paused since the jobs were read.
    """
    ready = or_(shards.c.not_before.is_(None), shards.c.not_before <= tx.now)
    chosen: list[str] = []
    for job_id in job_ids:
        runs = exists().where(jobs.c.id == job_id, jobs.c.state == JobState.RUNNING.value)
        free = select(shards.c.id).where(shards.c.job_id == job_id, _PENDING, ready, runs)
        if taken:
            free = free.where(shards.c.id.not_in(taken))
        free = free.order_by(shards.c.ordinal).limit(number - len(chosen)).with_for_update(skip_locked=True, of=shards)
        chosen += tx.run(free).scalars()
        if len(chosen) == number:
            break
    return chosen


def _note_service(tx: Tx, names: list[str]) -> None:
    """Remember when tenants were served. Where another claim does that just now, its time is as good as ours."""
    free = select(tenants.c.name).where(tenants.c.name.in_(names)).order_by(tenants.c.name)
    if got := tx.run(free.with_for_update(skip_locked=True)).scalars().all():
        tx.run(update(tenants).where(tenants.c.name.in_(got)).values(served_at=tx.now))
