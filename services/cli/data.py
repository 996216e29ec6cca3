"""`vipectl verify | unpack | export`: the output of a job, read through its commit records."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

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


def export(
    source: Annotated[str, typer.Argument(metavar="SOURCE", help="A job's output, or a folder of artifacts.")],
    destination: Annotated[Path, typer.Argument(metavar="DEST", help="Gets one file per video.")],
    format: Annotated[Literal["npz"], typer.Option("--format", help="npz: one file of arrays per video.")] = "npz",
    key: Annotated[list[str] | None, typer.Option("--key", help="Only these videos.")] = None,
    depth_stride: Annotated[int, typer.Option(min=1, help="Keep every n-th depth pixel per axis.")] = 4,
    endpoint: Endpoint = None,
) -> None:
    """Export each video to one file of arrays."""
    import tempfile

    from services.dataset import DatasetIndex
    from services.dataset import unpack as unpack_dataset
    from services.storage import open_store
    from vipe_core.formats import export_npz, list_sequences

    if (Path(source) / "pose").is_dir():
        for name in _chosen(list_sequences(source), key):
            typer.echo(export_npz(source, name, destination / f"{name}.{format}", depth_stride=depth_stride))
        return
    store = open_store(absolute(source), endpoint_url=endpoint)
    with DatasetIndex(store) as index:
        names = _chosen([str(row["sequence"]) for row in index.rows()], key)
    for name in names:
        # One video at a time and without its pictures, so that an export needs little room beside its result.
        with tempfile.TemporaryDirectory(prefix="vipe-export-") as scratch:
            unpack_dataset(store, Path(scratch), keys=[name], attributes=("pose", "intrinsics", "depth"))
            typer.echo(export_npz(scratch, name, destination / f"{name}.{format}", depth_stride=depth_stride))


def _chosen(names: list[str], keys: list[str] | None) -> list[str]:
    unknown = sorted(set(keys or ()) - set(names))
    if unknown:
        raise typer.BadParameter(f"no such video here: {', '.join(unknown)}")
    return [name for name in names if not keys or name in keys]
