"""The solver's step against a dense automatic-differentiation Gauss-Newton step, and its invariances."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from ba_scenes import disturbed, float32, scene, with_depth_prior, with_noise

from vipe_core.ba import Edges, Free, Options, Priors, Problem, State, Step, newton_step, oracle, residuals
from vipe_core.ba.host_solver import HostSolver
from vipe_core.ba.problem import RobustKernel
from vipe_core.ba.robust import cost as robust_cost
from vipe_core.ba.torch_solver import TorchSolver
from vipe_core.cameras import CameraModel


def relative_error(actual: torch.Tensor, expected: torch.Tensor) -> float:
    return float((actual - expected).norm() / expected.norm().clamp_min(1e-300))


def assert_same_step(actual: Step, expected: Step, tolerance: float) -> None:
    assert bool(actual.factorised)
    for name in ("pose", "log_focal", "alpha", "inverse_depth", "predicted_drop"):
        assert relative_error(getattr(actual, name), getattr(expected, name)) < tolerance, name
    assert expected.predicted_drop > 0


def small_problem(camera_model: CameraModel, **kwargs: bool) -> tuple[Problem, State]:
    """Noise small enough that the clamps on log f and alpha stay out of the way; two poses hold the scale."""
    problem, truth = scene(camera_model, **kwargs)
    poses = problem.free.poses.clone()
    poses[1] = False
    problem = replace(with_noise(problem, 0.05), free=replace(problem.free, poses=poses))
    return problem, disturbed(truth, twist=2e-3, depth=0.02, log_focal=0.01)


def torch_step(problem: Problem, state: State, options: Options, damping: float = 0.0) -> Step:
    solver = TorchSolver(problem, options, state)
    return solver.step(solver.linearise(state, options.robust_scale_px), damping)


@pytest.mark.parametrize("damping", [0.0, 1e-3, 10.0])
@pytest.mark.parametrize("robust", ["none", "huber", "cauchy", "geman_mcclure", "tukey"])
@pytest.mark.parametrize("camera_model", ["pinhole", "mei"])
def test_step_equals_the_dense_oracle(camera_model: CameraModel, robust: RobustKernel, damping: float) -> None:
    problem, state = small_problem(camera_model, distortion_free=camera_model == "mei")
    options = Options(robust=robust, robust_scale_px=0.3)
    expected = oracle.newton_step(problem, state, options, damping)
    assert_same_step(newton_step(problem, state, options, damping), expected, 1e-10)
    assert_same_step(torch_step(problem, state, options, damping), expected, 1e-10)


@pytest.mark.parametrize("robust", ["none", "huber", "cauchy", "geman_mcclure", "tukey", "truncated"])
@pytest.mark.parametrize("camera_model", ["pinhole", "mei"])
def test_components_are_judged_each_for_itself(camera_model: CameraModel, robust: RobustKernel) -> None:
    problem, state = small_problem(camera_model, distortion_free=camera_model == "mei")
    options = Options(robust=robust, componentwise=True, robust_scale_px=0.3)
    expected = oracle.newton_step(problem, state, options, 1e-3)
    assert_same_step(newton_step(problem, state, options, 1e-3), expected, 1e-10)
    assert_same_step(torch_step(problem, state, options, 1e-3), expected, 1e-10)
    of_norm = newton_step(problem, state, replace(options, componentwise=False), 1e-3)
    assert (relative_error(of_norm.pose, expected.pose) > 1e-3) is (robust != "none")
    # The cost is rho, not the weights that stand for it.
    error, valid = residuals(problem, state)
    judged = robust_cost(robust, 0.3, error.square()) * problem.edges.weight * valid[..., None]
    for kind in (HostSolver, TorchSolver):
        cost = kind(problem, options, state).cost(state, 0.3)
        assert float(cost.measurements) == pytest.approx(float(judged.sum()), rel=1e-9)
        assert float(cost.weight) == pytest.approx(float((problem.edges.weight.amax(-1) * valid).sum()), rel=1e-9)


@pytest.mark.parametrize("robust", ["cauchy", "truncated"])
def test_with_one_component_the_norm_is_it(robust: RobustKernel) -> None:
    problem, state = small_problem("pinhole")
    weight = problem.edges.weight.clone()
    weight[::2, :, 0] = 0
    weight[1::2, :, 1] = 0
    problem = replace(problem, edges=replace(problem.edges, weight=weight))
    options = Options(robust=robust, robust_scale_px=0.3)
    apart = newton_step(problem, state, replace(options, componentwise=True), 1e-3)
    assert_same_step(apart, newton_step(problem, state, options, 1e-3), 1e-10)


@pytest.mark.parametrize("camera_model", ["pinhole", "mei"])
def test_priors_enter_the_step(camera_model: CameraModel) -> None:
    problem, state = small_problem(camera_model)
    without = newton_step(problem, state)
    problem = with_depth_prior(problem, state.inverse_depth * 1.05, 3.0)
    prior_log_focal = float(state.intrinsics[0].log()) + 0.02
    problem = replace(problem, priors=replace(problem.priors, log_focal=prior_log_focal, log_focal_sigma=0.02))
    actual = newton_step(problem, state)
    assert_same_step(actual, oracle.newton_step(problem, state, Options()), 1e-10)
    assert relative_error(actual.inverse_depth, without.inverse_depth) > 0.1


@pytest.mark.parametrize("freedom", ["poses", "depth", "focal", "motion", "some_depth", "no_pose", "alpha_only"])
def test_fixed_parameters_do_not_move_and_the_rest_is_exact(freedom: str) -> None:
    problem, state = small_problem("mei", distortion_free=True)
    num_frames = len(state.cam_from_world)
    all_free, none_free = torch.ones(num_frames, dtype=torch.bool), torch.zeros(num_frames, dtype=torch.bool)
    alternate = torch.arange(num_frames) % 2 == 0
    free = {
        "poses": Free(problem.free.poses, none_free, True, True),
        "depth": Free(none_free, all_free),
        "focal": Free(none_free, none_free, True),
        "motion": Free(problem.free.poses, none_free),
        "some_depth": Free(problem.free.poses, alternate, True),
        "no_pose": Free(none_free, all_free, True, True),
        "alpha_only": Free(problem.free.poses, all_free, False, True),
    }[freedom]
    problem = replace(problem, free=free)
    step = newton_step(problem, state)
    assert_same_step(step, oracle.newton_step(problem, state, Options()), 1e-10)
    assert (step.pose[~free.poses] == 0).all()
    assert (step.inverse_depth[~free.inverse_depth] == 0).all()
    assert free.focal or step.log_focal == 0
    assert free.distortion or step.alpha == 0


def test_frames_without_edges_stay() -> None:
    problem, state = small_problem("pinhole")
    num_frames = len(state.cam_from_world)
    keep = (problem.edges.source != 4) & (problem.edges.target != 4)
    edges = problem.edges
    problem = replace(
        problem,
        edges=Edges(edges.source[keep], edges.target[keep], edges.target_px[keep], edges.weight[keep]),
    )
    step = newton_step(problem, state)
    assert (step.pose[4] == 0).all()
    assert (step.inverse_depth[4] == 0).all()
    assert_same_step(step, oracle.newton_step(problem, state, Options()), 1e-10)
    assert num_frames == 5


def test_points_behind_the_target_camera_do_not_count() -> None:
    problem, state = small_problem("pinhole")
    near = state.inverse_depth.clone()
    near[2, :10] = 40.0  # earlier cameras are about 0.1 further on, so z is far below the smallest ratio
    state = replace(state, inverse_depth=near)
    options = Options()
    actual = newton_step(problem, state, options)
    assert_same_step(actual, oracle.newton_step(problem, state, options), 1e-10)
    # Their edges to earlier frames are without effect, so these weights may be anything.
    back = (problem.edges.source == 2) & (problem.edges.target < 2)
    weight = problem.edges.weight.clone()
    weight[back, :10] *= 100
    changed = newton_step(replace(problem, edges=replace(problem.edges, weight=weight)), state, options)
    assert_same_step(changed, actual, 1e-12)


def test_order_of_edges_does_not_matter() -> None:
    problem, state = small_problem("pinhole")
    order = torch.randperm(len(problem.edges.source), generator=torch.Generator().manual_seed(3))
    edges = problem.edges
    shuffled = Edges(edges.source[order], edges.target[order], edges.target_px[order], edges.weight[order])
    first = newton_step(problem, state)
    second = newton_step(replace(problem, edges=shuffled), state)
    assert torch.equal(first.pose, second.pose)
    assert torch.equal(first.inverse_depth, second.inverse_depth)
    assert torch.equal(first.log_focal, second.log_focal)


def test_two_half_weights_are_one_weight() -> None:
    problem, state = small_problem("pinhole")
    edges = problem.edges
    weight = edges.weight.clone()
    weight[3] /= 2
    split = Edges(
        torch.cat((edges.source, edges.source[3:4])),
        torch.cat((edges.target, edges.target[3:4])),
        torch.cat((edges.target_px, edges.target_px[3:4])),
        torch.cat((weight, weight[3:4])),
    )
    assert_same_step(newton_step(replace(problem, edges=split), state), newton_step(problem, state), 1e-11)


def test_a_component_without_weight_has_no_say() -> None:
    """One-dimensional measurements (an edge of the image): the other component may be anything, even not a number."""
    problem, state = small_problem("pinhole")
    weight = problem.edges.weight.clone()
    weight[:, ::3, 1] = 0
    target_px = problem.edges.target_px.clone()
    clean = replace(problem, edges=replace(problem.edges, weight=weight))
    target_px[:, ::3, 1] = torch.nan
    dirty = replace(problem, edges=replace(problem.edges, weight=weight, target_px=target_px))
    options = Options(robust="geman_mcclure", robust_scale_px=0.2)
    assert_same_step(newton_step(dirty, state, options), oracle.newton_step(clean, state, options), 1e-10)


def test_world_frame_does_not_matter() -> None:
    problem, state = small_problem("pinhole")
    from vipe_core.geometry import se3

    world_from_new = se3.exp(torch.tensor([3.0, -2.0, 1.0, 0.4, 1.2, -0.3], dtype=torch.float64))
    moved = replace(state, cam_from_world=state.cam_from_world @ world_from_new)
    assert_same_step(newton_step(problem, moved), newton_step(problem, state), 1e-9)


@pytest.mark.parametrize("camera_model", ["pinhole", "mei"])
def test_single_precision_agrees_with_double(camera_model: CameraModel) -> None:
    problem, state = small_problem(camera_model)
    problem = with_depth_prior(problem, state.inverse_depth, 0.1)
    expected = newton_step(problem, state, Options(), 1e-4)
    actual = newton_step(*float32(problem, state), Options(), 1e-4)
    assert actual.inverse_depth.dtype == torch.float32
    assert relative_error(actual.pose, expected.pose) < 2e-3
    assert relative_error(actual.log_focal, expected.log_focal) < 2e-3
    assert relative_error(actual.inverse_depth.double(), expected.inverse_depth) < 2e-3


def test_recomputed_factors_equal_kept_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, state = small_problem("mei")
    kept = torch_step(problem, state, Options(), 1e-3)
    monkeypatch.setattr("vipe_core.ba.torch_solver._CPU_KEEP_BYTES", 0)
    again = torch_step(problem, state, Options(), 1e-3)
    assert torch.equal(kept.pose, again.pose)
    assert torch.equal(kept.inverse_depth, again.inverse_depth)


@pytest.mark.parametrize("cells", [1, 100, 1 << 22])
def test_chunk_size_does_not_matter(monkeypatch: pytest.MonkeyPatch, cells: int) -> None:
    """One frame per chunk, a few, and all frames in one padded chunk."""
    problem, state = small_problem("pinhole")
    expected = oracle.newton_step(problem, state, Options())
    monkeypatch.setattr("vipe_core.ba.plan._CPU_CHUNK_CELLS", cells)
    assert_same_step(torch_step(problem, state, Options()), expected, 1e-10)


def test_the_input_is_not_changed() -> None:
    problem, state = small_problem("pinhole")
    before = State(state.cam_from_world.clone(), state.inverse_depth.clone(), state.intrinsics.clone())
    newton_step(replace(problem, priors=Priors(log_focal=4.0)), state)
    assert torch.equal(before.cam_from_world, state.cam_from_world)
    assert torch.equal(before.inverse_depth, state.inverse_depth)
    assert torch.equal(before.intrinsics, state.intrinsics)
