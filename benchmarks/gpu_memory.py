"""Memory that the DROID network's SLAM is planned to take of a GPU, and what its tensors hold: no GPU needed.

    python -m benchmarks.gpu_memory [--grid HEIGHTxWIDTH]

On a claimed GPU every byte of a tensor is counted, with what captured graphs keep; not what cuDNN works in, which the
plan has in the share of the process. One row for each part that a plan is made of, on a small grid with the numbers of
edges of the preset. Exit status 1 where more is held than planned.
"""

from __future__ import annotations

import argparse
import gc
import sys
from collections.abc import Callable, Sequence

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from benchmarks.claimed_gpu import claimed_gpu
from benchmarks.claimed_gpu.emulated import emulators
from vipe_core.ba.problem import Grid
from vipe_core.pipeline.presets import resolve
from vipe_core.priors.droid import DroidMatcher, DroidNetwork
from vipe_core.priors.droid.features import DroidFeatures
from vipe_core.priors.droid.memory import MemoryPlan, plan_memory
from vipe_core.priors.protocols import WorkingFrame

_KEYFRAMES = 24
_UPDATES = 3


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--grid", default="6x8", help="cells of a working picture")
    arguments = parser.parse_args(argv)
    height, width = (int(side) for side in arguments.grid.split("x"))
    table = Table(title=f"a grid of {height} x {width} cells, MB")
    for heading in ("part", "planned", "held at most", "held / planned"):
        table.add_column(heading, justify="right")
    failed = False
    for part, planned_bytes, held_bytes in measured(Grid(height, width, 8.0, 4.0)):
        failed |= held_bytes > planned_bytes
        numbers = f"{planned_bytes / 1e6:.2f}", f"{held_bytes / 1e6:.2f}", f"{held_bytes / planned_bytes:.2f}"
        table.add_row(part, *numbers)
    Console(width=100).print(table)
    return int(failed)


def measured(grid: Grid) -> list[tuple[str, int, int]]:
    """Parts of the plan, with the bytes that are planned and those that are held at most."""
    slam = resolve("vipe_fast").slam
    settings = slam.refinement

    def planned(*, lean: bool, window_edges: int = 1, keyframes: int = 0) -> MemoryPlan:
        return plan_memory(
            grid,
            keyframes=keyframes,
            window_edges=window_edges,
            edges_per_keyframe=settings.global_edges,
            most_edges=settings.global_most_edges,
            fill_frames=0,
            cache_bytes=0,
            lean=lean,
        )

    found = []
    pairs = [
        (i, j) for i in range(_KEYFRAMES) for j in range(_KEYFRAMES) if 0 < abs(i - j) <= settings.global_edges // 2
    ]
    for lean in (False, True):
        profile = "low memory" if lean else "volumes"
        for what, edges in (("window", settings.window_edges), ("frames in between", 2 * slam.infill_batch)):
            # The plan takes the largest of its parts: of a window, on a grid of any size, what it has for one edge.
            each_bytes = planned(lean=lean, window_edges=1 << 20).work_bytes / (1 << 20)
            work = _refining(grid, pairs[:edges], lean=lean)
            found.append((f"{what}, {profile}", int(edges * each_bytes), _held(grid, work)))
        plan = planned(lean=lean, keyframes=_KEYFRAMES)
        plan_bytes = plan.keyframe_bytes + plan.graph_bytes + plan.work_bytes
        work = _refining(grid, pairs, lean=True, spilled=lean, step=len(pairs))
        found.append((f"global pass, {profile}", plan_bytes, _held(grid, work, with_frames=True)))
    found.append(("motion of a batch", planned(lean=True).work_bytes, _held(grid, _asking)))
    return found


Work = Callable[[DroidMatcher, list[DroidFeatures]], None]


def _held(grid: Grid, work: Work, *, with_frames: bool = False) -> int:
    """Bytes that a work takes at most beside the network, and beside the frames or with them."""
    rng = np.random.default_rng(0)
    shape = (grid.height * 8, grid.width * 8, 3)
    pictures = [rng.integers(0, 256, shape, dtype=np.uint8) for _ in range(_KEYFRAMES)]
    with claimed_gpu(*emulators()), torch.inference_mode():
        matcher = DroidMatcher(DroidNetwork.random(1).ready(torch.device("cuda")))
        gc.collect()
        empty = torch.cuda.memory_allocated()
        frames = matcher.encode_batch([WorkingFrame(k, rgb[..., 0].copy(), rgb) for k, rgb in enumerate(pictures)])
        for frame in frames:
            _ = frame.context, frame.usable
        gc.collect()
        before = empty if with_frames else torch.cuda.memory_allocated()
        torch.cuda.reset_peak_memory_stats()
        work(matcher, frames)
        return torch.cuda.max_memory_allocated() - before


def _refining(grid: Grid, pairs: list[tuple[int, int]], *, lean: bool, spilled: bool = False, step: int = 8) -> Work:
    """A few updates of edges, which come so many at a time."""

    def work(matcher: DroidMatcher, frames: list[DroidFeatures]) -> None:
        seen = grid.sample_px(torch.float32, torch.device("cuda")).repeat(len(pairs), 1, 1) + 3
        refinement = matcher.begin(grid, lean=lean, spilled=spilled)
        for start in range(0, len(pairs), step):
            some = slice(start, start + step)
            refinement.add([(frames[i], frames[j]) for i, j in pairs[some]], seen[some])
        for _ in range(_UPDATES):
            refinement.update(seen, [i for i, _ in pairs])

    return work


def _asking(matcher: DroidMatcher, frames: list[DroidFeatures]) -> None:
    matcher.motion_px(frames[0], frames[1])


if __name__ == "__main__":
    sys.exit(main())
