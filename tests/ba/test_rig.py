"""Bundle adjustment of rigs against the dense oracle, and what a rig must keep."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from ba_scenes import with_depth_prior, with_noise
from hypothesis import given, settings
from hypothesis import strategies as st
from rig_scenes import disturbed_rig, rig_scene

from vipe_core.ba import Edges, Options, Priors, Problem, State, Status, Step, newton_step, oracle, solve
from vipe_core.ba.host_solver import HostSolver
from vipe_core.ba.torch_solver import TorchSolver
from vipe_core.cameras import CameraModel
from vipe_core.geometry import se3

_STEP = ("pose", "extrinsic", "log_focal", "alpha", "inverse_depth", "predicted_drop")


def relative_error(actual: torch.Tensor, expected: torch.Tensor) -> float:
    return float((actual - expected).norm() / expected.norm().clamp_min(1e-300))


def assert_same_step(actual: Step, expected: Step, tolerance: float) -> None:
    assert bool(actual.factorised)
    for name in _STEP:
        assert relative_error(getattr(actual, name), getattr(expected, name)) < tolerance, name


@st.composite
def rig_problems(draw: st.DrawFn) -> tuple[Problem, State]:
    """Anything that a rig problem may hold; extrinsics are free with and without a prior."""
    model: CameraModel = "mei" if draw(st.booleans()) else "pinhole"
    problem, truth = rig_scene(
        model,
        num_poses=draw(st.integers(2, 4)),
        num_views=draw(st.integers(1, 3)),
        own_intrinsics=draw(st.booleans()),
        seed=draw(st.integers(0, 1000)),
        height=3,
        width=4,
    )
    assert truth.cam_from_rig is not None
    extrinsics = draw(st.booleans())
    num_frames = len(truth.cam_from_world)
    fixed_depth = draw(st.lists(st.integers(0, num_frames - 1), max_size=3))
    depths = torch.ones(num_frames, dtype=torch.bool)
    depths[fixed_depth] = False
    free = replace(
        problem.free,
        inverse_depth=depths,
        focal=draw(st.booleans()),
        distortion=draw(st.booleans()),
        extrinsics=extrinsics,
    )
    prior = Priors(
        log_focal=draw(st.sampled_from([None, 4.0])),
        log_focal_sigma=0.1,
        cam_from_rig=se3.exp(torch.full((1, 6), 0.01, dtype=torch.float64)) @ truth.cam_from_rig,
        extrinsic_sigma=torch.tensor([[0.1, 0.05]], dtype=torch.float64).expand(len(truth.cam_from_rig), 2),
    )
    problem = replace(with_noise(problem, 0.05), free=free, priors=prior)
    if draw(st.booleans()):
        problem = with_depth_prior(problem, truth.inverse_depth * 1.05, 0.5)
    return problem, disturbed_rig(problem, truth, twist=2e-3, turn=2e-3 * extrinsics)


@settings(max_examples=15, deadline=None)
@given(rig_problems(), st.sampled_from([0.0, 1e-3]))
def test_steps_equal_the_dense_oracle(case: tuple[Problem, State], damping: float) -> None:
    problem, state = case
    options = Options(robust="geman_mcclure", robust_scale_px=0.3)
    # Focal lengths and alpha of a few cells are hardly determined: some damping keeps the comparison meaningful.
    damping = max(damping, 1e-6)
    expected = oracle.newton_step(problem, state, options, damping)
    solver = TorchSolver(problem, options, state)
    assert_same_step(solver.step(solver.linearise(state, options.robust_scale_px), damping), expected, 1e-7)
    assert_same_step(newton_step(problem, state, options, damping), expected, 1e-7)


def test_frames_of_one_pose_stay_rigid_and_exact_data_is_solved() -> None:
    problem, truth = rig_scene(num_views=3, own_intrinsics=True)
    problem = replace(problem, free=replace(problem.free, extrinsics=True))
    start = disturbed_rig(problem, truth, turn=0.02)
    result = solve(problem, start, Options(max_iterations=40, relative_tolerance=1e-10))
    assert result.status is Status.CONVERGED
    assert problem.rig is not None
    assert result.state.cam_from_rig is not None
    torch.testing.assert_close(result.state.cam_from_world, truth.cam_from_world, rtol=0, atol=1e-6)
    torch.testing.assert_close(result.state.cam_from_rig, truth.cam_from_rig, rtol=0, atol=1e-6)
    rig_from_world = se3.inverse(result.state.cam_from_rig[problem.rig.view_of_frame]) @ result.state.cam_from_world
    one_each = rig_from_world.reshape(-1, 3, 4, 4)
    torch.testing.assert_close(one_each, one_each[:, :1].expand_as(one_each), rtol=0, atol=1e-12)
    assert start.cam_from_rig is not None
    assert torch.equal(result.state.cam_from_rig[0], start.cam_from_rig[0])


@pytest.mark.parametrize("single_camera", [True, False])
def test_the_covariance_of_extrinsics_is_how_far_a_prior_pulls_them(single_camera: bool) -> None:
    """A prior with information P that moves by x takes the extrinsics along by covariance P x; by both solvers."""
    problem, truth = rig_scene(num_views=3, own_intrinsics=not single_camera)
    assert truth.cam_from_rig is not None
    shift = torch.zeros(3, 6, dtype=torch.float64)
    shift[1] = 1e-6 * torch.tensor([1.0, -2.0, 0.5, 2.0, 1.0, -1.0])
    sigma = torch.tensor([[1.0, 1.0], [0.02, 0.01], [0.03, 0.02]], dtype=torch.float64)
    priors = Priors(cam_from_rig=se3.exp(shift) @ truth.cam_from_rig, extrinsic_sigma=sigma)
    free = replace(problem.free, extrinsics=True, focal=not single_camera)
    problem = replace(problem, priors=priors, free=free)
    step = newton_step(problem, truth, damping=1e-9).extrinsic
    result = solve(problem, truth, Options(max_iterations=1, robust="none"))
    assert step is not None
    assert result.extrinsic_covariances is not None
    information = sigma[1].repeat_interleave(3).square().reciprocal()
    expected = result.extrinsic_covariances[1] @ (information * shift[1])
    torch.testing.assert_close(step[1], expected, rtol=1e-4, atol=1e-10)
    assert torch.equal(result.extrinsic_covariances[0], torch.zeros(6, 6, dtype=torch.float64))
    assert (result.extrinsic_covariances[2].diagonal() < sigma[2].repeat_interleave(3).square()).all()


def test_edges_within_an_instant_find_depth_but_no_pose() -> None:
    """With known extrinsics they are stereo: metric depth, and nothing about where the rig is."""
    problem, truth = rig_scene(num_views=2)
    assert problem.rig is not None
    edges, pose = problem.edges, problem.rig.pose_of_frame
    within = pose[edges.source] == pose[edges.target]
    edges = Edges(edges.source[within], edges.target[within], edges.target_px[within], edges.weight[within])
    problem = replace(problem, edges=edges, free=replace(problem.free, poses=torch.ones_like(problem.free.poses)))
    start = disturbed_rig(replace(problem, free=replace(problem.free, poses=pose < 0)), truth)
    result = solve(problem, start, Options(max_iterations=40, relative_tolerance=1e-10))
    assert torch.equal(result.state.cam_from_world, start.cam_from_world)
    measured = torch.zeros_like(truth.inverse_depth, dtype=torch.bool)
    for source, weight in zip(edges.source.tolist(), edges.weight, strict=True):
        measured[source] |= weight.amin(-1) > 0
    assert measured.float().mean() > 0.5
    torch.testing.assert_close(result.state.inverse_depth[measured], truth.inverse_depth[measured], rtol=1e-5, atol=0)


def test_a_rig_of_one_camera_is_the_camera_alone() -> None:
    problem, truth = rig_scene(num_views=1)
    problem = with_noise(problem, 0.05)
    start = disturbed_rig(problem, truth, twist=2e-3)
    alone = newton_step(replace(problem, rig=None), replace(start, cam_from_rig=None))
    together = newton_step(problem, start)
    assert relative_error(together.pose, alone.pose) < 1e-10
    assert relative_error(together.inverse_depth, alone.inverse_depth) < 1e-10


def test_single_precision_agrees_with_double() -> None:
    problem, truth = rig_scene(num_views=3, own_intrinsics=True)
    problem = with_noise(problem, 0.05)
    state = disturbed_rig(problem, truth, twist=2e-3)
    options = Options(robust_scale_px=0.3)
    single = replace(state, inverse_depth=state.inverse_depth.float())
    actual, expected = newton_step(problem, single, options, 1e-4), newton_step(problem, state, options, 1e-4)
    assert relative_error(actual.pose, expected.pose) < 1e-3
    assert relative_error(actual.inverse_depth.double(), expected.inverse_depth) < 1e-3


def test_a_pose_that_is_free_in_one_view_only_is_refused() -> None:
    problem, state = rig_scene(num_views=2)
    poses = problem.free.poses.clone()
    poses[0] = True
    with pytest.raises(ValueError, match="rig pose"):
        HostSolver(replace(problem, free=replace(problem.free, poses=poses)), Options(), state)
