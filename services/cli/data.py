"""`vipectl verify | unpack`: the output of a job, read through its commit records."""

from __future__ import annotations

import json
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from services.cli.addresses import absolute

if TYPE_CHECKING:
    from services.dataset import Report
    from services.domain.models import ShardDigest
    from services.store.sql import SqlStore

Endpoint = Annotated[
    str | None, typer.Option("--s3-endpoint", envvar="VIPE_S3_ENDPOINT_URL", help="S3 endpoint, if not AWS.")
]
Source = Annotated[str, typer.Argument(metavar="OUTPUT", help="A job's output: a directory or s3://bucket/prefix.")]


def verify(
    output: Source,
    deep: Annotated[bool, typer.Option("--deep", help="Also read every tar: sha256, members, keys.")] = False,
    endpoint: Endpoint = None,
    database_url: Annotated[
        str | None, typer.Option("--database-url", help="Also compare every record with what this database knows.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="The whole report as JSON.")] = False,
) -> None:
    """Prove that an output is complete.

    Every planned video is committed or failed, once; every object is there with its size; the index is that of the
    records. Exit code 0: complete. 1: something is wrong. 3: nothing is wrong so far, but the job has not ended.
    """
    from services.dataset import verify as check
    from services.storage import open_store

    source = open_store(absolute(output), endpoint_url=endpoint)
    if database_url is None:
        report = check(source, deep=deep)
    else:
        from services.store.sql import SqlStore

        store = SqlStore(database_url, migrate=False)
        try:
            report = check(source, deep=deep, known=partial(_known_shards, store))
        finally:
            store.close()
    if as_json:
        typer.echo(json.dumps(report.to_json(), indent=1))
    else:
        typer.echo(summary(report))
        for problem in report.problems:
            typer.echo(f"  {problem}", err=True)
    raise typer.Exit(report.exit_code)


def _known_shards(store: SqlStore, job_id: str) -> Iterator[ShardDigest]:
    """Everything that the database knows of a job's shards, page by page."""
    first = 0
    while page := store.shard_digests(job_id, first_ordinal=first):
        yield from page
        first = page[-1].ordinal + 1


def summary(report: Report) -> str:
    """One line: what was counted and whether anything is wrong."""
    totals = report.totals
    planned = f" of {report.planned_videos} planned" if report.planned_videos is not None else ""
    verdict = {
        "complete": "complete",
        "damaged": f"{len(report.problems)} PROBLEMS",
        "running": f"not finished, {report.job_id} has not ended",
    }[report.state]
    against = f"; checked against the {' and the '.join(report.checked_against)}" if report.checked_against else ""
    return (
        f"{verdict}: {totals.videos} videos{planned} = {totals.succeeded} succeeded + {totals.failed} failed"
        f" + {totals.quarantined} quarantined, {totals.frames} frames, {totals.shards} shards{against}"
    )


def unpack(
    output: Source,
    destination: Annotated[Path, typer.Argument(metavar="DEST", help="Gets pose/, intrinsics/, depth/, rgb/.")],
    key: Annotated[list[str] | None, typer.Option("--key", help="Only these videos.")] = None,
    endpoint: Endpoint = None,
) -> None:
    """Unpack tars into the folders that nvidia-vipe reads."""
    from services.dataset import unpack as unpack_dataset
    from services.storage import open_store

    unpacked = unpack_dataset(open_store(absolute(output), endpoint_url=endpoint), destination, keys=key)
    typer.echo(f"{len(unpacked.names)} videos unpacked to {destination}")
