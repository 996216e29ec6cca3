"""Tenants: what they may use, what they use, and whether one more job fits.

A tenant's row is there from its first job on; `*` holds the limits of those that have none of their own. Whoever checks
a limit locks the row of the tenant first, after the job's row where it needs both.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sqlalchemy import Row, func, select, update
from sqlalchemy.dialects import postgresql, sqlite

from services.domain.control import ANY_TENANT, Tenant, TenantLimits
from services.domain.errors import QuotaExceeded
from services.domain.states import JobState, ShardState
from services.store.database import Tx
from services.store.schema import in_state, jobs, shards, tenants

_OPEN = [state.value for state in JobState if not state.terminal]
_UNSETTLED = jobs.c.videos_total - jobs.c.videos_succeeded - jobs.c.videos_failed - jobs.c.videos_quarantined


def lock_tenants(tx: Tx, names: Sequence[str]) -> dict[str, TenantLimits]:
    """The limits of tenants, which nobody else can check before this transaction ends."""
    rows = tx.rows(select(tenants).where(tenants.c.name.in_(names)).order_by(tenants.c.name).with_for_update())
    return limits_of(tx, rows)


def make_known(tx: Tx, name: str) -> None:
    """Give a tenant its row; harmless if it has one."""
    insert = sqlite.insert if tx.conn.dialect.name == "sqlite" else postgresql.insert
    tx.run(insert(tenants).values(name=name).on_conflict_do_nothing())


def admit(tx: Tx, name: str, *, jobs_more: int, videos_more: int) -> None:
    """Raises QuotaExceeded if a tenant may not have so many more open jobs or videos."""
    limits = lock_tenants(tx, [name])[name]
    open_jobs, open_videos = in_queue(tx, name)
    if limits.max_jobs is not None and open_jobs + jobs_more > limits.max_jobs:
        raise QuotaExceeded(f"tenant {name!r} has {open_jobs} open jobs of {limits.max_jobs} that it may have")
    if limits.max_videos is not None and open_videos + videos_more > limits.max_videos:
        raise QuotaExceeded(
            f"tenant {name!r} has {open_videos} open videos and may have {limits.max_videos}; "
            f"{videos_more} more do not fit"
        )


def in_queue(tx: Tx, name: str) -> tuple[int, int]:
    """A tenant's open jobs, and their videos that are not settled."""
    unsettled = func.coalesce(func.sum(_UNSETTLED), 0)
    row = tx.run(
        select(func.count().label("jobs"), unsettled.label("videos")).where(
            jobs.c.tenant == name, jobs.c.state.in_(_OPEN)
        )
    ).one()
    return int(row.jobs), int(row.videos)


def slots_in_use(tx: Tx) -> dict[str, int]:
    """Live leases by tenant."""
    leased = (
        select(jobs.c.tenant, func.count().label("number"))
        .select_from(shards)
        .join(jobs, jobs.c.id == shards.c.job_id)
        .where(in_state(shards.c.state, ShardState.LEASED))
        .group_by(jobs.c.tenant)
    )
    return {row.tenant: int(row.number) for row in tx.rows(leased)}


def set_limits(tx: Tx, name: str, limits: TenantLimits | None) -> None:
    """See `Store.set_tenant_limits`."""
    make_known(tx, name)
    own = limits or TenantLimits()
    tx.run(
        update(tenants)
        .where(tenants.c.name == name)
        .values(
            own_limits=limits is not None,
            weight=own.weight,
            max_slots=own.max_slots,
            max_jobs=own.max_jobs,
            max_videos=own.max_videos,
        )
    )


def list_tenants(tx: Tx) -> list[Tenant]:
    """See `Store.list_tenants`."""
    rows = tx.rows(select(tenants).order_by(tenants.c.name))
    limits = limits_of(tx, rows)
    slots = slots_in_use(tx)
    lasting = select(jobs.c.tenant, shards.c.leased_at).join(jobs, jobs.c.id == shards.c.job_id)
    live_s: dict[str, float] = {}
    for lease in tx.rows(lasting.where(in_state(shards.c.state, ShardState.LEASED))):
        live_s[lease.tenant] = live_s.get(lease.tenant, 0.0) + (tx.now - lease.leased_at).total_seconds()
    ended_s = select(jobs.c.tenant, func.sum(jobs.c.slot_seconds).label("seconds")).group_by(jobs.c.tenant)
    used = {row.tenant: float(row.seconds) for row in tx.rows(ended_s)}
    found = []
    for row in rows:
        open_jobs, open_videos = in_queue(tx, row.name)
        found.append(
            Tenant(
                name=row.name,
                limits=limits[row.name],
                own_limits=row.own_limits,
                slots=slots.get(row.name, 0),
                open_jobs=open_jobs,
                open_videos=open_videos,
                slot_seconds=used.get(row.name, 0.0) + live_s.get(row.name, 0.0),
            )
        )
    return found


def limits_of(tx: Tx, rows: Sequence[Row[Any]]) -> dict[str, TenantLimits]:
    """The limits that count for tenants, by name."""
    anybody: Row[Any] | None = None
    if any(not row.own_limits for row in rows):
        anybody = tx.first(select(tenants).where(tenants.c.name == ANY_TENANT, tenants.c.own_limits))
    resolved = {}
    for row in rows:
        source = row if row.own_limits else anybody
        resolved[row.name] = (
            TenantLimits()
            if source is None
            else TenantLimits(source.weight, source.max_slots, source.max_jobs, source.max_videos)
        )
    return resolved
