"""`vipectl keys create | list | revoke`: in the database itself, so that the first key needs no other."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from datetime import datetime
from typing import TYPE_CHECKING, Annotated

import typer

from services.cli.settings import Database, settings_from

if TYPE_CHECKING:
    from services.store.sql import SqlStore

_DAY_S = 86400.0

Tenant = Annotated[str, typer.Option(help="Whose jobs the key is for.")]


def create(
    name: Annotated[str, typer.Argument(help="For humans: who or what uses it.")],
    tenant: Tenant = "default",
    scope: Annotated[
        list[str] | None,
        typer.Option(help="jobs:read, jobs:write or admin; repeat it. Default: jobs:read and jobs:write."),
    ] = None,
    expires_days: Annotated[float | None, typer.Option(min=0, help="Default: it does not expire.")] = None,
    database_url: Database = None,
) -> None:
    """Make an API key and print it.

    It is not shown again.
    """
    from services.domain.access import Scope

    try:
        scopes = frozenset(Scope(each) for each in scope or [Scope.JOBS_READ, Scope.JOBS_WRITE])
    except ValueError:
        raise typer.BadParameter(f"scopes are {', '.join(Scope)}", param_hint="--scope") from None
    if not 0 < len(tenant) <= 64 or not tenant.isprintable():
        raise typer.BadParameter("a tenant has 1 to 64 printable characters", param_hint="--tenant")
    if not 0 < len(name) <= 200 or not name.isprintable():
        raise typer.BadParameter("a name has 1 to 200 printable characters", param_hint="NAME")
    expires_in_s = None if expires_days is None else expires_days * _DAY_S
    with _store(database_url) as store:
        _, key = store.create_key(name, tenant=tenant, scopes=scopes, expires_in_s=expires_in_s)
    typer.echo(key)


def list_keys(
    tenant: Annotated[str | None, typer.Option(help="Only this tenant's.")] = None, database_url: Database = None
) -> None:
    """List API keys, without their secrets."""
    from rich.table import Table

    from services.cli.tables import print_table

    columns = ("id", "tenant", "name", "scopes", "created", "last used", "ends")
    table = Table(*columns, show_edge=False, header_style="bold")
    with _store(database_url) as store:
        after: str | None = None
        while True:
            keys, after = store.list_keys(tenant=tenant, after=after)
            for key in keys:
                ends = f"revoked {_when(key.revoked_at)}" if key.revoked_at else _when(key.expires_at)
                times = (_when(key.created_at), _when(key.last_used_at), ends)
                table.add_row(key.id, key.tenant, key.name, " ".join(sorted(key.scopes)), *times)
            if after is None:
                break
    print_table(table)


def revoke(
    key_id: Annotated[str, typer.Argument(help="The middle of the key, or its first column in the list.")],
    database_url: Database = None,
) -> None:
    """End a key for ever; running services refuse it within ten seconds."""
    with _store(database_url) as store:
        key = store.revoke_key(key_id)
    typer.echo(f"{key.id} {key.tenant} {key.name} revoked")


def _when(moment: datetime | None) -> str:
    return "-" if moment is None else f"{moment:%Y-%m-%d %H:%M}"


@contextlib.contextmanager
def _store(database_url: str | None) -> Iterator[SqlStore]:
    from services.store.sql import SqlStore

    store = SqlStore(settings_from(database_url=database_url).database_url)
    try:
        yield store
    finally:
        store.close()
