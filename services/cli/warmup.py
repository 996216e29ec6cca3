"""`vipectl warmup`: everything that is compiled at its first use, compiled now."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import typer

from services.cli.engine_options import Device, Preset

_TOO_FEW = 64
"""Points of a cloud or blocks of a mesh: what coarsens a scene that outgrows its memory is compiled as well."""


def warmup(
    preset: Preset = "classical",
    device: Device = "cpu",
) -> None:
    """Compile what the engine compiles at its first use on a machine.

    A minute that the first video, or each of several workers at once, would take otherwise. Compiled code is kept in
    NUMBA_CACHE_DIR (default: beside the package) and, of CUDA kernels, in XDG_CACHE_HOME. It is for this kind of CPU
    and GPU and this version.
    """
    from vipe_core.formats import read_artifacts, write_artifacts
    from vipe_core.formats.fused import fuse_cloud, fuse_mesh
    from vipe_core.pipeline.annotator import Annotator
    from vipe_core.pipeline.warmup import warm_up
    from vipe_core.rendering.overview import write_overview

    annotator = Annotator(preset, device=device)
    started_s = time.perf_counter()
    with tempfile.TemporaryDirectory(prefix="vipe-warmup-") as folder:
        write_artifacts(warm_up(annotator, Path(folder)), Path(folder) / "out")
        if annotator.preset.makes_depth:
            artifacts = read_artifacts(Path(folder) / "out", "clip")
            fuse_cloud(artifacts, max_points=_TOO_FEW)
            fuse_mesh(artifacts, max_blocks=_TOO_FEW)
            write_overview(artifacts, Path(folder) / "overview.jpg")
    typer.echo(f"ready: {preset} on {device}, {time.perf_counter() - started_s:.0f} s")
