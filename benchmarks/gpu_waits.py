"""Where the host waits for the GPU, on a machine without one: `python -m benchmarks.gpu_waits`.

    python -m benchmarks.gpu_waits [--preset vipe_fast] [--frames N]

A tiny clip of noise is annotated on the CPU and on a GPU that is only claimed (`claimed_gpu`), with random weights of
the DROID network. A mixture of devices ends the command with the line that made it. Printed are waits per place; the
solver of bundle adjustment is torch's there, so that its own waits, which the CUDA kernels have not, are listed apart.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from benchmarks.claimed_gpu import claimed_gpu
from vipe_core.annotation import Annotation
from vipe_core.pipeline.annotator import Annotator
from vipe_core.pipeline.presets import Preset, resolve
from vipe_core.priors.droid import DroidNetwork

_SOLVER = "vipe_core.ba."
_WIDTH, _HEIGHT = 64, 48


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--preset", choices=("vipe_fast", "pose_only"), default="vipe_fast")
    parser.add_argument("--frames", type=int, default=8)
    arguments = parser.parse_args(argv)
    slam = resolve(arguments.preset).slam
    schedule = replace(
        slam.refinement, first_updates=2, updates=1, more_updates=1, global_updates=(1, 1, 2), fill_updates=2
    )
    slam = replace(slam, working_area_px=_WIDTH * _HEIGHT, refinement=schedule, backend_at=())
    preset = replace(resolve(arguments.preset), slam=slam)
    console = Console(width=160)
    with tempfile.TemporaryDirectory(prefix="vipe-waits-") as folder:
        torch.save(DroidNetwork.random(1).state_dict(), Path(folder) / "droid.pth")
        os.environ["VIPE_WEIGHTS"] = folder
        clip = _clip(Path(folder) / "clip", arguments.frames)
        here, here_s = _annotated(preset, clip, "cpu")
        with claimed_gpu() as gpu:
            there, there_s = _annotated(preset, clip, "cuda")
    console.print(f"CPU-seconds: {here_s:.1f} on the CPU, {there_s:.1f} on the claimed GPU")
    console.print(f"focal length: {here.camera.focal_px:.6f} px on the CPU, {there.camera.focal_px:.6f} px there")
    console.print(f"farthest pose from that of the CPU: {np.abs(here.world_from_cam - there.world_from_cam).max():.2e}")
    same = np.array_equal(here.keyframes, there.keyframes)
    frames, keyframes = there.num_frames, len(there.keyframes)
    console.print(f"{frames} frames, {keyframes} keyframes, the same: {same}; {gpu.replays} graphs replayed")
    for title, solver in (
        ("Waits of the pipeline", False),
        ("Waits of torch's solver, on the claimed GPU alone", True),
    ):
        table = Table(title=title)
        for heading in ("waits", "per frame", "per keyframe", "why"):
            table.add_column(heading, justify="right")
        table.add_column("where")
        for place, count in gpu.waits.most_common():
            if place.function.startswith(_SOLVER) == solver:
                where = f"{place.function.removeprefix('vipe_core.')}\n  {escape(place.line)}"
                table.add_row(str(count), f"{count / frames:.1f}", f"{count / keyframes:.1f}", place.kind, where)
        console.print(table)
    return 0 if same else 1


def _annotated(preset: Preset, clip: Path, device: str) -> tuple[Annotation, float]:
    start_s = time.process_time()
    annotation = Annotator(preset, device=device).annotate(clip)
    for _ in annotation.dense():
        pass
    return annotation, time.process_time() - start_s


def _clip(folder: Path, frames: int) -> Path:
    """Pictures of noise that the camera pans over."""
    folder.mkdir()
    noise = np.random.default_rng(0).integers(0, 256, (12, 16 + 2 * frames, 3), dtype=np.uint8)
    wide = cv2.resize(noise, None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC)
    for index in range(frames):
        cv2.imwrite(str(folder / f"{index:04d}.png"), wide[:_HEIGHT, 5 * index : 5 * index + _WIDTH])
    return folder


if __name__ == "__main__":
    sys.exit(main())
