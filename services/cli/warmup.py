"""`vipectl warmup`: everything that is compiled at its first use, compiled now."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Annotated

import typer

_FRAMES, _WIDTH, _HEIGHT = 14, 192, 144


def warmup(
    preset: Annotated[str, typer.Option(metavar="<str>", help="As of `vipectl annotate`.")] = "classical",
    device: Annotated[str, typer.Option(help="cpu or cuda.")] = "cpu",
) -> None:
    """Compile what the engine compiles at its first use on a machine.

    A minute that the first video, or each of several workers at once, would take otherwise. Compiled code is kept in
    NUMBA_CACHE_DIR (default: beside the package) and, of CUDA kernels, in XDG_CACHE_HOME. It is for this kind of CPU
    and GPU and this version.
    """
    from vipe_core.evaluation.synthetic import tiny_clip
    from vipe_core.formats import read_artifacts, write_artifacts
    from vipe_core.formats.fused import fuse_cloud, fuse_mesh
    from vipe_core.pipeline.annotator import Annotator
    from vipe_core.video.encode import VideoWriter

    annotator = Annotator(preset, device=device)
    started_s = time.perf_counter()
    with tempfile.TemporaryDirectory(prefix="vipe-warmup-") as folder:
        clip = tiny_clip("dynamic", _FRAMES, _WIDTH, _HEIGHT, noise=1.0)
        video = Path(folder) / "clip.mp4"
        with VideoWriter(video, clip.fps) as writer:
            for rgb in clip.rgb:
                writer.write(rgb)
        write_artifacts(annotator.annotate(video), Path(folder) / "out")
        artifacts = read_artifacts(Path(folder) / "out", "clip")
        fuse_cloud(artifacts, voxel=0.1)
        fuse_mesh(artifacts, voxel=0.1)
    typer.echo(f"ready: {preset} on {device}, {time.perf_counter() - started_s:.0f} s")
