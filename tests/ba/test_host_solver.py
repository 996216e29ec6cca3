"""The compiled solver against the torch solver and a dense reduced system, over everything a problem may hold."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from ba_scenes import disturbed, float32, scene, with_depth_prior, with_noise
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from vipe_core import compilation
from vipe_core.ba import Edges, Free, Options, Problem, State, Status, block_cholesky, levenberg, solve
from vipe_core.ba.host_solver import HostSolver
from vipe_core.ba.problem import RobustKernel
from vipe_core.ba.torch_solver import TorchSolver
from vipe_core.cameras import CameraModel

KERNELS = ["none", "huber", "cauchy", "geman_mcclure", "tukey"]


def relative_error(actual: torch.Tensor, expected: torch.Tensor) -> float:
    return float((actual - expected).norm() / expected.norm().clamp_min(1e-12))


@st.composite
def problems(draw: st.DrawFn) -> tuple[Problem, State]:
    """Anything that is free or held, seen or not: float64."""
    model = draw(st.sampled_from(["pinhole", "mei"]))
    num_frames, seed = draw(st.integers(2, 7)), draw(st.integers(0, 1000))
    shape = draw(st.sampled_from([(3, 4), (5, 7), (17, 19)]))  # the last fills more than one tile
    problem, truth = scene(model, num_frames, *shape, reach=draw(st.integers(1, 3)), seed=seed)
    state = disturbed(truth, seed=seed, twist=5e-3, depth=0.05, log_focal=0.02)
    flags = st.lists(st.booleans(), min_size=num_frames, max_size=num_frames).map(torch.tensor)
    free = Free(draw(flags), draw(flags), focal=draw(st.booleans()), distortion=draw(st.booleans()))
    problem = replace(with_noise(problem, 0.1, seed), free=free)
    if draw(st.booleans()):
        problem = with_depth_prior(problem, truth.inverse_depth, 0.3)
    if draw(st.booleans()):
        problem = replace(problem, priors=replace(problem.priors, log_focal=4.0, log_focal_sigma=0.1))
    edges = problem.edges
    weight = edges.weight.clone()
    if draw(st.booleans()):  # measurements without weight, in one component or both
        weight[torch.rand(weight.shape, generator=torch.Generator().manual_seed(seed)) < 0.3] = 0
    edges = replace(edges, weight=weight)
    if draw(st.booleans()):  # points behind the cameras that look back
        near = state.inverse_depth.clone()
        near[:, : shape[1]] = 40.0
        state = replace(state, inverse_depth=near)
    if num_frames > 2 and draw(st.booleans()):  # a frame that nothing touches
        keep = (edges.source != 1) & (edges.target != 1)
        edges = Edges(edges.source[keep], edges.target[keep], edges.target_px[keep], edges.weight[keep])
    if len(edges.source) and draw(st.booleans()):  # the same measurement twice
        again = torch.cat((torch.arange(len(edges.source)), torch.tensor([0])))
        edges = Edges(edges.source[again], edges.target[again], edges.target_px[again], edges.weight[again])
    return replace(problem, edges=edges), state


def assert_same(problem: Problem, state: State, options: Options, damping: float, tolerance: float) -> None:
    host, device = HostSolver(problem, options, state), TorchSolver(problem, options, state)
    scale_px = options.robust_scale_px
    assert host.anything_free == device.anything_free
    assert host.intrinsics_free == device.intrinsics_free
    actual, expected = host.linearise(state, scale_px), device.linearise(state, scale_px)
    for ours, theirs in (
        (actual.cost, expected.cost),
        (host.cost(state, scale_px), device.cost(state, scale_px)),
        (actual.cost, host.cost(state, scale_px)),
    ):
        for name in ("measurements", "weight", "priors"):
            assert relative_error(getattr(ours, name), getattr(theirs, name)) < tolerance, name
        assert abs(ours.lost_weight - theirs.lost_weight) <= tolerance * theirs.weight
    # Least damped, the system's condition is about 1e7 on the worst of these scenes.
    of_step = 1e4 * tolerance
    mine, other = host.step(actual, damping), device.step(expected, damping)
    assert mine.factorised == other.factorised
    for name in ("pose", "log_focal", "alpha", "inverse_depth", "predicted_drop"):
        assert relative_error(getattr(mine, name), getattr(other, name)) < of_step, name
    moved, theirs_moved = host.retract(state, mine), device.retract(state, other)
    assert relative_error(moved.cam_from_world, theirs_moved.cam_from_world) < of_step
    assert relative_error(moved.inverse_depth, theirs_moved.inverse_depth) < of_step
    held = ~host.retract(state, mine).inverse_depth.ne(state.inverse_depth).any(1)
    assert held[~problem.free.inverse_depth].all()


@settings(max_examples=25, deadline=None)
@given(problems(), st.sampled_from(KERNELS), st.sampled_from([0.2, 3.0]), st.sampled_from([1e-3, 0.1, 10.0]))
def test_any_problem_gives_the_step_of_the_torch_solver(
    drawn: tuple[Problem, State], robust: RobustKernel, scale_px: float, damping: float
) -> None:
    problem, state = drawn
    options = Options(robust=robust, robust_scale_px=scale_px)
    assert_same(problem, state, options, damping, 1e-12)


@pytest.mark.parametrize("robust", KERNELS)
@pytest.mark.parametrize("camera_model", ["pinhole", "mei"])
def test_single_precision_is_as_good_as_the_torch_solver_s(camera_model: CameraModel, robust: RobustKernel) -> None:
    problem, truth = scene(camera_model, height=24, width=32, distortion_free=True)
    problem = with_depth_prior(with_noise(problem, 0.1), truth.inverse_depth, 0.05)
    state = disturbed(truth, twist=2e-3, depth=0.02, log_focal=0.01)
    options = Options(robust=robust, robust_scale_px=1.0)
    exact = HostSolver(problem, options, state)
    single = HostSolver(*(lambda p, s: (p, options, s))(*float32(problem, state)))
    expected = exact.step(exact.linearise(state, 1.0), 1e-3)
    actual = single.step(single.linearise(float32(problem, state)[1], 1.0), 1e-3)
    assert actual.inverse_depth.dtype == torch.float32
    assert relative_error(actual.pose, expected.pose) < 1e-4
    assert relative_error(actual.log_focal, expected.log_focal) < 1e-4
    assert relative_error(actual.inverse_depth.double(), expected.inverse_depth) < 1e-4
    assert relative_error(actual.predicted_drop, expected.predicted_drop) < 1e-5


@pytest.mark.parametrize("camera_model", ["pinhole", "mei"])
def test_whole_solves_agree(monkeypatch: pytest.MonkeyPatch, camera_model: CameraModel) -> None:
    problem, truth = scene(camera_model, distortion_free=camera_model == "mei")
    problem, start = with_noise(problem, 0.1), disturbed(truth)
    host = solve(problem, start)
    monkeypatch.setattr(levenberg, "_solver", TorchSolver)
    other = solve(problem, start)
    assert host.status is other.status
    assert host.iterations == other.iterations
    torch.testing.assert_close(host.state.cam_from_world, other.state.cam_from_world, rtol=0, atol=1e-8)
    torch.testing.assert_close(host.state.inverse_depth, other.state.inverse_depth, rtol=1e-7, atol=0)
    np.testing.assert_allclose(host.intrinsics_covariance, other.intrinsics_covariance, rtol=1e-6)


def test_threads_do_not_change_a_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, truth = scene("pinhole", num_frames=9, height=6, width=8)
    problem, start = float32(with_noise(problem, 0.3), disturbed(truth))
    alone = solve(problem, start)
    monkeypatch.setattr("vipe_core.ba.host_solver._CELLS_PER_THREAD", 1)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 3)
    together = solve(problem, start)
    assert torch.equal(alone.state.cam_from_world, together.state.cam_from_world)
    assert torch.equal(alone.state.inverse_depth, together.state.inverse_depth)
    assert alone.cost == together.cost


def loop_problem(num_frames: int, chords: int) -> tuple[Problem, State]:
    """A closed loop of cameras with edges across it: far off-diagonal blocks, and fill."""
    problem, truth = scene("pinhole", num_frames=num_frames, height=3, width=4, reach=1)
    rng = np.random.default_rng(5)
    pairs = {(i, (i + k) % num_frames) for i in range(num_frames) for k in (-2, -1, 1, 2)}
    pairs |= {(int(i), int(j)) for i, j in rng.integers(0, num_frames, (chords, 2)) if i != j}
    source, target = torch.tensor(sorted(pairs)).T.contiguous()
    angle = torch.arange(num_frames, dtype=torch.float64) / num_frames * 2 * torch.pi
    poses = truth.cam_from_world.clone()
    poses[:, 0, 3], poses[:, 1, 3], poses[:, 2, 3] = 0.2 * angle.cos(), 0.2 * angle.sin(), 0
    truth = replace(truth, cam_from_world=poses)
    from vipe_core.ba import reproject

    target_px, valid = reproject("pinhole", problem.grid, truth, source, target)
    weight = torch.ones_like(target_px) * valid[..., None]
    problem = replace(problem, edges=Edges(source, target, target_px, weight))
    return with_noise(problem, 0.1), disturbed(truth, twist=2e-3, depth=0.02, log_focal=0.01)


def test_loops_are_solved_exactly_by_the_sparse_system() -> None:
    problem, state = loop_problem(60, 25)
    assert_same(problem, state, Options(), 1e-4, 1e-12)


def test_memory_of_the_reduced_system_is_linear_in_a_long_chain() -> None:
    sizes = []
    for num_frames in (50, 100, 200):
        problem, state = scene("pinhole", num_frames=num_frames, height=1, width=2)
        sizes.append(HostSolver(problem, Options(), state).linearise(state, 3.0).direct.nbytes)
    # The same band, so every further frame costs the same.
    assert sizes[2] - sizes[1] == 2 * (sizes[1] - sizes[0])


@st.composite
def block_systems(draw: st.DrawFn) -> tuple[int, list[list[int]], int, NDArray[np.float64]]:
    """Cliques, and a random definite matrix with just their blocks (nodes in their own order)."""
    num_nodes, seed = draw(st.integers(1, 12)), draw(st.integers(0, 10_000))
    node = st.integers(0, num_nodes - 1)
    cliques = draw(st.lists(st.lists(node, min_size=1, max_size=4), max_size=14))
    dense_last = draw(st.integers(0, 3))
    total = num_nodes + dense_last
    rng = np.random.default_rng(seed)
    matrix = np.eye(6 * total)
    members = [*cliques, *([k, *range(num_nodes, total)] for k in range(num_nodes) if dense_last)]
    for clique in members:
        rows = np.concatenate([np.arange(6 * k, 6 * k + 6) for k in sorted(set(clique))])
        factor = rng.normal(size=(len(rows), 4))
        matrix[np.ix_(rows, rows)] += factor @ factor.T
    return num_nodes, cliques, dense_last, matrix


def blocks_of(structure: block_cholesky.Structure, matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """The lower blocks of a matrix in the structure, which must hold all of it."""
    node = np.argsort(structure.place)
    blocks = np.empty((structure.num_blocks, 6, 6))
    left = matrix.copy()
    for column in range(structure.num_nodes):
        for p in range(structure.first[column], structure.first[column + 1]):
            i, j = 6 * node[structure.rows[p]], 6 * node[column]
            blocks[p] = matrix[i : i + 6, j : j + 6]
            left[i : i + 6, j : j + 6] = left[j : j + 6, i : i + 6] = 0
    assert not left.any()
    return blocks


@settings(max_examples=60, deadline=None)
@given(block_systems())
def test_sparse_factor_solves_like_a_dense_one(
    system: tuple[int, list[list[int]], int, NDArray[np.float64]],
) -> None:
    num_nodes, cliques, dense_last, matrix = system
    structure = block_cholesky.analyse(num_nodes, cliques, dense_last)
    right = np.random.default_rng(0).normal(size=(structure.num_nodes, 6))
    expected = np.linalg.solve(matrix, right.ravel()).reshape(-1, 6)
    factor = blocks_of(structure, matrix)
    assert block_cholesky.factorise(structure.first, structure.rows, factor)
    solution = np.empty_like(right)
    solution[structure.place] = right
    block_cholesky.substitute(structure.first, structure.rows, factor, solution)
    np.testing.assert_allclose(solution[structure.place], expected, rtol=1e-7, atol=1e-9)
    indefinite = matrix - (np.linalg.eigvalsh(matrix)[0] + 1e-3) * np.eye(len(matrix))
    assert not block_cholesky.factorise(structure.first, structure.rows, blocks_of(structure, indefinite))


def test_a_trajectory_has_no_fill() -> None:
    cliques = [list(range(k, k + 4)) for k in range(97)]
    structure = block_cholesky.analyse(100, cliques, dense_last=0)
    assert structure.num_blocks == 100 + 99 + 98 + 97


def test_a_cache_that_cannot_be_written_is_no_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    real = compilation.njit

    def refusing(*, cache: bool = False, **options: object) -> object:
        def decorate(function: object) -> object:
            if cache:
                raise RuntimeError("cannot cache function: no locator available")
            return real(**options)(function)

        return decorate

    monkeypatch.setattr(compilation, "njit", refusing)

    @compilation.vectorised
    def twice(x: float) -> float:
        return 2 * x

    assert twice(3.0) == 6.0


def test_a_solved_problem_costs_no_step() -> None:
    problem, truth = scene("pinhole")
    problem = with_noise(problem, 0.2)
    options = Options(max_iterations=50, relative_tolerance=1e-5)
    first = solve(problem, disturbed(truth), options)
    assert first.iterations > 2
    again = solve(problem, first.state, replace(options, relative_tolerance=1e-4))
    assert again.status is Status.CONVERGED
    assert again.iterations == 0
    assert torch.equal(again.state.cam_from_world, first.state.cam_from_world)
    assert again.cost == pytest.approx(first.cost)
