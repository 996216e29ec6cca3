"""Everything that only a GPU can prove, in one call of less than ten minutes: `python -m benchmarks.gpu_checks`.

    compile     the kernels of bundle adjustment are compiled for this GPU and loaded
    correct     CUDA kernels against the float64 oracle, the torch solver and the compiled loops, on many shapes
    same bits   20 solves are bitwise equal, with another stream busy
    graph       a captured solve, replayed on other numbers, is bitwise the one launched kernel by kernel
    one wait    a solve makes the host wait for the GPU once, at its end
    memcheck, racecheck, initcheck   compute-sanitizer on small solves, where it is installed
    ba          `python -m benchmarks.ba`
    network     the DROID network against itself on the CPU; its kernels and graphs against their absence
    pipeline    `python -m benchmarks.gpu_pipeline`, with short clips

Every section runs in a process of its own under a time limit and survives the failure of another. Without a GPU it says
so and does nothing. `--vipe FOLDER` is handed to `benchmarks.ba`.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.table import Table

from benchmarks.ba import Size, problem_of
from vipe_core.ba import Edges, Free, Options, Priors, Problem, Result, State, cuda, newton_step, oracle, solve
from vipe_core.ba.problem import RobustKernel
from vipe_core.geometry import se3

_SANITIZER = ("/usr/local/cuda/bin/compute-sanitizer", "compute-sanitizer")
_RUNS = 20
_SINGLE = 1e-3
"""Relative error of a step that single precision over the cells may leave."""


def _device() -> torch.device:
    return torch.device("cuda", torch.cuda.current_device())


def _moved(problem: Problem, state: State, device: torch.device) -> tuple[Problem, State]:
    edges, priors, free = problem.edges, problem.priors, problem.free
    edges = Edges(*(x.to(device) for x in (edges.source, edges.target, edges.target_px.float(), edges.weight.float())))
    prior = priors.inverse_depth, priors.inverse_depth_weight
    priors = replace(
        priors,
        inverse_depth=None if prior[0] is None else prior[0].float().to(device),
        inverse_depth_weight=None if prior[1] is None else prior[1].float().to(device),
    )
    state = State(state.cam_from_world.to(device), state.inverse_depth.float().to(device), state.intrinsics.to(device))
    return replace(problem, edges=edges, priors=priors, free=free), state


def _scene(frames: int, cells: tuple[int, int], unified: bool, focal: bool, reach: int) -> tuple[Problem, State]:
    """A small problem in double precision on the host, and where to start."""
    from vipe_core.ba import Grid, reproject

    rng = torch.Generator().manual_seed(frames)
    grid = Grid(*cells)
    length = 0.9 * grid.width * grid.stride
    intrinsics = [length, length, grid.width * 4 - 0.5, grid.height * 4 - 0.5]
    if unified:
        intrinsics = [1.6 * length, 1.6 * length, *intrinsics[2:], 0.6]
    twists = 0.03 * torch.randn(frames, 6, generator=rng, dtype=torch.float64)
    twists[:, 0] += 0.05 * torch.arange(frames)
    depth = 0.3 + 0.7 * torch.rand(frames, grid.num_cells, generator=rng, dtype=torch.float64)
    truth = State(se3.exp(twists), depth, torch.tensor(intrinsics, dtype=torch.float64))
    pairs = [(i, j) for i in range(frames) for j in range(frames) if 0 < abs(i - j) <= reach]
    source, target = torch.tensor(pairs).T.contiguous()
    model = "mei" if unified else "pinhole"
    target_px, valid = reproject("mei" if unified else "pinhole", grid, truth, source, target)
    target_px += 0.3 * torch.randn(target_px.shape, generator=rng, dtype=torch.float64)
    weight = valid[..., None] * (0.2 + torch.rand(target_px.shape, generator=rng, dtype=torch.float64))
    poses = torch.ones(frames, dtype=torch.bool)
    poses[0] = False
    problem = Problem(
        "mei" if model == "mei" else "pinhole",
        grid,
        Edges(source, target, target_px, weight),
        Free(poses, torch.ones(frames, dtype=torch.bool), focal, focal and unified),
        Priors(depth * 1.02, torch.full_like(depth, 0.5)),
    )
    moved = se3.exp(0.005 * torch.randn(frames, 6, generator=rng, dtype=torch.float64) * poses[:, None])
    return problem, State(moved @ truth.cam_from_world, depth * 1.02, truth.intrinsics)


def _shapes() -> list[tuple[Problem, State, RobustKernel]]:
    """Both cameras, all sets of intrinsics and kernels, cells that do not fill a tile, a frame with many edges."""
    kernels: tuple[RobustKernel, ...] = ("none", "huber", "cauchy", "geman_mcclure", "tukey")
    shapes = [(4, (5, 13), 2), (6, (9, 15), 3), (9, (16, 20), 4), (3, (1, 7), 2), (27, (3, 5), 26)]
    found: list[tuple[Problem, State, RobustKernel]] = []
    for k, (frames, cells, reach) in enumerate(shapes):
        for unified in (False, True):
            for focal in (False, True):
                problem, start = _scene(frames, cells, unified, focal, reach)
                found.append((problem, start, kernels[(k + 2 * unified + focal) % 5]))
    return found


def _same(first: Result, second: Result) -> bool:
    states = zip(*(_tensors(result.state) for result in (first, second)), strict=True)
    return all(torch.equal(a, b) for a, b in states) and replace(first, state=second.state) == second


def _tensors(state: State) -> tuple[torch.Tensor, ...]:
    return state.cam_from_world, state.inverse_depth, state.intrinsics


def _kernels(problem: Problem, state: State, options: Options) -> Result:
    result = cuda.solve(problem, state, options)
    if result is None:
        raise RuntimeError("the kernels cannot be compiled or loaded")
    return result


def check_compile() -> str:
    start = time.perf_counter()
    problem, state = _moved(*_scene(4, (5, 13), False, True, 2), _device())
    if cuda.prepare(problem, state, Options()) is None:
        raise RuntimeError("the kernels cannot be compiled or loaded")
    return f"{time.perf_counter() - start:.1f} s to compile or load"


def check_correct() -> str:
    worst = {"pose": 0.0, "depth": 0.0, "descent": 0.0}
    for problem, start, robust in _shapes():
        options = Options(max_iterations=1, robust=robust, robust_scale_px=4.0, initial_damping=1e-3)
        here = _moved(problem, start, _device())
        found = _kernels(*here, options)
        if len(problem.free.poses) * problem.grid.num_cells < 2000:
            step = oracle.newton_step(problem, start, options, options.initial_damping)
        else:
            step = newton_step(problem, start, options, options.initial_damping)
        moved = se3.log(found.state.cam_from_world.cpu() @ se3.inverse(start.cam_from_world))
        change = found.state.inverse_depth.cpu().double() - start.inverse_depth
        worst["pose"] = max(worst["pose"], float((moved - step.pose).norm() / step.pose.norm()))
        worst["depth"] = max(worst["depth"], float((change - step.inverse_depth).norm() / step.inverse_depth.norm()))
        longer = replace(options, max_iterations=8)
        found, expected = _kernels(*here, longer), solve(*_moved(problem, start, torch.device("cpu")), longer)
        worst["descent"] = max(worst["descent"], abs(found.cost - expected.cost) / expected.initial_cost)
    if max(worst.values()) > _SINGLE:
        raise AssertionError(f"relative errors {worst}")
    return ", ".join(f"{name} {error:.1e}" for name, error in worst.items())


def check_same_bits() -> str:
    problem, state = problem_of(Size(25, 200, focal=True), _device())
    options = Options(max_iterations=5, relative_tolerance=0.0)
    expected = _kernels(problem, state, options)
    new_stream: Any = torch.cuda.Stream  # without types
    busy, matrix = new_stream(), torch.rand(2048, 2048, device=_device())
    for _ in range(_RUNS):
        with torch.cuda.stream(busy):
            for _ in range(4):
                matrix = (matrix @ matrix).clamp(0, 1)
        if not _same(_kernels(problem, state, options), expected):
            raise AssertionError("two solves of one problem differ")
    return f"{_RUNS} solves bitwise equal"


def check_graph() -> str:
    problem, state = problem_of(Size(25, 120, focal=True), _device())
    options = Options(max_iterations=4)
    adjustment = cuda.prepare(problem, state, options)
    if adjustment is None:
        raise RuntimeError("the kernels cannot be compiled or loaded")
    adjustment.run()
    eager = adjustment.result()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        adjustment.run()
    for scale in (1.0, 0.5):
        problem.edges.weight.mul_(scale)
        graph.replay()
        replayed = adjustment.result()
        eager = _kernels(problem, state, options)
        if not _same(replayed, eager):
            raise AssertionError("a replayed solve differs from a launched one")
    return f"replay equals launches, {eager.status}"


def check_one_wait() -> str:
    problem, state = problem_of(Size(25, 120, focal=True), _device())
    adjustment = cuda.prepare(problem, state, Options())
    if adjustment is None:
        raise RuntimeError("the kernels cannot be compiled or loaded")
    adjustment.run()
    adjustment.result()
    torch.cuda.set_sync_debug_mode("error")
    try:
        adjustment.run()
    finally:
        torch.cuda.set_sync_debug_mode("default")
    return f"{adjustment.result().iterations} steps without a wait"


def check_small_solves() -> str:
    """What compute-sanitizer watches: one solve of every kind of kernel, on shapes that fill nothing evenly."""
    for problem, start, robust in _shapes()[:4] + _shapes()[-2:]:
        _kernels(*_moved(problem, start, _device()), Options(max_iterations=2, robust=robust, robust_scale_px=4.0))
    return "done"


CHECKS: dict[str, Callable[[], str]] = {
    "compile": check_compile,
    "correct": check_correct,
    "same-bits": check_same_bits,
    "graph": check_graph,
    "one-wait": check_one_wait,
    "small-solves": check_small_solves,
}


def _sections(vipe: Path | None) -> list[tuple[str, list[str], float]]:
    """Name, command and seconds of every section; together they stay below ten minutes."""
    this = [sys.executable, "-m", "benchmarks.gpu_checks", "--check"]
    sections: list[tuple[str, list[str], float]] = [
        ("compile", [*this, "compile"], 60),
        ("correct", [*this, "correct"], 90),
        ("same bits", [*this, "same-bits"], 40),
        ("graph", [*this, "graph"], 40),
        ("one wait", [*this, "one-wait"], 40),
    ]
    sanitizer = next(filter(None, map(shutil.which, _SANITIZER)), None)
    for tool in ("memcheck", "racecheck", "initcheck") if sanitizer else ():
        watched = [str(sanitizer), "--tool", tool, "--error-exitcode", "9", *this, "small-solves"]
        sections.append((tool, watched, 60))
    peer = ["--vipe", str(vipe)] if vipe else []
    sections.append(("ba", [sys.executable, "-m", "benchmarks.ba", *peer], 90))
    sections.append(("network", [sys.executable, "-m", "pytest", "-q", "tests/priors/test_droid_gpu.py"], 45))
    sections.append(("pipeline", [sys.executable, "-m", "benchmarks.gpu_pipeline", "--frames", "90"], 75))
    return sections


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--vipe", type=Path, metavar="FOLDER")
    parser.add_argument("--check", choices=CHECKS, help="this check only, in this process")
    arguments = parser.parse_args(argv)
    if not torch.cuda.is_available():
        print("No GPU: none of these checks was run.")
        return 2
    if arguments.check:
        print(CHECKS[arguments.check]())
        return 0
    console, failed = Console(width=140), 0
    table = Table(title=torch.cuda.get_device_name(), show_lines=True)
    for heading in ("section", "outcome", "seconds", "says"):
        table.add_column(heading, justify="right" if heading == "seconds" else "left")
    for name, command, limit in _sections(arguments.vipe):
        start = time.perf_counter()
        try:
            # A caching allocator would hide what is read beyond the end of a tensor.
            environment = os.environ | ({"PYTORCH_NO_CUDA_MEMORY_CACHING": "1"} if "--tool" in command else {})
            done = subprocess.run(command, capture_output=True, text=True, timeout=limit, env=environment)
            outcome = "passed" if done.returncode == 0 else f"failed ({done.returncode})"
            said = done.stdout if done.returncode == 0 else done.stdout + done.stderr
        except subprocess.TimeoutExpired:
            outcome, said = "out of time", ""
        failed += outcome != "passed"
        spent = time.perf_counter() - start
        long = name in ("ba", "pipeline") and outcome == "passed"
        console.print(f"{name}: {outcome} after {spent:.0f} s" + (f"\n{said}" if long else ""), highlight=False)
        table.add_row(name, outcome, f"{spent:.0f}", "above" if long else said.strip()[-1500:])
    console.print(table)
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
