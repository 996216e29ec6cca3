"""Time and memory of dense bundle adjustment on a CPU: the compiled solver beside the torch solver, in one run.

    python -m benchmarks.ba_step [--keyframes 250 1000 2000] [--threads 1]

First a window of 80 edges with 4800 cells each: CPU milliseconds per Levenberg-Marquardt step (linearisation, reduced
system, step of the depths, cost) and per cost evaluation. Then trajectories with 6 edges per keyframe, every tenth
keyframe also tied to one far away, a fresh process for each: CPU seconds per step, the share of the reduced system in
it, and peak memory above what was resident with the measurements loaded. The torch solver, whose reduced system is
dense, runs where its matrices of (6 N)^2 stay below 2 GiB.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from vipe_core.ba import Edges, Free, Grid, Options, Problem, State, reproject
from vipe_core.ba.host_solver import HostSolver
from vipe_core.ba.solver import Solver
from vipe_core.ba.torch_solver import TorchSolver
from vipe_core.geometry import se3

_GRID = Grid(60, 80)
_NOISE_PX = 0.1
_DENSE_BYTES = 2 << 30
# The dense path holds the direct and the eliminated part, their difference, its scaled copy and the factor.
_DENSE_MATRICES = 5


def trajectory(num_keyframes: int, loops: bool, seed: int = 0) -> tuple[Problem, State]:
    """A sideways moving camera: edges to the three keyframes before and after, 6 (fewer at the ends)."""
    rng = torch.Generator().manual_seed(seed)
    pairs = {(i, i + k) for i in range(num_keyframes) for k in (-3, -2, -1, 1, 2, 3) if 0 <= i + k < num_keyframes}
    if loops:
        half = num_keyframes // 2
        pairs = {(i, i + half) if j == i + 3 and i % 10 == 0 and i < half else (i, j) for i, j in pairs}
    source, target = torch.tensor(sorted(pairs)).T.contiguous()
    focal = 0.9 * _GRID.width * _GRID.stride
    twists = 0.01 * torch.randn(num_keyframes, 6, generator=rng, dtype=torch.float64)
    twists[:, 0] += 0.05 * (torch.arange(num_keyframes) % (num_keyframes // 2 if loops else num_keyframes))
    state = State(
        se3.exp(twists),
        0.3 + 0.7 * torch.rand(num_keyframes, _GRID.num_cells, generator=rng),
        torch.tensor([focal, focal, _GRID.width * 4 - 0.5, _GRID.height * 4 - 0.5], dtype=torch.float64),
    )
    target_px, _ = reproject("pinhole", _GRID, state, source, target)
    for edge in target_px:
        edge += _NOISE_PX * torch.randn(edge.shape, generator=rng)
    weight = torch.rand(target_px.shape, generator=rng)
    poses = torch.ones(num_keyframes, dtype=torch.bool)
    poses[0] = False
    free = Free(poses, torch.ones(num_keyframes, dtype=torch.bool), focal=True)
    return Problem("pinhole", _GRID, Edges(source, target, target_px, weight), free), state


def cpu_seconds(work: Callable[[], object], repeats: int) -> float:
    """Least CPU time of a call, after one that warms caches and compiles."""
    work()
    best = float("inf")
    for _ in range(repeats):
        start = time.process_time()
        work()
        best = min(best, time.process_time() - start)
    return best


def measure(kind: str, num_keyframes: int, loops: bool, repeats: int) -> dict[str, float]:
    """Seconds of a step, of its reduced system and of a cost evaluation; peak and measurement bytes."""
    problem, state = trajectory(num_keyframes, loops)
    options = Options()
    edges = problem.edges
    held = edges.target_px.nbytes + edges.weight.nbytes
    before = int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()
    make: Callable[[Problem, Options, State], Solver[Any]] = HostSolver if kind == "compiled" else TorchSolver
    solver = make(problem, options, state)
    scale_px = options.robust_scale_px

    def step() -> None:
        moved = solver.retract(state, solver.step(solver.linearise(state, scale_px), 1e-4))
        solver.cost(moved, scale_px)

    result = {
        "step_s": cpu_seconds(step, repeats),
        "cost_s": cpu_seconds(lambda: solver.cost(state, scale_px), repeats),
        "edges": len(edges.source),
        "held_bytes": held,
        "before_bytes": before,
        "peak_bytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024,
    }
    system = solver.linearise(state, scale_px)
    result["reduced_s"] = cpu_seconds(lambda: solver.intrinsics_covariance(system, 1e-4), repeats)
    return result


def in_fresh_process(*arguments: str) -> dict[str, float]:
    """`measure` in a process of its own, so that its peak memory is its own."""
    command = [sys.executable, "-m", "benchmarks.ba_step", "--worker", *arguments]
    answer: dict[str, float] = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    return answer


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--keyframes", type=int, nargs="*", default=[250, 1000, 2000], metavar="N")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--worker", nargs=4, metavar=("KIND", "N", "LOOPS", "REPEATS"), help=argparse.SUPPRESS)
    arguments = parser.parse_args(argv)
    torch.set_num_threads(arguments.threads)
    if arguments.worker:
        kind, num_keyframes, loops, repeats = arguments.worker
        print(json.dumps(measure(kind, int(num_keyframes), loops == "loops", int(repeats))))
        return 0

    def run(kind: str, num_keyframes: int, loops: str, repeats: int) -> dict[str, float]:
        return in_fresh_process(kind, str(num_keyframes), loops, str(repeats), "--threads", str(arguments.threads))

    console = Console(width=120)
    window = {kind: run(kind, 15, "chain", 9) for kind in ("compiled", "torch")}
    table = Table(
        title=f"{window['torch']['edges']:.0f} edges of {_GRID.num_cells} cells, {arguments.threads} thread(s)"
    )
    for heading in ("solver", "CPU ms per LM step", "CPU ms per cost evaluation"):
        table.add_column(heading, justify="left" if heading == "solver" else "right")
    for kind, row in window.items():
        table.add_row(kind, f"{1e3 * row['step_s']:.1f}", f"{1e3 * row['cost_s']:.2f}")
    ratios = [window["torch"][name] / window["compiled"][name] for name in ("step_s", "cost_s")]
    table.add_row("ratio", *(f"{ratio:.1f}" for ratio in ratios))
    console.print(table)

    table = Table(title="6 edges per keyframe, with loops")
    for heading in ("keyframes", "edges", "solver", "s per step", "s reduced system", "edges GiB", "above edges GiB"):
        table.add_column(heading, justify="left" if heading == "solver" else "right")
    for num_keyframes in arguments.keyframes:
        dense_fits = _DENSE_MATRICES * 8 * (6 * num_keyframes) ** 2 < _DENSE_BYTES
        for kind in ("compiled", "torch") if dense_fits else ("compiled",):
            row = run(kind, num_keyframes, "loops", 2)
            gib = np.array((row["held_bytes"], row["peak_bytes"] - row["before_bytes"])) / 2**30
            table.add_row(
                str(num_keyframes),
                f"{row['edges']:.0f}",
                kind,
                f"{row['step_s']:.3f}",
                f"{row['reduced_s']:.4f}",
                f"{gib[0]:.2f}",
                f"{gib[1]:.3f}",
            )
    console.print(table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
