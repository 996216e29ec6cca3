"""Milliseconds per Gauss-Newton iteration of bundle adjustment, ours beside others':

    python -m benchmarks.ba [--vipe FOLDER] [--droid FOLDER] [--sizes NxE ...]

Graphs of the size of a tracker's window and of a whole video, 48x64 cells a frame, the same for all solvers: ours (on a
CPU the compiled loops and torch, on a GPU torch and the CUDA kernels, launched one by one and as a replayed graph),
nvidia-vipe's default solver from an unpacked source distribution, and DROID-SLAM's from a checkout, which cannot adjust
a focal length. On a GPU DROID's extension is built first, which takes a minute or two. The cost after one step tells
that they solve the same problem; a step is a linearisation, the reduced system, every depth, and for ours the cost that
decides on it. `assembly` is the linearisation alone, up to the reduced system.

The floor is what the arithmetic of the algebra takes at the machine's own rate of single-precision products, or its
memory to read every measurement once and write every depth, whichever is longer. Rates are measured in the same run.

On a CPU times are CPU-seconds on one thread.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.peers import vipe_ba
from benchmarks.peers.droid_ba import Droid
from vipe_core.ba import Edges, Free, Grid, Options, Problem, State, cuda, reproject
from vipe_core.ba.answer import result_of
from vipe_core.ba.host_solver import HostSolver
from vipe_core.ba.solver import Solver
from vipe_core.ba.torch_solver import TorchSolver
from vipe_core.geometry import se3

_GRID = Grid(48, 64)
_NOISE_PX = 0.3
_DAMPING = 1e-4
# A solver is not timed for longer than this but for one call after the first.
_PATIENCE_S = 3.0
# Linearisations in a row, so that the launch of a graph does not show.
_ASSEMBLIES = 10
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


@dataclass(frozen=True, slots=True)
class Timed:
    """A solver's seconds per iteration, and cost after one step from the same state where it makes one."""

    solver: str
    seconds: float
    cost: float | None = None
    assembly: bool = False


def problem_of(size: Size, device: torch.device, seed: int = 0) -> tuple[Problem, State]:
    """Neighbours in time and one edge in eight across the video; every frame sees the same wall.

    The graph is on the host, which all of ours take.
    """
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
    return placed(Problem("pinhole", _GRID, Edges(source, target, target_px, weight), free), start, device)


def placed(problem: Problem, state: State, device: torch.device) -> tuple[Problem, State]:
    """Measurements and state on a device."""
    edges = problem.edges
    edges = replace(edges, target_px=edges.target_px.to(device), weight=edges.weight.to(device))
    state = State(state.cam_from_world.to(device), state.inverse_depth.to(device), state.intrinsics.to(device))
    return replace(problem, edges=edges), state


@dataclass(frozen=True, slots=True)
class Work:
    """The least of an iteration: operations of the assembly and of the depths' step, single precision; of the dense
    reduced system, double; bytes."""

    assembly: float
    depths: float
    reduced: float
    bytes: float

    def seconds(self, operations: float, copied: float) -> float:
        """Of an iteration, at rates per second."""
        return max((self.assembly + self.depths + self.reduced) / operations, self.bytes / copied)

    def assembly_seconds(self, operations: float, copied: float) -> float:
        return max(self.assembly / operations, self.bytes / copied)


def work(size: Size, degrees: Tensor) -> Work:
    """What a graph of a size takes whose frames have these out-degrees."""
    intrinsics, cells = int(size.focal), _GRID.num_cells
    width = 6 + intrinsics
    linearise = 62 + 22 * intrinsics + 2 * (width + width * (width + 1) + 2 * width) + 10 + 4 * width
    rows = 6 * degrees.double() + intrinsics + 1
    columns = 6 * (size.frames - 2) + intrinsics
    return Work(
        assembly=cells * (size.edges * linearise + float((rows * (rows + 1)).sum())),
        depths=cells * size.edges * 90.0,
        reduced=columns**3 / 3 + 2 * columns**2,
        bytes=16.0 * cells * (size.edges + size.frames),
    )


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
    on_gpu = device.type == "cuda"
    clock = time.perf_counter if on_gpu else time.process_time

    def once() -> float:
        start = clock()
        call()
        if on_gpu:
            torch.cuda.synchronize(device)
        return clock() - start

    once()
    spent = [once()]
    while len(spent) < repeats and sum(spent) < _PATIENCE_S:
        spent.append(once())
    return statistics.median(spent) if on_gpu else min(spent)


def _stepping(kind: type[HostSolver] | type[TorchSolver], problem: Problem, state: State) -> Callable[[], State]:
    edges, device = problem.edges, state.inverse_depth.device
    here = replace(edges, source=edges.source.to(device), target=edges.target.to(device))
    solver: Solver[Any] = kind(replace(problem, edges=here), _OPTIONS, state)

    def step() -> State:
        system = solver.linearise(state, _OPTIONS.robust_scale_px)
        moved = solver.retract(state, solver.step(system, _DAMPING))
        solver.cost(moved, _OPTIONS.robust_scale_px)
        return moved

    return step


def measure(
    host_problem: Problem,
    host_state: State,
    device: torch.device,
    repeats: int,
    vipe: dict[str, Any] | None,
    droid: Droid | None,
) -> Iterator[Timed]:
    """Every solver on a problem, moved to a device."""
    problem, state = placed(host_problem, host_state, device)
    judge = HostSolver(host_problem, _OPTIONS, host_state)

    def cost(moved: State) -> float:
        on_host = State(moved.cam_from_world.cpu(), moved.inverse_depth.cpu(), moved.intrinsics.cpu())
        return float(judge.cost(on_host, _OPTIONS.robust_scale_px).measurements)

    def timed(solver: str, step: Callable[[], State], repeats: int) -> Timed:
        found: list[State] = []
        spent = seconds(lambda: found.append(step()), device, repeats)
        return Timed(solver, spent, cost(found[0]))

    kinds: list[tuple[str, type[HostSolver] | type[TorchSolver]]] = [("torch", TorchSolver)]
    if device.type == "cpu":
        kinds.insert(0, ("compiled loops", HostSolver))
    for name, kind in kinds:
        yield timed(name, _stepping(kind, problem, state), repeats)
    if device.type == "cuda":
        yield from _kernels(problem, state, device, repeats, cost)
    edges = problem.edges
    edges = replace(edges, source=edges.source.to(device), target=edges.target.to(device))
    problem = replace(problem, edges=edges)
    peers: list[tuple[str, Callable[[], Callable[[], State]]]] = []
    if vipe is not None:
        peers.append(("nvidia-vipe", partial(vipe_ba.iteration, vipe, problem, state, _DAMPING)))
    if droid is not None and not problem.free.focal:
        peers.append((droid.name, partial(droid.iteration, problem, state, _DAMPING)))
    for name, begin in peers:
        try:
            found = timed(name, begin(), max(repeats // 2, 1))
        except Exception as error:
            # Somebody else's code, on a graph that it may not take: that costs it its row and nobody else's.
            print(f"{name} fails: {type(error).__name__}: {str(error).strip()[:300]}")
        else:
            yield found


def _kernels(
    problem: Problem, state: State, device: torch.device, repeats: int, cost: Callable[[State], float]
) -> Iterator[Timed]:
    one = cuda.prepare(problem, state, replace(_OPTIONS, max_iterations=1))
    many = cuda.prepare(problem, state, _OPTIONS)
    if one is None or many is None:
        return
    one.run()
    after = cost(result_of(one.answer(), state).state)
    many.run()
    iterations = max(result_of(many.answer(), state).iterations, 1)
    yield Timed("CUDA kernels", seconds(many.run, device, repeats) / iterations, after)
    for name, call, parts, assembly in (
        ("CUDA kernels, graph", many.run, iterations, False),
        ("CUDA kernels, assembly", lambda: many.assemble(_ASSEMBLIES), _ASSEMBLIES, True),
    ):
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            call()
        yield Timed(name, seconds(graph.replay, device, repeats) / parts, None if assembly else after, assembly)


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--sizes", nargs="*", type=Size.parse, metavar="NxE", help="keyframes x edges, like 250x3000")
    parser.add_argument("--vipe", type=Path, metavar="FOLDER", help="an unpacked source distribution of nvidia-vipe")
    parser.add_argument("--droid", type=Path, metavar="FOLDER", help="a checkout of DROID-SLAM")
    parser.add_argument("--repeats", type=int, default=None)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    arguments = parser.parse_args(argv)
    device = torch.device(arguments.device)
    on_gpu = device.type == "cuda"
    torch.set_num_threads(1)
    repeats = arguments.repeats or (20 if on_gpu else 2)
    sizes = arguments.sizes or (*WINDOWS, *(BACKENDS if on_gpu else BACKENDS[:1]))
    vipe = vipe_ba.load(arguments.vipe) if arguments.vipe else None
    droid = _droid(arguments.droid, device) if arguments.droid else None
    rate = rates(device)
    name = torch.cuda.get_device_name(device) if on_gpu else "one CPU thread"
    print(f"{name}: {rate[0] / 1e9:.0f} Gflop/s, {rate[1] / 1e9:.1f} GB/s")
    print(f"{'graph':<20} {'solver':<24}{'ms/iteration':>13}{'peer / this':>13}{'this / floor':>14}{'cost':>9}")
    for size in sizes:
        problem, state = problem_of(size, torch.device("cpu"))
        least = work(size, torch.bincount(problem.edges.source, minlength=size.frames))
        graph = f"{size.frames} x {size.edges}{', focal' if size.focal else ''}"
        rows = list(measure(problem, state, device, repeats, vipe, droid))
        peer = min((row.seconds for row in rows if "vipe" in row.solver or "DROID" in row.solver), default=None)
        for row in rows:
            floor = (least.assembly_seconds if row.assembly else least.seconds)(*rate)
            ratio = f"{peer / row.seconds:.1f}" if peer and not row.assembly else ""
            cost = "" if row.cost is None else f"{row.cost:.0f}"
            numbers = f"{1e3 * row.seconds:>13.3f}{ratio:>13}{row.seconds / floor:>14.1f}{cost:>9}"
            print(f"{graph:<20} {row.solver:<24}{numbers}")
        print(f"{graph:<20} {'floor':<24}{1e3 * least.seconds(*rate):>13.3f}", flush=True)
    return 0


def _droid(folder: Path, device: torch.device) -> Droid | None:
    """Its solver, or none where its extension cannot be built; the others are measured all the same."""
    try:
        return Droid.load(folder, device)
    except (RuntimeError, OSError, ImportError) as error:
        print(f"DROID's extension cannot be built: {str(error).strip().splitlines()[-1]}")
        return None


if __name__ == "__main__":
    sys.exit(main())
