"""`vipectl gallery`: pictures of annotated videos that can be shown to people."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from services.cli.data import Endpoint


def gallery(
    source: Annotated[str, typer.Argument(metavar="SOURCE", help="A job's output, or a folder of artifacts.")],
    destination: Annotated[Path, typer.Argument(metavar="DEST", help="Gets ten pictures and two films per video.")],
    key: Annotated[list[str] | None, typer.Option("--key", help="Only these videos.")] = None,
    endpoint: Endpoint = None,
) -> None:
    """Draw annotated videos: frames, depth, confidence, and the fused points from all sides.

    Takes about two minutes per video. Files are named VIDEO_overview.jpg, VIDEO_turn.webp, VIDEO_depth.mp4 and so on.
    """
    from rich.console import Console

    from services.cli.export import sequences
    from vipe_core.rendering.gallery import write_gallery

    console = Console(stderr=True)
    for artifacts in sequences(source, key, endpoint):
        with console.status(f"Drawing {artifacts.name} ..."):
            paths = write_gallery(artifacts, destination)
        for path in paths:
            typer.echo(path)
