"""`vipectl tenants | limit`: what tenants use and may use, in the database that the API and its agents share."""

from __future__ import annotations

from typing import Annotated

import typer

from services.cli.serve import DataDir, open_store
from services.cli.settings import Database, settings_from

_UNLIMITED = -1
_Limit = Annotated[int, typer.Option(min=_UNLIMITED, help="-1: no limit.")]


def tenants(data_dir: DataDir = None, database_url: Database = None) -> None:
    """List the tenants: their limits, and what they use."""
    from rich.table import Table

    from services.cli.tables import print_table

    with open_store(settings_from(data_dir=data_dir, database_url=database_url)) as store:
        found = store.list_tenants()
    columns = ("tenant", "weight", "slots", "open jobs", "open videos", "slot-hours", "limits")
    table = Table(*columns, show_edge=False, header_style="bold")
    for tenant in found:
        limits = tenant.limits
        table.add_row(
            tenant.name,
            f"{limits.weight:g}",
            _of(tenant.slots, limits.max_slots),
            _of(tenant.open_jobs, limits.max_jobs),
            _of(tenant.open_videos, limits.max_videos),
            f"{tenant.slot_seconds / 3600:.2f}",
            "its own" if tenant.own_limits else "of *",
        )
    print_table(table)


def limit(
    tenant: Annotated[str, typer.Argument(help="Its name, or * for all that have no limits of their own.")],
    weight: Annotated[float, typer.Option(help="Share of the slots, relative to other tenants with work.")] = 1.0,
    max_slots: _Limit = _UNLIMITED,
    max_jobs: _Limit = _UNLIMITED,
    max_videos: _Limit = _UNLIMITED,
    clear: Annotated[bool, typer.Option("--clear", help="Give it the limits of * again.")] = False,
    data_dir: DataDir = None,
    database_url: Database = None,
) -> None:
    """Set what a tenant may use. Takes effect at once, in every process."""
    from services.domain.control import TenantLimits

    caps = [None if cap == _UNLIMITED else cap for cap in (max_slots, max_jobs, max_videos)]
    try:
        limits = None if clear else TenantLimits(weight, *caps)
    except ValueError as error:
        raise typer.BadParameter(str(error)) from None
    with open_store(settings_from(data_dir=data_dir, database_url=database_url)) as store:
        store.set_tenant_limits(tenant, limits)


def _of(used: int, most: int | None) -> str:
    return str(used) if most is None else f"{used}/{most}"
