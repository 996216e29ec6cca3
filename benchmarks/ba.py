"""Milliseconds per Gauss-Newton iteration of bundle adjustment: `python -m benchmarks.ba [--vipe FOLDER]`.

Graphs of the size of a tracker's window and of a whole video, 48x64 cells a frame, the same for all solvers: ours (on a
CPU the compiled loops and torch, on a GPU torch and the CUDA kernels, launched one by one and as a replayed CUDA graph)
and nvidia-vipe's default solver from an unpacked source distribution. The cost after one step tells that they solve the
same problem; a step is a linearisation, the reduced system, every depth, and for ours the cost that decides on it.

The floor is what the arithmetic of the algebra takes at the machine's own rate of single-precision products, or its
memory to read every measurement once and write every depth, whichever is longer. Rates are measured in the same run.

On a CPU times are CPU-seconds on one thread.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.table import Table
from torch import Tensor

from benchmarks.peers import vipe_ba
from vipe_core.ba import Edges, Free, Grid, Options, Problem, State, cuda, reproject
from vipe_core.ba.host_solver import HostSolver
from vipe_core.ba.solver import Solver
from vipe_core.ba.torch_solver import TorchSolver
from vipe_core.geometry import se3

_GRID = Grid(48, 64)
_NOISE_PX = 0.3
_DAMPING = 1e-4
_OPTIONS = Options(robust="none", relative_tolerance=0.0, max_iterations=10, initial_damping=_DAMPING)


@dataclass(frozen=True, slots=True)
class Size:
    """Keyframes, edges, and whether the focal length is free."""

    frames: int
    edges: int
    focal: bool

    @staticmethod
    def parse(text: str) -> Size:
        frames, edges = (int(number) for number in text.split("x"))
        return Size(frames, edges, focal=frames > 25)


WINDOWS = (Size(25, 120, False), Size(25, 200, False))
BACKENDS = (Size(100, 1000, True), Size(250, 3000, True), Size(500, 6000, True), Size(500, 8000, True))


def problem_of(size: Size, device: torch.device, seed: int = 0) -> tuple[Problem, State]:
    """Neighbours in time and one edge in eight across the video; every frame sees the same wall."""
    rng = torch.Generator().manual_seed(seed)
    pairs: set[tuple[int, int]] = set()
    loops, reach = size.edges // 8, 1
    while len(pairs) < size.edges - loops:
        near = [(i, i + k) for k in (reach, -reach) for i in range(size.frames) if 0 <= i + k < size.frames]
        pairs.update(near[: size.edges - loops - len(pairs)])
        reach += 1
    while len(pairs) < size.edges:
        i, j = torch.randint(size.frames, (2,), generator=rng).tolist()
        if i != j:
            pairs.add((i, j))
    source, target = torch.tensor(sorted(pairs)).T.contiguous()
    focal = 0.9 * _GRID.width * _GRID.stride
    phase = torch.arange(size.frames, dtype=torch.float64) * 0.4
    twists = 0.01 * torch.randn(size.frames, 6, generator=rng, dtype=torch.float64)
    twists[:, 0] += 0.3 * phase.sin()
    twists[:, 1] += 0.2 * (1.3 * phase).cos()
    state = State(
        se3.exp(twists),
        0.3 + 0.7 * torch.rand(size.frames, _GRID.num_cells, generator=rng),
        torch.tensor([focal, focal, _GRID.width * 4 - 0.5, _GRID.height * 4 - 0.5], dtype=torch.float64),
    )
    target_px, valid = reproject("pinhole", _GRID, state, source, target)
    target_px += _NOISE_PX * torch.randn(target_px.shape, generator=rng)
    weight = torch.rand(target_px.shape, generator=rng) * valid[..., None]
    poses = torch.ones(size.frames, dtype=torch.bool)
    poses[:2] = False
    free = Free(poses, torch.ones(size.frames, dtype=torch.bool), focal=size.focal)
    moved = se3.exp(0.002 * torch.randn(size.frames, 6, generator=rng, dtype=torch.float64) * poses[:, None])
    start = State(moved @ state.cam_from_world, state.inverse_depth * 1.02, state.intrinsics)
    edges = Edges(source.to(device), target.to(device), target_px.to(device), weight.to(device))
    start = State(start.cam_from_world.to(device), start.inverse_depth.to(device), start.intrinsics.to(device))
    return Problem("pinhole", _GRID, edges, free), start


def work(size: Size, degrees: Tensor) -> tuple[float, float, float]:
    """Single-precision operations of the cells, double-precision ones of the dense reduced system, and bytes, least."""
    intrinsics, cells = int(size.focal), _GRID.num_cells
    width = 6 + intrinsics
    linearise = 62 + 22 * intrinsics + 2 * (width + width * (width + 1) + 2 * width) + 10 + 4 * width
    rows = 6 * degrees.double() + intrinsics + 1
    columns = 6 * (size.frames - 2) + intrinsics
    single = cells * (size.edges * (linearise + 90) + float((rows * (rows + 1)).sum()))
    return single, columns**3 / 3 + 2 * columns**2, 16.0 * cells * (size.edges + size.frames)


def rates(device: torch.device) -> tuple[float, float]:
    """Operations per second of a product of matrices, and bytes per second of a copy, single precision."""
    side = 4096 if device.type == "cuda" else 768
    matrix = torch.rand(side, side, device=device)
    buffer = torch.rand(1 << (27 if device.type == "cuda" else 23), device=device)
    products = seconds(lambda: matrix @ matrix, device, 5)
    copies = seconds(lambda: buffer.clone(), device, 5)
    return 2 * side**3 / products, 2 * buffer.nbytes / copies


def seconds(call: Callable[[], object], device: torch.device, repeats: int) -> float:
    """Of a call, after one that compiles and warms: the median on a GPU, the least CPU time on a CPU."""
    call()
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    spent = []
    for _ in range(repeats):
        clock = time.perf_counter if device.type == "cuda" else time.process_time
        start = clock()
        call()
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        spent.append(clock() - start)
    return statistics.median(spent) if device.type == "cuda" else min(spent)


def _stepping(kind: type[HostSolver] | type[TorchSolver], problem: Problem, state: State) -> Callable[[], State]:
    free = problem.free
    here = Free(free.poses.to(state.inverse_depth.device), free.inverse_depth, free.focal)
    solver: Solver[Any] = kind(replace(problem, free=here), _OPTIONS, state)

    def step() -> State:
        system = solver.linearise(state, _OPTIONS.robust_scale_px)
        moved = solver.retract(state, solver.step(system, _DAMPING))
        solver.cost(moved, _OPTIONS.robust_scale_px)
        return moved

    return step


def measure(
    size: Size, device: torch.device, repeats: int, vipe: dict[str, Any] | None
) -> list[tuple[str, float, float]]:
    """Solver, seconds per iteration, and cost after one step from the same state."""
    problem, state = problem_of(size, device)
    host_problem, host_state = problem_of(size, torch.device("cpu"))
    judge = HostSolver(host_problem, _OPTIONS, host_state)

    def cost(moved: State) -> float:
        on_host = State(moved.cam_from_world.cpu(), moved.inverse_depth.cpu(), moved.intrinsics.cpu())
        return float(judge.cost(on_host, _OPTIONS.robust_scale_px).measurements)

    kinds: list[tuple[str, type[HostSolver] | type[TorchSolver]]] = [("torch", TorchSolver)]
    if device.type == "cpu":
        kinds.insert(0, ("compiled loops", HostSolver))
    found = []
    for name, kind in kinds:
        step = _stepping(kind, problem, state)
        found.append((name, seconds(step, device, repeats), cost(step())))
    if device.type == "cuda":
        found += _kernels(problem, state, device, repeats, cost)
    if vipe is not None:
        run = vipe_ba.iteration(vipe, problem, state, _DAMPING)
        found.append(("nvidia-vipe", seconds(run, device, max(repeats // 2, 1)), cost(run())))
    return found


def _kernels(
    problem: Problem, state: State, device: torch.device, repeats: int, cost: Callable[[State], float]
) -> list[tuple[str, float, float]]:
    one = cuda.prepare(problem, state, replace(_OPTIONS, max_iterations=1))
    many = cuda.prepare(problem, state, _OPTIONS)
    if one is None or many is None:
        return []
    one.run()
    after = cost(one.result().state)
    many.run()
    iterations = max(many.result().iterations, 1)
    found = [("CUDA kernels", seconds(many.run, device, repeats) / iterations, after)]
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        many.run()
    found.append(("CUDA kernels, graph", seconds(graph.replay, device, repeats) / iterations, after))
    return found


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--sizes", nargs="*", type=Size.parse, metavar="NxE", help="keyframes x edges, like 250x3000")
    parser.add_argument("--vipe", type=Path, metavar="FOLDER", help="an unpacked source distribution of nvidia-vipe")
    parser.add_argument("--repeats", type=int, default=None)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    arguments = parser.parse_args(argv)
    device = torch.device(arguments.device)
    on_gpu = device.type == "cuda"
    torch.set_num_threads(1)
    repeats = arguments.repeats or (20 if on_gpu else 2)
    sizes = arguments.sizes or (*WINDOWS, *(BACKENDS if on_gpu else BACKENDS[:1]))
    vipe = vipe_ba.load(arguments.vipe) if arguments.vipe else None
    operations, copied = rates(device)
    name = torch.cuda.get_device_name(device) if on_gpu else "one CPU thread"
    table = Table(title=f"{name}: {operations / 1e9:.0f} Gflop/s, {copied / 1e9:.1f} GB/s")
    for heading in ("keyframes", "edges", "focal", "solver", "ms/iteration", "peer / this", "this / floor", "cost"):
        table.add_column(heading, justify="left" if heading == "solver" else "right")
    for size in sizes:
        problem, _ = problem_of(size, torch.device("cpu"))
        single, double, moved = work(size, torch.bincount(problem.edges.source, minlength=size.frames))
        floor = max((single + double) / operations, moved / copied)
        rows = measure(size, device, repeats, vipe)
        peer = next((spent for name, spent, _ in rows if name == "nvidia-vipe"), None)
        for name, spent, cost in rows:
            table.add_row(
                *(str(size.frames), str(size.edges), "free" if size.focal else "fixed", name, f"{1e3 * spent:.3f}"),
                f"{peer / spent:.1f}" if peer else "",
                f"{spent / floor:.1f}",
                f"{cost:.0f}",
            )
        table.add_row("", "", "", "floor", f"{1e3 * floor:.3f}", "", "", "", end_section=True)
    Console(width=120).print(table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
