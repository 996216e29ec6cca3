"""`vipectl verify | unpack`: the output of a job, read through its commit records."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from services.cli.addresses import absolute

if TYPE_CHECKING:
    from services.dataset import Report

Endpoint = Annotated[
    str | None, typer.Option("--s3-endpoint", envvar="VIPE_S3_ENDPOINT_URL", help="S3 endpoint, if not AWS.")
]
Source = Annotated[str, typer.Argument(metavar="OUTPUT", help="A job's output: a directory or s3://bucket/prefix.")]


def verify(
    output: Source,
    deep: Annotated[bool, typer.Option("--deep", help="Also read every tar: sha256, members, keys.")] = False,
    endpoint: Endpoint = None,
) -> None:
    """Prove that an output is complete.

    Every video is committed or failed, once; every object is there with its size. Exit code 1 if not.
    """
    from services.dataset import verify as check
    from services.storage import open_store

    report = check(open_store(absolute(output), endpoint_url=endpoint), deep=deep)
    typer.echo(summary(report))
    for problem in report.problems:
        typer.echo(f"  {problem}", err=True)
    if not report.ok:
        raise typer.Exit(report.exit_code)


def summary(report: Report) -> str:
    """One line: what was counted and whether anything is wrong."""
    totals = report.totals
    verdict = "complete" if report.ok else f"{len(report.problems)} PROBLEMS"
    return (
        f"{verdict}: {totals.videos} videos = {totals.succeeded} succeeded + {totals.failed} failed"
        f" + {totals.quarantined} quarantined, {totals.frames} frames, {totals.shards} shards"
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
