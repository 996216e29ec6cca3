"""The CUDA kernels of bundle adjustment, their own source executed on a CPU (see `cuda_emulator`)."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from importlib import resources
from typing import Any

import hypothesis.strategies as st
import pytest
import torch
from ba_scenes import disturbed, float32, scene, with_depth_prior, with_noise, with_tracks
from cuda_emulator import COMPILER, ORDERS, EmulatedLauncher
from hypothesis import given, settings
from rig_scenes import disturbed_rig, rig_scene

from benchmarks import gpu_checks
from vipe_core.ba import Edges, Free, Options, Priors, Problem, Result, State, Status, cuda, operator, oracle, solve
from vipe_core.ba.answer import Answer, result_of
from vipe_core.ba.cuda import layout
from vipe_core.ba.cuda import solver as cuda_solver
from vipe_core.ba.cuda.compiler import Specialisation
from vipe_core.ba.cuda.context import Context
from vipe_core.ba.problem import RobustKernel
from vipe_core.cameras import CameraModel
from vipe_core.geometry import se3

# Every kernel of residuals, every set of free intrinsics, both cameras.
KINDS = (
    Specialisation(False, False, False, "none"),
    Specialisation(False, True, False, "geman_mcclure"),
    Specialisation(True, False, False, "tukey"),
    Specialisation(True, True, False, "huber"),
    Specialisation(True, False, True, "cauchy"),
    Specialisation(True, True, True, "geman_mcclure"),
    Specialisation(False, False, False, "truncated"),
    Specialisation(False, True, False, "truncated", apart=True),
    Specialisation(True, True, True, "geman_mcclure", apart=True),
    Specialisation(False, True, False, "geman_mcclure", points=True),
    Specialisation(True, True, True, "cauchy", points=True),
    Specialisation(True, True, False, "componentwise"),
)
PLAIN, FOCAL, TRUNCATED, POINTS, COMPONENTS = KINDS[0], KINDS[1], KINDS[6], KINDS[9], KINDS[11]
ALONE = [kind for kind in KINDS[:11] if not kind.apart]
APART = [kind for kind in KINDS if kind.apart]

pytestmark = pytest.mark.skipif(COMPILER is None, reason="no C++ compiler to run the kernels with")


@pytest.fixture(autouse=True)
def _poisoned_memory(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Memory that nobody has written holds NaN and large integers."""
    empty = torch.empty

    def poisoned(*arguments: Any, **options: Any) -> torch.Tensor:
        tensor = empty(*arguments, **options)
        if tensor.dtype == torch.bool:
            return tensor
        return tensor.fill_(math.nan if tensor.is_floating_point() else torch.iinfo(tensor.dtype).max)

    # Torch's own switch for this imports its compiler.
    monkeypatch.setattr(torch, "empty", poisoned)
    layout_cache = cuda_solver._layout
    layout_cache.cache_clear()
    yield
    layout_cache.cache_clear()


def emulated(problem: Problem, state: State, options: Options, order: int = 0) -> Result:
    kind = cuda_solver.specialisation(problem, state, options)
    adjustment = cuda_solver.Adjustment(problem, state, options, EmulatedLauncher(kind, KINDS, order))
    adjustment.run()
    return result_of(adjustment.answer(), state)


def problem_of(kind: Specialisation, tracks: int = 9, **shape: int) -> tuple[Problem, State]:
    problem, truth = scene(
        "mei" if kind.unified else "pinhole", focal_free=kind.focal, distortion_free=kind.alpha, **shape
    )
    return with_tracks(problem, truth, tracks) if kind.points else (problem, truth)


def same(first: Result, second: Result) -> bool:
    return (
        all(
            torch.equal(getattr(first.state, name), getattr(second.state, name))
            for name in ("cam_from_world", "inverse_depth", "intrinsics")
        )
        and replace(first, state=second.state) == second
    )


def assert_close(found: Result, expected: Result, rtol: float = 1e-4) -> None:
    assert found.status is expected.status
    assert found.iterations == expected.iterations
    assert found.initial_cost == pytest.approx(expected.initial_cost, rel=1e-5)
    assert found.weight_sum == pytest.approx(expected.weight_sum, rel=1e-5)
    assert found.cost == pytest.approx(expected.cost, rel=rtol, abs=1e-6 * expected.initial_cost)
    torch.testing.assert_close(found.state.cam_from_world, expected.state.cam_from_world, rtol=0, atol=10 * rtol)
    torch.testing.assert_close(found.state.intrinsics, expected.state.intrinsics, rtol=rtol, atol=1e-5)
    if expected.state.cam_from_rig is not None:
        assert found.state.cam_from_rig is not None
        torch.testing.assert_close(found.state.cam_from_rig, expected.state.cam_from_rig, rtol=0, atol=10 * rtol)
    depth = expected.state.inverse_depth
    assert ((found.state.inverse_depth - depth).norm() / depth.norm()) < 10 * rtol


@pytest.mark.parametrize("kind", ALONE)
def test_one_step_is_the_oracles(kind: Specialisation) -> None:
    problem, truth = problem_of(kind, num_frames=4, height=5, width=13)
    prior = truth.inverse_depth * 1.02
    problem = with_depth_prior(with_noise(problem, 0.3), prior, 2.0)
    problem = replace(problem, priors=replace(problem.priors, log_focal=4.0 if kind.focal else None))
    start = disturbed(truth, twist=0.005, depth=0.02, log_focal=0.01)
    options = Options(max_iterations=1, robust=kind.robust, robust_scale_px=4.0, initial_damping=1e-3)
    step = oracle.newton_step(problem, start, options, options.initial_damping)
    result = emulated(*float32(problem, start), options)
    assert result.iterations == 1
    assert result.cost < result.initial_cost
    moved = se3.log(result.state.cam_from_world @ se3.inverse(start.cam_from_world))
    assert (moved - step.pose).norm() < 1e-3 * step.pose.norm()
    change = (result.state.inverse_depth - start.inverse_depth.float()).double()
    assert (change - step.inverse_depth).norm() < 1e-3 * step.inverse_depth.norm()
    if kind.focal:
        log_focal = (result.state.intrinsics[0] / start.intrinsics[0]).log()
        assert abs(log_focal - step.log_focal) < 1e-3 * abs(step.log_focal)
    if kind.alpha:
        alpha = result.state.intrinsics[4] - start.intrinsics[4]
        assert abs(alpha - step.alpha) < 1e-3 * abs(step.alpha)


@pytest.mark.parametrize("kind", ALONE)
def test_a_descent_is_the_hosts(kind: Specialisation) -> None:
    """Rejected steps, damping and covariance included: the start is far away."""
    problem, truth = problem_of(kind, 400, num_frames=6, height=9, width=15)
    problem = with_depth_prior(with_noise(problem, 0.5), truth.inverse_depth, 0.5)
    problem, start = float32(problem, disturbed(truth, twist=0.03, depth=0.3, log_focal=0.08))
    options = Options(max_iterations=6, robust=kind.robust, robust_scale_px=8.0)
    found, expected = emulated(problem, start, options), solve(problem, start, options)
    assert_close(found, expected, rtol=1e-3)
    for row, other in zip(found.intrinsics_covariances[0], expected.intrinsics_covariances[0], strict=True):
        assert row == pytest.approx(other, rel=1e-2)


@pytest.mark.parametrize(
    ("kind", "own_intrinsics", "extrinsics", "prior"),
    [
        (PLAIN, True, True, True),
        (FOCAL, False, False, False),
        (FOCAL, False, True, True),
        (KINDS[2], True, True, False),
        (APART[0], True, False, False),
        (APART[1], True, True, True),
    ],
)
def test_a_rig_is_the_hosts(kind: Specialisation, own_intrinsics: bool, extrinsics: bool, prior: bool) -> None:
    """Poses behind several frames, extrinsics that are held or free, a camera for each view."""
    model: CameraModel = "mei" if kind.unified else "pinhole"
    problem, truth = rig_scene(model, num_views=3, own_intrinsics=own_intrinsics)
    free = replace(problem.free, focal=kind.focal, distortion=kind.alpha, extrinsics=extrinsics)
    free.inverse_depth[[1, 5]] = False
    assert truth.cam_from_rig is not None
    away = se3.exp(torch.full((1, 6), 0.01, dtype=torch.float64)) @ truth.cam_from_rig
    sigma = torch.tensor([[0.1, 0.05], [0.2, 0.03], [0.3, 0.02]])
    priors = Priors(cam_from_rig=away, extrinsic_sigma=sigma) if prior else Priors()
    if kind.apart:
        priors = replace(priors, log_focal=(3.6, 3.7, 3.8) if prior else 3.7, log_focal_sigma=0.1)
    problem = replace(with_noise(problem, 0.05), free=free, priors=priors)
    problem, start = float32(problem, disturbed_rig(problem, truth, twist=0.01, turn=0.01 * extrinsics))
    options = Options(max_iterations=4, robust=kind.robust, robust_scale_px=8.0)
    found, expected = emulated(problem, start, options), solve(problem, start, options)
    assert_close(found, expected, rtol=1e-3)
    if kind.focal:
        variances = (torch.tensor(result.intrinsics_covariances) for result in (found, expected))
        torch.testing.assert_close(*variances, rtol=2e-2, atol=1e-9)
    assert problem.rig is not None
    assert found.state.cam_from_rig is not None
    rig_from_world = se3.inverse(found.state.cam_from_rig[problem.rig.view_of_frame]) @ found.state.cam_from_world
    one_each = rig_from_world.reshape(-1, 3, 4, 4)
    torch.testing.assert_close(one_each, one_each[:, :1].expand_as(one_each), rtol=0, atol=1e-12)


def test_a_step_of_cameras_that_are_apart_is_the_oracles() -> None:
    """Seven cameras: their intrinsics and the right-hand side take three blocks of six."""
    problem, truth = rig_scene("mei", num_poses=3, num_views=7, own_intrinsics=True, height=3, width=4)
    problem = replace(with_noise(problem, 0.05), free=replace(problem.free, focal=True, distortion=True))
    problem = with_depth_prior(problem, truth.inverse_depth * 1.02, 2.0)
    problem = replace(problem, priors=replace(problem.priors, log_focal=4.0))
    start = disturbed_rig(problem, truth, twist=0.003)
    options = Options(max_iterations=1, robust_scale_px=4.0, initial_damping=1e-3)
    step = oracle.newton_step(problem, start, options, options.initial_damping)
    result = emulated(*float32(problem, start), options)
    assert result.cost < result.initial_cost
    moved = se3.log(result.state.cam_from_world @ se3.inverse(start.cam_from_world))
    assert (moved - step.pose).norm() < 2e-3 * step.pose.norm()
    change = result.state.inverse_depth.double() - start.inverse_depth
    assert (change - step.inverse_depth).norm() < 2e-3 * step.inverse_depth.norm()
    log_focal = (result.state.intrinsics[:, 0] / start.intrinsics[:, 0]).log()
    assert (log_focal - step.log_focal).norm() < 2e-3 * step.log_focal.norm()
    alpha = result.state.intrinsics[:, 4] - start.intrinsics[:, 4]
    assert (alpha - step.alpha).norm() < 2e-3 * step.alpha.norm()


@pytest.mark.parametrize("focal", [False, True])
def test_on_a_gpu_the_operator_takes_the_kernels(focal: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its kernel for GPUs, with the emulated ones; torch says how sure refined extrinsics are. The answer has the
    shapes that its fake foretells."""
    problem, truth = rig_scene(own_intrinsics=True)
    problem = replace(with_noise(problem, 0.05), free=replace(problem.free, focal=focal, extrinsics=True))
    problem, start = float32(problem, disturbed_rig(problem, truth, twist=0.005))
    options = Options(max_iterations=2, robust=APART[0].robust if focal else "none")
    used: list[cuda_solver.Adjustment] = []

    def on_gpu(problem: Problem, state: State, options: Options) -> Answer:
        launcher = EmulatedLauncher(cuda_solver.specialisation(problem, state, options), KINDS)
        used.append(cuda_solver.Adjustment(problem, state, options, launcher))
        used[-1].run()
        return used[-1].answer()

    monkeypatch.setattr(cuda, "solve", on_gpu)
    arguments = operator._arguments(problem, start, options)
    answer = operator._on_gpu(*arguments)
    assert used
    assert [tensor.shape for tensor in answer] == [tensor.shape for tensor in operator._shapes(*arguments)]
    found, expected = result_of(answer, start), solve(problem, start, options)
    assert_close(found, expected, rtol=1e-3)
    assert found.extrinsic_covariances is not None
    torch.testing.assert_close(found.extrinsic_covariances, expected.extrinsic_covariances, rtol=1e-2, atol=1e-9)


def test_what_the_kernels_are_not_for() -> None:
    problem, state = float32(*rig_scene(own_intrinsics=True))
    assert cuda.takes(problem, state)
    assert cuda.takes(replace(problem, free=replace(problem.free, extrinsics=True)), state)
    assert cuda.takes(replace(problem, free=replace(problem.free, focal=True)), state)
    assert not cuda.takes(problem, replace(state, inverse_depth=state.inverse_depth.double()))
    edges = problem.edges
    nothing = Edges(edges.source[:0], edges.target[:0], edges.target_px[:0], edges.weight[:0])
    assert not cuda.takes(replace(problem, edges=nothing), state)


@st.composite
def graphs(draw: st.DrawFn) -> tuple[Problem, State]:
    """Any graph over a scene: isolated frames, held poses and depths, double edges, unmeasured frames, odd sizes."""
    frames = draw(st.integers(2, 7))
    height, width = draw(st.sampled_from([(1, 1), (1, 7), (8, 8), (5, 13), (3, 43), (13, 20), (17, 31)]))
    seed = draw(st.integers(0, 1 << 16))
    model = draw(st.sampled_from(["pinhole", "mei"]))
    problem, truth = scene(
        "mei" if model == "mei" else "pinhole",
        num_frames=frames,
        height=height,
        width=width,
        reach=frames,
        seed=seed,
        distortion_free=model == "mei",
    )
    count = len(problem.edges.source)
    chosen = torch.tensor(draw(st.lists(st.integers(0, count - 1), min_size=1, max_size=14)))
    edges = problem.edges
    weight = edges.weight[chosen]
    weight[torch.tensor(draw(st.lists(st.booleans(), min_size=len(chosen), max_size=len(chosen))))] *= 0.0
    edges = Edges(edges.source[chosen], edges.target[chosen], edges.target_px[chosen], weight)
    flags = st.lists(st.booleans(), min_size=frames, max_size=frames)
    free = replace(problem.free, poses=torch.tensor(draw(flags)), inverse_depth=torch.tensor(draw(flags)))
    problem = replace(with_noise(replace(problem, edges=edges, free=free), 0.2, seed), priors=problem.priors)
    problem = with_depth_prior(problem, truth.inverse_depth, 1.0)
    problem = replace(problem, priors=replace(problem.priors, log_focal=4.0, log_focal_sigma=0.1))
    return float32(problem, disturbed(truth, twist=0.01, depth=0.05, log_focal=0.02, seed=seed))


@settings(max_examples=20, deadline=None, derandomize=True)
@given(graphs())
def test_any_graph(graph: tuple[Problem, State]) -> None:
    problem, start = graph
    # A gauge that nothing holds leaves only damping to choose the step, which rounding then shows in.
    options = Options(max_iterations=1, initial_damping=1e-2, robust_scale_px=5.0)
    found, expected = emulated(problem, start, options), solve(problem, start, options)
    assert found.status is expected.status
    if expected.status is Status.EMPTY:
        assert found.state is start
        return
    assert_close(found, expected)
    held = ~problem.free.poses
    assert torch.equal(found.state.cam_from_world[held], start.cam_from_world[held])
    held = ~problem.free.inverse_depth
    assert torch.equal(found.state.inverse_depth[held], start.inverse_depth[held])


@pytest.mark.parametrize("rig", [False, True])
def test_the_bits_depend_neither_on_the_order_of_threads_nor_of_edges_nor_on_where_rows_are_kept(
    rig: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if rig:
        problem, truth = rig_scene("mei", num_views=3, own_intrinsics=True)
        free = replace(problem.free, focal=True, distortion=True, extrinsics=True)
        problem, start = replace(problem, free=free), disturbed_rig(problem, truth, twist=0.005, turn=0.005)
    else:
        problem, truth = problem_of(KINDS[5], num_frames=5, height=11, width=27, reach=2)
        start = disturbed(truth)
    problem, start = float32(with_noise(problem, 0.3), start)
    options = Options(max_iterations=3)
    expected = emulated(problem, start, options)
    assert all(same(emulated(problem, start, options, order), expected) for order in range(1, ORDERS))
    edges = problem.edges
    shuffled = torch.randperm(len(edges.source), generator=torch.Generator().manual_seed(0))
    edges = Edges(*(x[shuffled] for x in (edges.source, edges.target, edges.target_px, edges.weight)))
    assert same(emulated(replace(problem, edges=edges), start, options), expected)
    # As a frame with many edges has it.
    monkeypatch.setattr(layout, "_MAX_SHARED_FLOATS", 0)
    cuda_solver._layout.cache_clear()
    assert same(emulated(problem, start, options), expected)


def _halves(problem: Problem, state: State) -> tuple[Problem, State]:
    edges = problem.edges
    twice = (torch.cat((x, x)) for x in (edges.source, edges.target, edges.target_px))
    return replace(problem, edges=Edges(*twice, torch.cat((edges.weight, edges.weight)) / 2)), state


def _elsewhere(problem: Problem, state: State) -> tuple[Problem, State]:
    return problem, replace(state, cam_from_world=state.cam_from_world @ _MOVED)


def _larger(problem: Problem, state: State) -> tuple[Problem, State]:
    poses = state.cam_from_world.clone()
    poses[:, :3, 3] *= 4
    return problem, replace(state, cam_from_world=poses, inverse_depth=state.inverse_depth / 4)


_MOVED = se3.exp(torch.tensor([1.0, -2.0, 0.5, 0.3, -0.2, 0.4], dtype=torch.float64))


@pytest.mark.parametrize("change", [_halves, _elsewhere, _larger])
def test_what_must_not_matter(change: Callable[[Problem, State], tuple[Problem, State]]) -> None:
    """An edge or two of half its weight, where the world's origin is, and the unit of length."""
    problem, truth = problem_of(FOCAL, num_frames=5, height=6, width=11)
    problem, start = float32(with_noise(problem, 0.3), disturbed(truth))
    # The scale is free: damping alone decides along it.
    problem = replace(problem, free=replace(problem.free, poses=torch.arange(5) > 1))
    options = Options(max_iterations=4)
    expected, found = emulated(problem, start, options), emulated(*change(problem, start), options)
    _, moved = change(problem, expected.state)
    assert (found.status, found.iterations) == (expected.status, expected.iterations)
    assert found.cost == pytest.approx(expected.cost, rel=1e-4)
    assert (found.state.cam_from_world - moved.cam_from_world).abs().max() < 1e-3
    torch.testing.assert_close(found.state.inverse_depth, moved.inverse_depth, rtol=1e-3, atol=0)
    torch.testing.assert_close(found.state.intrinsics, moved.intrinsics, rtol=1e-4, atol=1e-5)


def test_a_frame_without_edges_changes_nothing() -> None:
    problem, truth = problem_of(FOCAL, num_frames=4, height=5, width=7)
    problem, start = float32(with_noise(problem, 0.3), disturbed(truth))
    # A frame that one edge leaves, and none reaches.
    edges = problem.edges
    use = (edges.source != 3) | (edges.target == 2)
    edges = Edges(*(x[use & (edges.target != 3)] for x in (edges.source, edges.target, edges.target_px, edges.weight)))
    problem = replace(problem, edges=edges)
    expected = emulated(problem, start, Options(max_iterations=3))
    assert_close(expected, solve(problem, start, Options(max_iterations=3)), rtol=1e-3)
    one_more = State(*(torch.cat((x, x[-1:])) for x in (start.cam_from_world, start.inverse_depth)), start.intrinsics)
    free = problem.free
    free = replace(free, poses=torch.cat((free.poses, free.poses[:1] | True)), inverse_depth=torch.ones(5) > 0)
    found = emulated(replace(problem, free=free), one_more, Options(max_iterations=3))
    assert torch.equal(found.state.cam_from_world[:4], expected.state.cam_from_world)
    assert torch.equal(found.state.cam_from_world[4], one_more.cam_from_world[4])
    assert torch.equal(found.state.inverse_depth[4], one_more.inverse_depth[4])
    assert found.cost == expected.cost


def test_a_lens_that_bends_much() -> None:
    """More than a parabolic mirror does, as fisheye lenses do."""
    problem, truth = scene("mei", num_frames=5, height=7, width=9, alpha=2.5, distortion_free=True)
    start = disturbed(truth, twist=0.01, depth=0.05, log_focal=0.02)
    start.intrinsics[4] += 0.05
    problem, start = float32(with_noise(problem, 0.1), start)
    options = Options(max_iterations=6)
    found = emulated(problem, start, options)
    assert_close(found, solve(problem, start, options), rtol=1e-3)
    assert float(found.state.intrinsics[4]) == pytest.approx(2.5, abs=0.02)


def test_a_frame_with_many_edges() -> None:
    problem, truth = problem_of(FOCAL, num_frames=28, height=4, width=5, reach=27)
    problem, start = float32(with_noise(problem, 0.2), disturbed(truth, log_focal=0.0))
    edges = problem.edges
    # The first frame sees all others; those see their neighbours.
    use = (edges.source == 3) | ((edges.source - edges.target).abs() == 1)
    edges = Edges(edges.source[use], edges.target[use], edges.target_px[use], edges.weight[use])
    problem, options = replace(problem, edges=edges), Options(max_iterations=2)
    assert_close(emulated(problem, start, options), solve(problem, start, options))


def test_many_poses_against_two_keyframes() -> None:
    """Motion only: more edges than a block of threads takes, no depth to eliminate, several tiles in the factor."""
    problem, truth = problem_of(PLAIN, num_frames=40, height=4, width=5, reach=39)
    free = torch.ones(40, dtype=torch.bool)
    free[[0, 20]] = False
    use = (~free)[problem.edges.source] & free[problem.edges.target]
    edges = problem.edges
    edges = Edges(edges.source[use], edges.target[use], edges.target_px[use], edges.weight[use])
    problem = replace(problem, edges=edges, free=Free(free, torch.zeros(40, dtype=torch.bool)))
    problem, start = float32(with_noise(problem, 0.1), disturbed(truth, twist=0.01, depth=0.0, log_focal=0.0))
    options = Options(max_iterations=3, robust="none")
    found = emulated(problem, start, options)
    assert_close(found, solve(problem, start, options))
    assert torch.equal(found.state.inverse_depth, start.inverse_depth)


def test_a_long_trajectory_with_a_loop() -> None:
    """The factor has more than one tile, levels and fill."""
    problem, truth = problem_of(PLAIN, num_frames=42, height=3, width=5, reach=2)
    edges = problem.edges
    loop = edges.target == 0
    target = torch.where(loop, 41, edges.target)
    use = target != edges.source
    problem = replace(
        problem, edges=Edges(edges.source[use], target[use], edges.target_px[use], edges.weight[use] * 0.1)
    )
    problem = with_depth_prior(problem, truth.inverse_depth, 1.0)
    problem, start = float32(problem, disturbed(truth, twist=0.005, depth=0.02, log_focal=0.0))
    options = Options(max_iterations=1, robust="none", initial_damping=1e-2)
    assert_close(emulated(problem, start, options), solve(problem, start, options))


@pytest.mark.parametrize("first", [math.inf, 40.0, 2.0])
@pytest.mark.parametrize("iterations", [0, 1, 2, 12])
@pytest.mark.parametrize("kind", [FOCAL, TRUNCATED])
def test_narrowing_kernels(first: float, iterations: int, kind: Specialisation) -> None:
    problem, truth = problem_of(kind, num_frames=4, height=5, width=6)
    problem = with_depth_prior(with_noise(problem, 0.3), truth.inverse_depth, 1.0)
    problem, start = float32(problem, disturbed(truth, twist=0.03, log_focal=0.05))
    options = Options(iterations, initial_scale_px=first, relative_tolerance=1e-3, robust=kind.robust)
    assert_close(emulated(problem, start, options), solve(problem, start, options), rtol=1e-3)


@pytest.mark.parametrize("robust", ["none", "huber", "cauchy", "geman_mcclure", "tukey", "truncated"])
def test_components_are_judged_each_for_itself(robust: RobustKernel) -> None:
    problem, truth = problem_of(COMPONENTS, num_frames=4, height=5, width=6)
    problem = with_depth_prior(with_noise(problem, 0.3), truth.inverse_depth, 1.0)
    start = disturbed(truth, twist=0.005, depth=0.02, log_focal=0.01)
    options = Options(1, robust=robust, componentwise=True, robust_scale_px=2.0, initial_damping=1e-3)
    step = oracle.newton_step(problem, start, options, options.initial_damping)
    result = emulated(*float32(problem, start), options)
    moved = se3.log(result.state.cam_from_world @ se3.inverse(start.cam_from_world))
    assert (moved - step.pose).norm() < 1e-3 * step.pose.norm()
    change = result.state.inverse_depth.double() - start.inverse_depth
    assert (change - step.inverse_depth).norm() < 1e-3 * step.inverse_depth.norm()
    # Lost measurements and graduation included.
    problem, start = float32(problem, disturbed(truth, twist=0.03, log_focal=0.05))
    options = replace(options, max_iterations=8, initial_scale_px=math.inf, relative_tolerance=1e-3)
    assert_close(emulated(problem, start, options), solve(problem, start, options), rtol=1e-3)


def test_exact_measurements_end() -> None:
    problem, truth = problem_of(PLAIN, num_frames=3, height=3, width=4)
    problem, start = float32(problem, truth)
    # Exact measurements: only rounding is left to descend.
    options = Options(max_iterations=40, robust="none", relative_tolerance=0.0)
    assert emulated(problem, start, options).status in (Status.CONVERGED, Status.NO_PROGRESS)


@pytest.mark.parametrize("kind", [FOCAL, TRUNCATED])
@pytest.mark.parametrize("where", ["pose", "depth", "intrinsics", "target", "weight", "prior", "prior_weight"])
def test_input_that_is_not_finite_is_refused(where: str, kind: Specialisation) -> None:
    problem, truth = problem_of(kind, num_frames=3)
    problem, state = float32(with_depth_prior(problem, truth.inverse_depth.float(), 1.0), truth)
    state = State(state.cam_from_world.clone(), state.inverse_depth.clone(), state.intrinsics.clone())
    tensor = {
        "pose": state.cam_from_world,
        "depth": state.inverse_depth,
        "intrinsics": state.intrinsics,
        "target": problem.edges.target_px,
        "weight": problem.edges.weight,
        "prior": problem.priors.inverse_depth,
        "prior_weight": problem.priors.inverse_depth_weight,
    }[where]
    assert tensor is not None
    for value in (math.nan, math.inf):
        tensor.view(-1)[5 % tensor.numel()] = value
        result = emulated(problem, state, Options(robust=kind.robust))
        assert result.status is Status.NON_FINITE
        assert result.state is state


def test_nothing_to_do() -> None:
    problem, start = float32(*problem_of(FOCAL, num_frames=3))
    unmeasured = replace(problem, edges=replace(problem.edges, weight=torch.zeros_like(problem.edges.weight)))
    assert emulated(unmeasured, start, Options()).status is Status.EMPTY
    fixed = torch.zeros(3, dtype=torch.bool)
    held = replace(problem, free=Free(fixed, fixed))
    assert emulated(held, start, Options(robust="none")).status is Status.EMPTY
    edges = problem.edges
    none = Edges(edges.source[:0], edges.target[:0], edges.target_px[:0], edges.weight[:0])
    answer = operator._on_gpu(*operator._arguments(replace(problem, edges=none), start, Options()))
    assert result_of(answer, start).status is Status.EMPTY


def test_what_a_gpu_is_checked_with_holds_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """The comparison of `benchmarks.gpu_checks`, on those of its shapes that the kernels here are compiled for."""
    shapes = [case for case in gpu_checks._shapes() if cuda_solver.specialisation(*case) in KINDS]
    assert all(
        any(cuda_solver.specialisation(*case) == kind for case in shapes) for kind in (*APART, POINTS, COMPONENTS)
    )
    small = [min(shapes, key=lambda case: case[1].inverse_depth.numel()), shapes[-1]]
    monkeypatch.setattr(gpu_checks, "_shapes", lambda: small)
    monkeypatch.setattr(gpu_checks, "_device", lambda: torch.device("cpu"))
    monkeypatch.setattr(gpu_checks, "_kernels", emulated)
    assert gpu_checks.check_correct().startswith("pose")


def test_a_run_can_be_repeated_on_new_values() -> None:
    """What a replayed CUDA graph does: the same launches after the tensors were overwritten in place."""
    problem, truth = problem_of(FOCAL, num_frames=4, height=6, width=9)
    problem, start = float32(with_noise(problem, 0.2), disturbed(truth))
    options = Options(max_iterations=3)
    launcher = EmulatedLauncher(cuda_solver.specialisation(problem, start, options), KINDS)
    adjustment = cuda_solver.Adjustment(problem, start, options, launcher)
    adjustment.run()
    expected, launched = result_of(adjustment.answer(), start), list(launcher.launched)
    problem.edges.weight.mul_(0.0)
    adjustment.run()
    assert result_of(adjustment.answer(), start).status is Status.EMPTY
    assert launcher.launched == launched
    problem, _ = float32(with_noise(problem_of(FOCAL, num_frames=4, height=6, width=9)[0], 0.2), disturbed(truth))
    adjustment._problem.edges.weight.copy_(problem.edges.weight)
    adjustment.run()
    assert same(result_of(adjustment.answer(), start), expected)


def test_the_context_is_mirrored_in_order() -> None:
    source = (resources.files("vipe_core.ba.cuda") / "kernels" / "context.cu").read_text()
    body = source[source.index("struct Context {") :]
    body = re.sub(r"//[^\n]*", "", body[body.index("{") + 1 : body.index("};")])
    names = re.findall(r"(\w+)\s*[,;]", body)
    assert names == [name for name, *_ in Context._fields_]
