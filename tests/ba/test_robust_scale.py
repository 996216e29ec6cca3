"""Robust kernels, their graduation, and their scale from the data."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from ba_scenes import disturbed, scene, with_noise
from hypothesis import given, settings
from hypothesis import strategies as st

from vipe_core.ba import Options, Problem, State, largest_residual_px, residual_sigma_px, robust, robust_scale_px, solve
from vipe_core.ba.problem import RobustKernel

KERNELS = ["huber", "cauchy", "geman_mcclure", "tukey", "truncated"]


@settings(max_examples=80, deadline=None)
@given(st.sampled_from(KERNELS), st.floats(0.1, 10.0), st.floats(0.1, 1.0), st.floats(1e-3, 300.0))
def test_slope_is_the_derivative_of_the_cost(kernel: RobustKernel, scale_px: float, end: float, squared: float) -> None:
    s = torch.tensor(squared, dtype=torch.float64, requires_grad=True)
    robust.cost(kernel, scale_px, s, end * scale_px).backward()
    root = robust.root_slope(kernel, scale_px, s.detach(), end * scale_px)
    assert s.grad is not None
    assert root is not None
    assert float(root) ** 2 == pytest.approx(float(s.grad), rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("kernel", KERNELS)
def test_kernels_are_quadratic_at_zero_and_never_fall(kernel: RobustKernel) -> None:
    squared = torch.linspace(0, 400, 2001, dtype=torch.float64)
    cost = robust.cost(kernel, 3.0, squared)
    assert (cost.diff() >= 0).all()
    assert float(robust.cost(kernel, 3.0, torch.tensor(1e-6, dtype=torch.float64))) == pytest.approx(1e-6)


def test_truncation_is_the_surrogate_of_graduated_truncated_least_squares() -> None:
    """Equation 13 of Yang et al. 2020 with the mu that a scale stands for, and what it is the limit of."""
    squared = torch.linspace(0, 60, 601, dtype=torch.float64)
    c, mu = 2.0, 0.7
    upper = c * math.sqrt((mu + 1) / mu)
    middle = 2 * c * (squared * mu * (mu + 1)).sqrt() - mu * (c * c + squared)
    expected = torch.where(squared <= c * c * mu / (mu + 1), squared, torch.where(squared >= upper**2, c * c, middle))
    torch.testing.assert_close(robust.cost("truncated", upper, squared, c), expected)
    torch.testing.assert_close(robust.cost("truncated", c, squared), squared.clamp_max(c * c))


def with_outliers(problem: Problem, share: float, jump_px: float, seed: int = 4) -> Problem:
    """A share of the measurements shifted the same way: what a moving thing does."""
    rng = torch.Generator().manual_seed(seed)
    hit = torch.rand(problem.edges.target_px.shape[:2], generator=rng) < share
    target_px = problem.edges.target_px + hit[..., None] * torch.tensor([jump_px, 0.5 * jump_px], dtype=torch.float64)
    return replace(problem, edges=replace(problem.edges, target_px=target_px))


def noisy(sigma_px: float) -> tuple[Problem, State]:
    problem, truth = scene("pinhole", num_frames=6, height=10, width=12)
    return with_noise(problem, sigma_px), truth


@pytest.mark.parametrize("sigma_px", [0.3, 2.0])
def test_sigma_is_that_of_the_noise_whatever_a_third_of_the_data_says(sigma_px: float) -> None:
    problem, truth = noisy(sigma_px)
    weight = torch.ones_like(problem.edges.weight)  # weights of both components alike, so that s is |r|^2
    problem = replace(problem, edges=replace(problem.edges, weight=weight))
    assert residual_sigma_px(problem, truth) == pytest.approx(sigma_px, rel=0.05)
    spoiled = with_outliers(problem, 0.3, 60.0)
    # 30 % outliers move the median to the 71 % quantile of the inliers: a Rayleigh norm of 1.58 instead of 1.18 sigma.
    assert residual_sigma_px(spoiled, truth) == pytest.approx(1.34 * sigma_px, rel=0.06)
    ratio = robust_scale_px(problem, truth, "tukey", (0.01, 100.0)) / robust_scale_px(
        problem, truth, "huber", (0.01, 100.0)
    )
    assert ratio == pytest.approx(5.12 / 1.50)


def test_scale_keeps_its_bounds() -> None:
    problem, truth = noisy(0.01)
    assert robust_scale_px(problem, truth, "geman_mcclure") == 0.5
    assert robust_scale_px(problem, disturbed(truth, twist=0.5), "geman_mcclure", (1.0, 4.0)) == 4.0
    nothing = replace(problem, edges=replace(problem.edges, weight=torch.zeros_like(problem.edges.weight)))
    assert math.isnan(residual_sigma_px(nothing, truth))
    assert robust_scale_px(nothing, truth, "huber") == 0.5


def test_largest_residual_is_found() -> None:
    problem, truth = noisy(0.1)
    target_px = problem.edges.target_px.clone()
    target_px[3, 7] += torch.tensor([300.0, 400.0])
    target_px[4, 2] += 9000.0
    weight = torch.ones_like(target_px)
    weight[4, 2] = 0
    problem = replace(problem, edges=replace(problem.edges, target_px=target_px, weight=weight))
    assert largest_residual_px(problem, truth) == pytest.approx(500.0, rel=1e-2)


@pytest.mark.parametrize("robust_kernel", ["geman_mcclure", "tukey"])
@pytest.mark.parametrize("first_px", [math.inf, 40.0])
def test_graduation_finds_the_answer_that_a_narrow_kernel_misses(robust_kernel: RobustKernel, first_px: float) -> None:
    """Far off, a narrow redescending kernel believes nothing; a wide one brings the residuals into its range."""
    problem, truth = noisy(0.1)
    problem = with_outliers(problem, 0.2, 40.0)
    poses = problem.free.poses.clone()
    poses[1] = False  # holds the scale
    problem = replace(problem, free=replace(problem.free, poses=poses, focal=False))
    start = disturbed(truth, seed=2, twist=0.15, depth=0.2, log_focal=0.0)
    held = start.cam_from_world.clone()
    held[1] = truth.cam_from_world[1]
    start = replace(start, cam_from_world=held)
    options = Options(max_iterations=60, robust=robust_kernel, robust_scale_px=1.0, relative_tolerance=1e-6)
    narrow = solve(problem, start, options)
    graduated = solve(problem, start, replace(options, initial_scale_px=first_px))
    best = solve(problem, truth, options)
    assert (graduated.state.cam_from_world - best.state.cam_from_world).abs().max() < 1e-3
    assert (narrow.state.cam_from_world - best.state.cam_from_world).abs().max() > 0.1
    # Judged with the same kernel, wherever the descent began.
    assert graduated.initial_cost == narrow.initial_cost
    assert graduated.iterations <= 60


def test_truncated_least_squares_finds_what_outliers_hide() -> None:
    """From a start far off with 30 % of the measurements anywhere in the picture, it is least squares of the others."""
    problem, truth = noisy(0.1)
    rng = torch.Generator().manual_seed(4)
    target_px = problem.edges.target_px
    hit = torch.rand(target_px.shape[:2], generator=rng)[..., None] < 0.3
    anywhere = torch.rand(target_px.shape, generator=rng, dtype=torch.float64) * torch.tensor([96.0, 80.0])
    clean = replace(problem.edges, weight=problem.edges.weight * ~hit)
    poses = problem.free.poses.clone()
    poses[1] = False  # holds the scale
    free = replace(problem.free, poses=poses, focal=False)
    problem = replace(problem, free=free, edges=replace(problem.edges, target_px=torch.where(hit, anywhere, target_px)))
    best = solve(replace(problem, edges=clean), truth, Options(max_iterations=40, robust="none"))
    start = disturbed(truth, seed=2, twist=0.15, depth=0.2, log_focal=0.0)
    held = start.cam_from_world.clone()
    held[1] = truth.cam_from_world[1]

    def error(robust_kernel: RobustKernel, first_px: float | None) -> float:
        options = Options(
            max_iterations=80,
            robust=robust_kernel,
            robust_scale_px=1.0,
            initial_scale_px=first_px,
            relative_tolerance=1e-6,
        )
        found = solve(problem, replace(start, cam_from_world=held), options).state
        return float((found.cam_from_world - best.state.cam_from_world).abs().max())

    assert error("truncated", math.inf) < 1e-3
    assert error("truncated", None) > 0.1
    assert error("tukey", None) > 0.1
    assert error("huber", None) > 0.02


def test_graduation_ends_at_the_scale_asked_for() -> None:
    problem, truth = noisy(0.3)
    options = Options(max_iterations=80, relative_tolerance=1e-9)
    plain, graduated = (
        solve(problem, truth, replace(options, initial_scale_px=first_px)) for first_px in (None, math.inf)
    )
    torch.testing.assert_close(graduated.state.cam_from_world, plain.state.cam_from_world, rtol=0, atol=1e-4)
    assert graduated.cost == pytest.approx(plain.cost, rel=1e-6)


def test_a_start_scale_below_the_scale_changes_nothing() -> None:
    problem, truth = noisy(0.3)
    plain, narrower = (solve(problem, disturbed(truth), Options(initial_scale_px=px)) for px in (None, 0.5))
    assert torch.equal(plain.state.cam_from_world, narrower.state.cam_from_world)
    assert plain.iterations == narrower.iterations
