"""Time and memory of the DROID network's SLAM as a map gets longer: `python -m benchmarks.many_keyframes`.

    python -m benchmarks.many_keyframes [--keyframes N ...] [--device cuda]

Weights are random, pictures are tiny and the schedule is short, so figures are of the bookkeeping and not of accuracy.
Every frame is a keyframe but every sixteenth, which is posed between its neighbours at the end. Each length has a
process of its own; the columns of a length stand beside those of the first. The original holds at most 1,024 keyframes.
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from benchmarks.gpu_pipeline import moving_clip
from benchmarks.network_slam import NetworkSlam
from benchmarks.processes import anonymous_bytes
from vipe_core.pipeline.device import resolve_device, set_threads
from vipe_core.pipeline.presets import resolve
from vipe_core.priors.droid import DroidNetwork
from vipe_core.slam.recurrent.posing import Unposed
from vipe_core.slam.selection import Keyframe
from vipe_core.video import open_source

_WIDTH, _HEIGHT = 64, 48
_FPS = 30.0
_POSED = 16  # Every so many-th frame is no keyframe.
_LAST = 50  # The time of a keyframe is the mean of so many.


@dataclass(frozen=True, slots=True)
class Costs:
    """What a map of a length costs.

    Attributes:
        track_s: Of a keyframe at the end of tracking, seconds: of the processor, on a GPU wall time.
        backend_s: Of one global pass.
        infill_s: Of a frame.
        tracked_bytes: That tracking added, on the device where that is a GPU, else anonymous memory.
        finite: Whether all poses and inverse depths are.
    """

    keyframes: int
    edges: int
    track_s: float
    backend_s: float
    infill_s: float
    tracked_bytes: int
    finite: bool


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--keyframes", type=int, nargs="+", default=[400, 1100])
    parser.add_argument("--device", default="cpu", help="cpu, cuda or cuda:N")
    arguments = parser.parse_args(argv)
    table = Table(title=f"{_WIDTH}x{_HEIGHT}, random weights, {arguments.device}")
    for heading in (
        "keyframes",
        "edges",
        "ms/keyframe",
        "MiB of tracking",
        "s/global pass",
        "ms/frame posed",
        "finite",
    ):
        table.add_column(heading, justify="right")
    finite = True
    first: Costs | None = None
    for count in arguments.keyframes:
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            costs: Costs = pool.apply(_costs, (count, arguments.device))
        first = first or costs
        finite = finite and costs.finite

        def beside(here: float, there: float) -> str:
            return f"{here:.4g} ({here / there:.2f}x)" if there else f"{here:.4g}"

        table.add_row(
            str(costs.keyframes),
            str(costs.edges),
            beside(1e3 * costs.track_s, 1e3 * first.track_s),
            beside(costs.tracked_bytes / 2**20, first.tracked_bytes / 2**20),
            beside(costs.backend_s, first.backend_s),
            beside(1e3 * costs.infill_s, 1e3 * first.infill_s),
            "yes" if costs.finite else "NO",
        )
    Console(width=140).print(table)
    return 0 if finite else 1


def _costs(count: int, device_name: str) -> Costs:
    device = resolve_device(device_name)
    set_threads(1)
    clock = time.process_time if device.type == "cpu" else time.perf_counter
    settings = resolve("pose_only").slam
    schedule = replace(
        settings.refinement,
        redundant_px=0.0,  # No keyframe is dropped.
        first_updates=2,
        updates=1,
        more_updates=0,
        iterations=1,
        global_iterations=2,
        fill_updates=1,
    )
    settings = replace(settings, working_area_px=_WIDTH * _HEIGHT, refinement=schedule)
    network = DroidNetwork.random(1).ready(device)
    with tempfile.TemporaryDirectory(prefix="vipe-keyframes-") as folder, torch.inference_mode():
        frames = count + math.ceil(count / (_POSED - 1)) - 1
        video = moving_clip(Path(folder) / "clip.mp4", frames, _WIDTH, _HEIGHT)
        slam = NetworkSlam.of(open_source(video), network, settings)
        built = slam.built
        with closing(slam.frames.first_pass()) as stream:
            seen = [Keyframe(work.index, features) for work, features in stream]
        between = [frame for frame in seen if frame.index % _POSED == _POSED // 2]
        keyframes = [frame for frame in seen if frame.index % _POSED != _POSED // 2]

        tracked = slam.track(keyframes)
        since = max(next(tracked), len(keyframes) - _LAST)
        held_bytes = _held_bytes(device)
        started = clock()
        for length in tracked:
            if length == since:
                started = clock()
        poses_read = [built.pose(k) for k in range(len(built))]  # What is queued is done.
        track_s = (clock() - started) / (len(keyframes) - since)
        tracked_bytes = _held_bytes(device) - held_bytes

        started = clock()
        slam.backend.run(1)
        backend_s = clock() - started

        numbers = {frame.index: k for k, frame in enumerate(keyframes)}
        poser = slam.poser()
        started = clock()
        for frame in between:
            before = numbers[frame.index - 1]
            after = min(before + 1, len(built) - 1)
            poses, _ = poser.run([Unposed(frame.features, built.pose(before), (before, after))])
            poses_read.extend(poses)
        infill_s = (clock() - started) / len(between)
    finite = np.isfinite(poses_read).all() and all(np.isfinite(built.depth(k)).all() for k in range(len(built)))
    return Costs(len(built), len(slam.graph), track_s, backend_s, infill_s, tracked_bytes, bool(finite))


def _held_bytes(device: torch.device) -> int:
    if device.type == "cuda":
        return torch.cuda.memory_allocated(device)
    return anonymous_bytes()


if __name__ == "__main__":
    sys.exit(main())
