"""Everything that only a GPU can prove, in one call of less than ten minutes: `python -m benchmarks.gpu_checks`.

    compile     every kernel of bundle adjustment is compiled for this GPU, several at a time, and one is loaded
    correct     CUDA kernels against the float64 oracle, the torch solver and the compiled loops, on many shapes
    same bits   20 solves are bitwise equal, with another stream busy
    graph       a captured solve, replayed on other numbers, is bitwise the one launched kernel by kernel
    one wait    a solve makes the host wait for the GPU nowhere but where its answer is read; what a launch costs
    memcheck, racecheck, initcheck   compute-sanitizer on small solves, where it is installed
    DROID built the extension of DROID's solver is compiled, where its source is given
    network     the DROID network against itself on the CPU; its kernels and graphs against their absence
    adapters    `python -m benchmarks.networks`, for the public networks whose libraries are installed
    presets     `python -m benchmarks.gpu_presets`: tiny clips through the whole engine, against the CPU
    ba          `python -m benchmarks.ba`
    pipeline    `python -m benchmarks.gpu_pipeline`, with short clips

Every section runs in a process of its own under a time limit and survives the failure of another; those that measure no
time run side by side. What each prints is in a file of its own in `--output FOLDER` from its first line on, how each
ended in `summary.txt` there as soon as it has; the end of all of it is on the terminal, a summary last. Without a GPU
it says so and does nothing. `--vipe FOLDER` and `--droid FOLDER` are handed to the benchmarks.
`python -m benchmarks.gpu_rehearsal` runs the same sections where there is no GPU.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import repeat
from pathlib import Path
from typing import Any, TextIO

import torch

from benchmarks.ba import Size, placed, problem_of
from vipe_core.ba import (
    Edges,
    Free,
    Grid,
    Options,
    Points,
    Priors,
    Problem,
    Result,
    Rig,
    State,
    cuda,
    newton_step,
    oracle,
    reproject,
    solve,
)
from vipe_core.ba.answer import result_of
from vipe_core.ba.cuda.compiler import cache_folder, compile_kernels, specialisations, system_source, tile_source
from vipe_core.ba.cuda.solver import Adjustment
from vipe_core.ba.problem import RobustKernel
from vipe_core.geometry import se3

_SANITIZER = ("/usr/local/cuda/bin/compute-sanitizer", "compute-sanitizer")
_RUNS = 20
_SINGLE = 1e-3
"""Relative error of a step that single precision over the cells may leave."""


def _device() -> torch.device:
    return torch.device("cuda", torch.cuda.current_device())


def _moved(problem: Problem, state: State, device: torch.device) -> tuple[Problem, State]:
    """In single precision on a device, but for the graph."""
    edges, priors = problem.edges, problem.priors
    prior = priors.inverse_depth, priors.inverse_depth_weight
    problem = replace(
        problem,
        edges=replace(edges, target_px=edges.target_px.float(), weight=edges.weight.float()),
        priors=replace(
            priors,
            inverse_depth=None if prior[0] is None else prior[0].float().to(device),
            inverse_depth_weight=None if prior[1] is None else prior[1].float().to(device),
        ),
    )
    there, moved = placed(problem, replace(state, inverse_depth=state.inverse_depth.float()), device)
    return there, replace(moved, cam_from_rig=None if state.cam_from_rig is None else state.cam_from_rig.to(device))


def _scene(frames: int, cells: tuple[int, int], unified: bool, focal: bool, reach: int) -> tuple[Problem, State]:
    """A small problem in double precision on the host, and where to start."""
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


def _rig_scene(focal: bool, own: bool, unified: bool = False) -> tuple[Problem, State]:
    """Three cameras on a rig that moves, its extrinsics free under a prior; intrinsics of their own or in common."""
    problem, start = _scene(9, (4, 7), unified, focal, 4)
    rig = Rig(torch.arange(9) // 3, torch.arange(9) % 3)
    rng = torch.Generator().manual_seed(1)
    cam_from_rig = se3.exp(0.02 * torch.randn(3, 6, generator=rng, dtype=torch.float64))
    rig_from_world = start.cam_from_world[3 * rig.pose_of_frame]
    intrinsics = start.intrinsics * torch.tensor([[1.0], [1.02], [0.99]]) if own else start.intrinsics
    truth = State(cam_from_rig[rig.view_of_frame] @ rig_from_world, start.inverse_depth, intrinsics, cam_from_rig)
    edges = problem.edges
    target_px, valid = reproject(problem.camera_model, problem.grid, truth, edges.source, edges.target, rig=rig)
    target_px += 0.3 * torch.randn(target_px.shape, generator=rng, dtype=torch.float64)
    free = replace(problem.free, poses=rig.pose_of_frame >= 1, extrinsics=True)
    problem = replace(
        problem,
        edges=replace(edges, target_px=target_px, weight=edges.weight * valid[..., None]),
        free=free,
        priors=replace(problem.priors, cam_from_rig=cam_from_rig, extrinsic_sigma=torch.full((3, 2), 0.1)),
        rig=rig,
    )
    away = se3.exp(0.005 * torch.randn(3, 6, generator=rng, dtype=torch.float64))[rig.pose_of_frame]
    moved = torch.where(free.poses[:, None, None], away @ rig_from_world, rig_from_world)
    return problem, replace(truth, cam_from_world=cam_from_rig[rig.view_of_frame] @ moved)


def _with_tracks(problem: Problem, start: State, most: int) -> tuple[Problem, State]:
    """Tracks beside the cells, fewer in every further frame."""
    rng = torch.Generator().manual_seed(most)
    grid, edges, frames = problem.grid, problem.edges, len(start.cam_from_world)
    assert isinstance(grid, Grid)
    count = (most - torch.arange(frames) * most // frames).long()
    size = torch.tensor([grid.width, grid.height]) * grid.stride
    points = Points.beside(grid, torch.rand(frames, most, 2, generator=rng) * size, count)
    depth = 0.3 + 0.7 * torch.rand(frames, most, generator=rng, dtype=torch.float64)
    state = replace(start, inverse_depth=torch.cat((start.inverse_depth, depth), dim=1))
    target_px, valid = reproject(problem.camera_model, points, state, edges.source, edges.target)
    target_px += 0.3 * torch.randn(target_px.shape, generator=rng, dtype=torch.float64)
    measured = (valid & points.real()[edges.source])[..., None].expand(target_px.shape).double()
    prior = Priors(state.inverse_depth, 0.5 * points.real())
    edges = replace(edges, target_px=target_px, weight=measured)
    return replace(problem, grid=points, edges=edges, priors=prior), state


def _shapes() -> list[tuple[Problem, State, Options]]:
    """Both cameras, all sets of intrinsics and kernels, odd numbers of cells, a frame with many edges, tracks, rigs."""
    kernels: tuple[RobustKernel, ...] = ("none", "huber", "cauchy", "geman_mcclure", "tukey", "truncated")
    shapes = [(4, (5, 13), 2), (6, (9, 15), 3), (9, (16, 20), 4), (3, (1, 7), 2), (27, (3, 5), 26)]
    found: list[tuple[Problem, State, Options]] = []
    for k, (frames, cells, reach) in enumerate(shapes):
        for unified in (False, True):
            for focal in (False, True):
                problem, start = _scene(frames, cells, unified, focal, reach)
                found.append((problem, start, Options(robust=kernels[(k + 2 * unified + focal) % len(kernels)])))
    rigs: tuple[tuple[bool, bool, bool, RobustKernel], ...] = (
        (False, True, False, "none"),
        (True, False, False, "geman_mcclure"),
        (True, True, False, "truncated"),
        (True, True, True, "geman_mcclure"),
    )
    for unified in (False, True):
        for focal, cells, most in ((False, (5, 13), 200), (True, (3, 5), 9)):
            problem, start = _with_tracks(*_scene(5, cells, unified, focal, 3), most)
            found.append((problem, start, Options(robust="geman_mcclure" if focal else "none")))
    for robust in kernels:
        problem, start = _scene(4, (5, 13), True, True, 2)
        problem = replace(problem, free=replace(problem.free, distortion=False))
        found.append((problem, start, Options(robust=robust, componentwise=True)))
    return [*found, *((*_rig_scene(*kind), Options(robust=robust)) for *kind, robust in rigs)]


def _same(first: Result, second: Result) -> bool:
    states = zip(*(_tensors(result.state) for result in (first, second)), strict=True)
    return all(torch.equal(a, b) for a, b in states) and replace(first, state=second.state) == second


def _tensors(state: State) -> tuple[torch.Tensor, ...]:
    return state.cam_from_world, state.inverse_depth, state.intrinsics


def _kernels(problem: Problem, state: State, options: Options) -> Result:
    answer = cuda.solve(problem, state, options)
    if answer is None:
        raise RuntimeError("the kernels cannot be compiled or loaded")
    return result_of(answer, state)


def _compile(source: str, architecture: str) -> None:
    compile_kernels(source, architecture, cache=cache_folder())


def check_compile() -> str:
    start = time.perf_counter()
    sources = [system_source(), *(tile_source([kind]) for kind in specialisations())]
    major, minor = torch.cuda.get_device_capability()
    # A forked process could not use the driver; these do not need it.
    fresh = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(len(os.sched_getaffinity(0)), 12), fresh) as pool:
        list(pool.map(_compile, sources, repeat(f"sm_{major}{minor}")))
    compiled_s = time.perf_counter() - start
    problem, state = _moved(*_scene(4, (5, 13), False, True, 2), _device())
    if cuda.prepare(problem, state, Options()) is None:
        raise RuntimeError("the kernels cannot be loaded")
    return f"{len(sources)} sources compiled or found in {compiled_s:.1f} s"


def check_correct() -> str:
    worst = {"pose": 0.0, "depth": 0.0, "descent": 0.0}
    for problem, start, how in _shapes():
        options = replace(how, max_iterations=1, robust_scale_px=4.0, initial_damping=1e-3)
        here = _moved(problem, start, _device())
        found = _kernels(*here, options)
        if len(problem.free.poses) * problem.grid.num_cells < 2000:
            step = oracle.newton_step(problem, start, options, options.initial_damping)
        else:
            step = newton_step(problem, start, options, options.initial_damping)
        pose, extrinsic = step.pose, step.extrinsic
        if problem.rig is not None and extrinsic is not None:
            views = se3.exp(extrinsic)[problem.rig.view_of_frame]
            pose = se3.log(views @ se3.exp(pose))
        moved = se3.log(found.state.cam_from_world.cpu() @ se3.inverse(start.cam_from_world))
        change = found.state.inverse_depth.cpu().double() - start.inverse_depth
        worst["pose"] = max(worst["pose"], float((moved - pose).norm() / pose.norm()))
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


def _prepared(problem: Problem, state: State, options: Options) -> Adjustment:
    adjustment = cuda.prepare(problem, state, options)
    if adjustment is None:
        raise RuntimeError("the kernels cannot be compiled or loaded")
    return adjustment


def check_graph() -> str:
    problem, state = problem_of(Size(25, 120, focal=True), _device())
    options = Options(max_iterations=4)
    adjustment = _prepared(problem, state, options)
    adjustment.run()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        adjustment.run()
    for scale in (1.0, 0.5):
        problem.edges.weight.mul_(scale)
        graph.replay()
        replayed = result_of(adjustment.answer(), state)
        launched = _kernels(problem, state, options)
        if not _same(replayed, launched):
            raise AssertionError("a replayed solve differs from a launched one")
    return f"replay equals launches, {launched.status}"


def check_one_wait() -> str:
    problem, state = problem_of(Size(25, 120, focal=True), _device())
    options = Options(max_iterations=2)
    solve(problem, state, options)
    torch.cuda.synchronize()
    torch.cuda.set_sync_debug_mode("error")
    try:
        start = time.perf_counter()
        answer = cuda.solve(problem, state, options)
        launched_s = time.perf_counter() - start
    finally:
        torch.cuda.set_sync_debug_mode("default")
    if answer is None:
        raise RuntimeError("the kernels cannot be compiled or loaded")
    result = result_of(answer, state)
    adjustment = _prepared(problem, state, options)
    new_event: Any = torch.cuda.Event  # without types
    starts = [new_event(enable_timing=True) for _ in range(2)]
    adjustment.run()
    torch.cuda.synchronize()
    start = time.perf_counter()
    starts[0].record()
    adjustment.run()
    starts[1].record()
    run_s = time.perf_counter() - start
    torch.cuda.synchronize()
    return (
        f"{result.iterations} steps without a wait; prepared and launched in {1e3 * launched_s:.2f} ms, launched alone "
        f"in {1e3 * run_s:.2f} ms, {starts[0].elapsed_time(starts[1]):.2f} ms on the GPU"
    )


def check_small_solves() -> str:
    """What compute-sanitizer watches: one solve of every kind of kernel, on shapes that fill nothing evenly."""
    shapes = _shapes()
    # Both cameras with and without free intrinsics, a frame with more edges than fit shared memory, tracks beside the
    # cells, components judged each for itself, rigs.
    for problem, start, how in [*shapes[:4], shapes[17], *shapes[20:22], shapes[25], *shapes[-4:]]:
        _kernels(*_moved(problem, start, _device()), replace(how, max_iterations=2, robust_scale_px=4.0))
    return "done"


CHECKS: dict[str, Callable[[], str]] = {
    "compile": check_compile,
    "correct": check_correct,
    "same-bits": check_same_bits,
    "graph": check_graph,
    "one-wait": check_one_wait,
    "small-solves": check_small_solves,
}


@dataclass(frozen=True, slots=True)
class Section:
    """A command, the seconds it may take, and how much of what it says is shown when it passed."""

    name: str
    command: list[str]
    limit_s: float
    shown: int = 200


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a section ended."""

    name: str
    outcome: str
    seconds: float
    said: str
    shown: int

    @property
    def passed(self) -> bool:
        return self.outcome == "passed"

    @property
    def line(self) -> str:
        return f"{self.name:<12}{self.outcome:<14}{self.seconds:>5.0f} s"


def sections(vipe: Path | None, droid: Path | None) -> list[list[Section]]:
    """Groups of sections, one after the other; those of a group run side by side."""
    this = [sys.executable, "-m", "benchmarks.gpu_checks", "--check"]
    # The settings of this project name plugins that a bare machine need not have.
    tests = [sys.executable, "-m", "pytest", "-q", "-c", os.devnull, "--rootdir", "."]
    beside = [
        Section("correct", [*this, "correct"], 150),
        Section("same bits", [*this, "same-bits"], 60),
        Section("graph", [*this, "graph"], 60),
        Section("network", [*tests, "tests/priors/test_droid_gpu.py"], 150),
    ]
    theirs = ["--vipe", str(vipe)] if vipe else []
    networks = [sys.executable, "-u", "-m", "benchmarks.networks", "--device", "cuda", *theirs]
    beside.append(Section("adapters", networks, 150, 3000))
    beside.append(Section("presets", [sys.executable, "-u", "-m", "benchmarks.gpu_presets"], 150, 2000))
    if droid is not None:
        build = f"import torch, pathlib; Droid.load(pathlib.Path({str(droid)!r}), torch.device('cuda'))"
        command = [sys.executable, "-c", f"from benchmarks.peers.droid_ba import Droid; {build}"]
        beside.append(Section("DROID built", command, 150))
    sanitizer = next(filter(None, map(shutil.which, _SANITIZER)), None)
    for tool in ("memcheck", "racecheck", "initcheck") if sanitizer else ():
        watched = [str(sanitizer), "--tool", tool, "--error-exitcode", "9", *this, "small-solves"]
        beside.append(Section(tool, watched, 150))
    peers = [*theirs, *(["--droid", str(droid)] if droid else [])]
    pipeline = [sys.executable, "-u", "-m", "benchmarks.gpu_pipeline", "--frames", "90", *theirs]
    sizes = ["25x120", "25x200", "100x1000", "250x3000", "500x6000"]
    return [
        [Section("compile", [*this, "compile"], 80)],
        beside,
        [Section("one wait", [*this, "one-wait"], 40)],
        [Section("ba", [sys.executable, "-u", "-m", "benchmarks.ba", *peers, "--sizes", *sizes], 220, 5000)],
        [Section("pipeline", pipeline, 110, 3000)],
    ]


def run(groups: Sequence[Sequence[Section]], seconds: float, folder: Path, *, beside: bool = True) -> list[Outcome]:
    """Run all sections, within so many seconds in all; what they say is left in a folder.

    Args:
        beside: Whether those of a group run side by side.
    """
    end = time.monotonic() + seconds
    folder.mkdir(parents=True, exist_ok=True)
    outcomes: list[Outcome] = []
    for group in groups:
        with ThreadPoolExecutor(len(group) if beside else 1) as pool:
            outcomes += pool.map(lambda section: _run(section, end, folder), group)
    return outcomes


def _run(section: Section, end: float, folder: Path) -> Outcome:
    """Run a section, before the monotonic clock says `end`."""
    start = time.monotonic()
    limit = min(section.limit_s, end - start)
    # A file, and no pipe: what a killed section leaves behind may hold a pipe open, and nothing of it is lost with us.
    path = folder / f"{section.name.replace(' ', '_')}.txt"
    outcome = "no time left"
    if limit > 0:
        try:
            with path.open("w") as log:
                outcome = _outcome(section.command, limit, log)
        except OSError as error:
            path.write_text(f"{error}\n")
            outcome = "not started"
    said = path.read_text(errors="replace") if path.exists() else ""
    found = Outcome(section.name, outcome, time.monotonic() - start, said.strip(), section.shown)
    print(found.line, flush=True)
    with (folder / "summary.txt").open("a") as log:
        log.write(f"{found.line}\n")
    return found


def _outcome(command: Sequence[str], limit_s: float, log: TextIO) -> str:
    # A caching allocator would hide what is read beyond the end of a tensor.
    watched = {"PYTORCH_NO_CUDA_MEMORY_CACHING": "1"} if "--tool" in command else {}
    # Processes side by side must not spin for each other's cores.
    environment = os.environ | {"OMP_NUM_THREADS": "2", "OMP_WAIT_POLICY": "passive"} | watched
    process = subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, env=environment, start_new_session=True
    )
    try:
        status = process.wait(limit_s)
    except subprocess.TimeoutExpired:
        # With its children, which would go on computing beside the next section.
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        return "out of time"
    return "passed" if status == 0 else f"failed ({status})"


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--vipe", type=Path, metavar="FOLDER")
    parser.add_argument("--droid", type=Path, metavar="FOLDER")
    parser.add_argument("--output", type=Path, metavar="FOLDER", help="what every section says is left there")
    parser.add_argument("--seconds", type=float, default=560.0, help="in all")
    parser.add_argument("--check", choices=CHECKS, help="this check only, in this process")
    arguments = parser.parse_args(argv)
    if not torch.cuda.is_available():
        print("No GPU: none of these checks was run.")
        return 2
    if arguments.check:
        print(CHECKS[arguments.check]())
        return 0
    groups = sections(arguments.vipe, arguments.droid)
    with tempfile.TemporaryDirectory(prefix="vipe-checks-") as folder:
        outcomes = run(groups, arguments.seconds, arguments.output or Path(folder))
    print(summary(torch.cuda.get_device_name(), outcomes))
    return int(not all(outcome.passed for outcome in outcomes))


def summary(device: str, outcomes: Sequence[Outcome]) -> str:
    """What every section said at its end, and then one line for each; less than 12,000 characters."""
    parts = []
    for found in outcomes:
        # Of what failed, the end says why; measurements of a section that ran out of time are worth as much.
        shown = found.shown if found.passed else max(found.shown, 500)
        if found.said:
            parts.append(f"--- {found.name}\n{found.said[-shown:]}")
    lines = [found.line for found in outcomes]
    said = "\n".join(parts)[-10000:]
    return "\n".join([said, f"=== {device}", *lines])


if __name__ == "__main__":
    sys.exit(main())
