"""`vipectl models list | pull | verify | mirror`: the network weights that presets need."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated

import typer

Names = Annotated[list[str] | None, typer.Argument(help="Of weights; all of them if none is given.")]


def list_models() -> None:
    """List weights: licence, size, which presets need them, and whether they are on this machine."""
    from rich.table import Table

    from services.cli.tables import print_table
    from vipe_core.pipeline.presets import PRESETS, resolve
    from vipe_core.priors.weights import WEIGHTS, path_of, record_of, selected, weights_folder

    table = Table(show_edge=False, pad_edge=False, header_style="bold")
    for title in ("name", "presets", "licence", "MB", "here", "SHA-256", "project"):
        table.add_column(title, overflow="fold")
    for name, weights in WEIGHTS.items():
        presets = ", ".join(preset for preset in PRESETS if name in selected(resolve(preset).weights))
        record = record_of(name)
        sha256 = weights.sha256 or (f"{record.sha256} (of the first pull)" if record else "not published")
        here = "yes" if path_of(name).is_file() else "no"
        table.add_row(name, presets, weights.licence, f"{weights.size_bytes / 1e6:.0f}", here, sha256, weights.project)
    print_table(table)
    typer.echo(f"in {weights_folder()}")


def pull(
    names: Names = None,
    origin: Annotated[
        str | None,
        typer.Option(
            "--from",
            help="Instead of the public address: an http(s) address or the path of the file, or a mirror, which is a"
            " directory or s3://bucket/prefix.",
        ),
    ] = None,
    sha256: Annotated[str | None, typer.Option(help="What the checksum must be, where none is published.")] = None,
    force: Annotated[bool, typer.Option(help="Fetch it although it is here.")] = False,
) -> None:
    """Fetch weights to this machine; go on with a download that broke off.

    Where no checksum is published, that of the first pull is written down and every later one must agree.
    """
    from rich.filesize import decimal

    from services.weights import pull as pull_weights
    from vipe_core.priors.weights import WEIGHTS, known, selected

    chosen = selected(names or WEIGHTS)
    one_file = origin is not None and (origin.startswith(("http://", "https://")) or Path(origin).is_file())
    if (sha256 or one_file) and len(chosen) != 1:
        raise typer.BadParameter(
            f"an address of a file or a checksum belongs to one file, here to one of: {', '.join(chosen)}",
            param_hint="NAMES",
        )
    for name in chosen:
        weights = known(name)
        typer.echo(f"{name}: {weights.project}, licence {weights.licence}, {decimal(weights.size_bytes)}")
        with _bar(name) as progress:
            pulled = pull_weights(name, origin=origin, sha256=sha256, force=force, progress=progress)
        what = "fetched" if pulled.fetched else "is here already"
        trust = ", trusted on first use: nobody has published a checksum" if pulled.first_use else ""
        typer.echo(f"{name}: {what}, {pulled.record.size_bytes} bytes, SHA-256 {pulled.record.sha256}{trust}")


@contextlib.contextmanager
def _bar(name: str) -> Iterator[Callable[[int, int | None], None]]:
    """What shows how far a download is, on a terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn, TransferSpeedColumn

    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), DownloadColumn(), TransferSpeedColumn())
    with Progress(
        *columns, TimeRemainingColumn(), console=console, transient=True, disable=not console.is_terminal
    ) as bar:
        task = bar.add_task(name, total=None)
        yield lambda here, total: bar.update(task, completed=here, total=total)


def verify(names: Names = None) -> None:
    """Compare checksums of the weights on this machine with the published ones, or those of the first pull."""
    from vipe_core.priors.weights import WEIGHTS, expected_sha256, path_of, require, selected, weights_folder

    if not names and not any(path_of(name).is_file() for name in WEIGHTS):
        typer.echo(f"there are no weights in {weights_folder()}")
    for name in selected(names) if names else [name for name in WEIGHTS if path_of(name).is_file()]:
        installed = require(name)
        known_by = "as it should be" if expected_sha256(name) else "nothing to compare it with: it was not pulled"
        typer.echo(f"{name}: {installed.sha256}, {known_by}")


def mirror(
    uri: Annotated[str, typer.Argument(help="A directory or s3://bucket/prefix.")],
    names: Annotated[list[str] | None, typer.Argument(help="Of weights; all that are here if none is given.")] = None,
) -> None:
    """Copy the weights on this machine to object storage, for `vipectl models pull --from`."""
    from services.weights import mirror as mirror_weights
    from vipe_core.priors.weights import WEIGHTS, path_of, selected

    here = [name for name in WEIGHTS if path_of(name).is_file()]
    for address in mirror_weights(list(selected(names)) if names else here, uri):
        typer.echo(address)
