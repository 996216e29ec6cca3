"""Whole solves: convergence, robustness, statuses."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from ba_scenes import disturbed, float32, scene, with_depth_prior, with_noise

from vipe_core.ba import Edges, Free, Options, Problem, Result, State, Status, reproject, residuals, solve
from vipe_core.ba.problem import RobustKernel
from vipe_core.cameras import CameraModel
from vipe_core.errors import ConfigError
from vipe_core.geometry import se3, umeyama


def position_error(result: Result, truth: State) -> float:
    """Largest distance of camera centres after aligning scale, relative to the extent of the path."""
    found = se3.inverse(result.state.cam_from_world)[:, :3, 3].numpy()
    expected = se3.inverse(truth.cam_from_world)[:, :3, 3].numpy()
    aligned = umeyama(found, expected).apply(found)
    return float(np.linalg.norm(aligned - expected, axis=1).max() / np.ptp(expected, axis=0).max())


@pytest.mark.parametrize("sign", [-1, 1])
@pytest.mark.parametrize("robust", ["none", "geman_mcclure"])
@pytest.mark.parametrize("camera_model", ["pinhole", "mei"])
def test_exact_measurements_give_the_exact_answer(camera_model: CameraModel, robust: RobustKernel, sign: int) -> None:
    problem, truth = scene(camera_model, num_frames=8, height=8, width=10, distortion_free=camera_model == "mei")
    start = disturbed(truth, depth=0.2, log_focal=sign * math.log(1.16))
    options = Options(max_iterations=40, robust=robust, robust_scale_px=10.0)
    result = solve(problem, start, options)
    assert result.status is Status.CONVERGED
    assert result.cost < 1e-10 < result.initial_cost
    torch.testing.assert_close(result.state.intrinsics, truth.intrinsics, rtol=1e-6, atol=0)
    assert position_error(result, truth) < 1e-6
    ratio = result.state.inverse_depth / truth.inverse_depth
    assert (ratio / ratio.mean() - 1).abs().max() < 1e-5
    assert torch.equal(result.state.cam_from_world[0], start.cam_from_world[0])


def test_single_precision_converges_to_the_same_answer() -> None:
    problem, truth = scene("pinhole", num_frames=8, height=8, width=10)
    problem = with_depth_prior(with_noise(problem, 0.1), truth.inverse_depth, 0.05)
    start = disturbed(truth, depth=0.2, log_focal=0.1)
    options = Options(max_iterations=30, relative_tolerance=1e-7)
    double = solve(problem, start, options)
    single = solve(*float32(problem, start), options)
    assert single.state.inverse_depth.dtype == torch.float32
    assert single.state.cam_from_world.dtype == torch.float64
    torch.testing.assert_close(single.state.intrinsics, double.state.intrinsics, rtol=1e-4, atol=0)
    torch.testing.assert_close(single.state.cam_from_world, double.state.cam_from_world, rtol=0, atol=1e-3)
    assert single.cost == pytest.approx(double.cost, rel=1e-3)
    assert single.log_focal_sigma == pytest.approx(double.log_focal_sigma, rel=1e-2)


def test_a_third_of_outliers_is_ignored() -> None:
    problem, truth = scene("pinhole", num_frames=6, height=8, width=10)
    problem = with_noise(problem, 0.1)
    rng = torch.Generator().manual_seed(4)
    outlier = torch.rand(problem.edges.target_px.shape[:2], generator=rng) < 0.3
    jump = 40 * torch.rand(problem.edges.target_px.shape, generator=rng, dtype=torch.float64) + 10
    target_px = torch.where(outlier[..., None], problem.edges.target_px + jump, problem.edges.target_px)
    problem = replace(problem, edges=replace(problem.edges, target_px=target_px))
    problem = with_depth_prior(problem, truth.inverse_depth.mean().expand_as(truth.inverse_depth), 1e-3)
    start = disturbed(truth, twist=0.01, depth=0.1, log_focal=0.03)

    robust = solve(problem, start, Options(max_iterations=60, robust="geman_mcclure", relative_tolerance=1e-6))
    plain = solve(problem, start, Options(max_iterations=60, robust="none", relative_tolerance=1e-6))
    assert position_error(robust, truth) < 0.02
    assert abs(float(robust.state.intrinsics[0] / truth.intrinsics[0]) - 1) < 0.02
    assert position_error(plain, truth) > 3 * position_error(robust, truth)


def test_motion_only_finds_many_poses_at_once() -> None:
    """Frames are posed against two keyframes whose depth, pose and camera are known."""
    problem, truth = scene("pinhole", num_frames=14, height=6, width=8, reach=13)
    free = torch.ones(14, dtype=torch.bool)
    free[[0, 13]] = False
    use = (~free)[problem.edges.source] & free[problem.edges.target]
    edges = problem.edges
    problem = Problem(
        "pinhole",
        problem.grid,
        Edges(edges.source[use], edges.target[use], edges.target_px[use], edges.weight[use]),
        Free(free, torch.zeros(14, dtype=torch.bool)),
    )
    start = disturbed(truth, twist=0.05, depth=0.0, log_focal=0.0)
    poses = start.cam_from_world.clone()
    poses[13] = truth.cam_from_world[13]
    result = solve(problem, replace(start, cam_from_world=poses), Options(max_iterations=20, robust="huber"))
    torch.testing.assert_close(result.state.cam_from_world, truth.cam_from_world, rtol=0, atol=1e-6)
    assert torch.equal(result.state.inverse_depth, start.inverse_depth)
    assert torch.equal(result.state.intrinsics, start.intrinsics)
    assert math.isnan(result.log_focal_sigma)


def test_depth_only_triangulates() -> None:
    problem, truth = scene("pinhole")
    fixed = torch.zeros(5, dtype=torch.bool)
    problem = replace(problem, free=Free(fixed, ~fixed))
    start = replace(truth, inverse_depth=truth.inverse_depth * 1.3)
    result = solve(problem, start, Options(max_iterations=20))
    torch.testing.assert_close(result.state.inverse_depth, truth.inverse_depth, rtol=1e-5, atol=0)


def test_pure_rotation_does_not_explode() -> None:
    """No depth can be seen; the poses must be right and nothing may run away."""
    problem, truth = scene("pinhole", focal_free=False)
    poses = truth.cam_from_world.clone()
    poses[:, :3, 3] = 0
    truth = replace(truth, cam_from_world=poses)
    edges = problem.edges
    target_px, valid = reproject("pinhole", problem.grid, truth, edges.source, edges.target)
    problem = replace(problem, edges=replace(edges, target_px=target_px, weight=edges.weight * valid[..., None]))
    problem = with_depth_prior(with_noise(problem, 0.1), truth.inverse_depth, 1.0)
    result = solve(problem, disturbed(truth, twist=0.01, log_focal=0.0), Options(max_iterations=30))
    assert result.cost < result.initial_cost
    turned = se3.log_rotation(result.state.cam_from_world[:, :3, :3] @ truth.cam_from_world[:, :3, :3].mT)
    assert turned.norm(dim=-1).max() < 5e-3
    assert result.state.cam_from_world[:, :3, 3].abs().max() < 0.1
    assert (result.state.inverse_depth / truth.inverse_depth - 1).abs().max() < 0.3


def test_priors_pull() -> None:
    """A camera that cannot see its focal length takes it from the prior."""
    problem, truth = scene("pinhole", num_frames=2)
    wanted = math.log(float(truth.intrinsics[0])) + 0.05
    strong = replace(problem, priors=replace(problem.priors, log_focal=wanted, log_focal_sigma=1e-5))
    result = solve(strong, truth, Options(max_iterations=40, relative_tolerance=1e-9))
    assert math.log(float(result.state.intrinsics[0])) == pytest.approx(wanted, abs=1e-3)
    assert result.log_focal_sigma == pytest.approx(1e-5, rel=1e-2)


def test_focal_sigma_predicts_the_scatter_of_the_estimate() -> None:
    problem, truth = scene("pinhole", num_frames=6, height=6, width=8)
    unit = replace(problem, edges=replace(problem.edges, weight=torch.full_like(problem.edges.weight, 1 / 0.1**2)))
    errors, sigmas = [], []
    for seed in range(40):
        result = solve(with_noise(unit, 0.1, seed), truth, Options(robust="none", relative_tolerance=1e-6))
        errors.append(math.log(float(result.state.intrinsics[0] / truth.intrinsics[0])))
        sigmas.append(result.log_focal_sigma)
    # 40 samples: the sample deviation is within 35 % of the truth in all but one of a thousand draws.
    assert np.std(errors) == pytest.approx(np.mean(sigmas), rel=0.35)


def test_cost_never_rises_and_iterations_are_bounded() -> None:
    problem, truth = scene("pinhole")
    problem = with_noise(problem, 2.0)
    start = disturbed(truth, twist=0.1, depth=0.5, log_focal=0.3)
    costs = [solve(problem, start, Options(max_iterations=n, robust="cauchy")).cost for n in range(6)]
    assert costs == sorted(costs, reverse=True)
    assert costs[-1] < costs[0]
    assert solve(problem, start, Options(max_iterations=3)).iterations <= 3


def test_same_input_gives_the_same_bits() -> None:
    problem, truth = scene("mei", distortion_free=True)
    problem, start = float32(with_noise(problem, 0.3), disturbed(truth))
    first, second = solve(problem, start), solve(problem, start)
    assert torch.equal(first.state.cam_from_world, second.state.cam_from_world)
    assert torch.equal(first.state.inverse_depth, second.state.inverse_depth)
    assert first.cost == second.cost


def test_losing_points_is_no_way_to_lower_the_cost() -> None:
    """A frame pulled forward by wild measurements may not drop its own points behind the camera for free."""
    problem, truth = scene("pinhole", num_frames=3)
    wild = problem.edges.target_px.clone()
    wild[problem.edges.target == 2] += 60.0
    problem = replace(problem, edges=replace(problem.edges, target_px=wild))
    result = solve(problem, truth, Options(max_iterations=30, robust="none"))
    _, before = residuals(problem, truth)
    _, after = residuals(problem, result.state)
    assert after.sum() >= 0.9 * before.sum()


def test_empty_problems() -> None:
    problem, truth = scene("pinhole")
    nothing = replace(problem, edges=replace(problem.edges, weight=torch.zeros_like(problem.edges.weight)))
    result = solve(nothing, truth)
    assert result.status is Status.EMPTY
    assert result.state is truth
    fixed = torch.zeros(5, dtype=torch.bool)
    assert solve(replace(problem, free=Free(fixed, fixed)), truth).status is Status.EMPTY
    edges = problem.edges
    no_edges = Edges(edges.source[:0], edges.target[:0], edges.target_px[:0], edges.weight[:0])
    assert solve(replace(problem, edges=no_edges), truth).status is Status.EMPTY


@pytest.mark.parametrize("where", ["pose", "depth", "intrinsics", "target", "weight", "prior"])
def test_input_that_is_not_finite_is_refused(where: str) -> None:
    problem, truth = scene("pinhole")
    problem = with_depth_prior(problem, truth.inverse_depth.clone(), 1.0)
    state = State(truth.cam_from_world.clone(), truth.inverse_depth.clone(), truth.intrinsics.clone())
    tensor = {
        "pose": state.cam_from_world,
        "depth": state.inverse_depth,
        "intrinsics": state.intrinsics,
        "target": problem.edges.target_px,
        "weight": problem.edges.weight,
        "prior": problem.priors.inverse_depth,
    }[where]
    assert tensor is not None
    tensor.view(-1)[5 % tensor.numel()] = torch.nan if where != "weight" else torch.inf
    if where == "target":
        problem.edges.weight.view(-1)[5] = 1.0
    result = solve(problem, state)
    assert result.status is Status.NON_FINITE
    assert result.iterations == 0
    assert result.state is state


def test_free_gauge_still_converges() -> None:
    """Nothing holds the world: seven directions without curvature, which damping must survive."""
    problem, truth = scene("pinhole")
    problem = replace(problem, free=replace(problem.free, poses=torch.ones(5, dtype=torch.bool)))
    result = solve(problem, disturbed(truth, log_focal=0.02), Options(max_iterations=30))
    assert result.status is Status.CONVERGED
    assert result.cost < 1e-9
    assert result.state.cam_from_world.isfinite().all()


def test_overflowing_weights_are_reported_as_singular() -> None:
    problem, truth = scene("pinhole")
    huge = torch.full_like(problem.edges.weight, 1e36)
    problem, start = float32(
        replace(problem, edges=replace(problem.edges, weight=huge)), disturbed(truth, twist=0.0, depth=1e-4)
    )
    result = solve(problem, start, Options(max_iterations=100, robust="none"))
    assert result.status in (Status.SINGULAR, Status.NON_FINITE)
    assert torch.equal(result.state.inverse_depth, start.inverse_depth)


def test_equirect_is_refused() -> None:
    problem, truth = scene("pinhole")
    with pytest.raises(ConfigError, match="equirect"):
        solve(replace(problem, camera_model="equirect"), truth)


def test_residuals_are_reprojection_minus_measurement() -> None:
    problem, truth = scene("pinhole")
    shifted = replace(problem, edges=replace(problem.edges, target_px=problem.edges.target_px - 2.0))
    weight = problem.edges.weight.clone()
    weight[0, 0] = 0
    shifted = replace(shifted, edges=replace(shifted.edges, weight=weight))
    residual, valid = residuals(shifted, truth)
    assert not valid[0, 0]
    assert (residual[0, 0] == 0).all()
    torch.testing.assert_close(residual[valid], torch.full_like(residual[valid], 2.0))


def test_induced_flow_of_an_unmoved_camera_is_zero() -> None:
    problem, truth = scene("mei")
    px, valid = reproject("mei", problem.grid, truth, torch.tensor([2]), torch.tensor([2]))
    assert valid.all()
    torch.testing.assert_close(px[0], problem.grid.sample_px())


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU on this machine")
@pytest.mark.parametrize("camera_model", ["pinhole", "mei"])
def test_gpu_gives_the_same_answer(camera_model: CameraModel) -> None:
    problem, truth = scene(camera_model, distortion_free=camera_model == "mei")
    problem, start = with_noise(problem, 0.1), disturbed(truth)
    host = solve(problem, start)
    device = solve(problem, State(*(x.cuda() for x in (start.cam_from_world, start.inverse_depth, start.intrinsics))))
    assert device.state.cam_from_world.is_cuda
    assert device.status is host.status
    torch.testing.assert_close(device.state.cam_from_world.cpu(), host.state.cam_from_world, rtol=0, atol=1e-8)
    torch.testing.assert_close(device.state.inverse_depth.cpu(), host.state.inverse_depth, rtol=1e-7, atol=0)
    torch.testing.assert_close(device.state.intrinsics.cpu(), host.state.intrinsics, rtol=1e-8, atol=0)
