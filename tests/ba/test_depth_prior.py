"""Scale and shift of a depth prior that are each frame's own."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from ba_scenes import disturbed, float32, scene, with_depth_prior, with_noise, with_tracks
from hypothesis import given, settings
from hypothesis import strategies as st
from rig_scenes import disturbed_rig, rig_scene
from solver_steps import STEP, relative_error, torch_step

from vipe_core.ba import Options, Problem, State, cuda, newton_step, oracle, solve
from vipe_core.ba.depth_prior import depth_prior
from vipe_core.ba.host_solver import HostSolver
from vipe_core.ba.torch_solver import TorchSolver
from vipe_core.cameras import CameraModel
from vipe_core.geometry import se3


def flickering(problem: Problem, truth: State, by: float, seed: int, information: float) -> Problem:
    """The true inverse depths as a network may see them: another scale in each picture, 10 % noise in each cell."""
    rng = torch.Generator().manual_seed(seed)
    frames, cells = truth.inverse_depth.shape
    scale = torch.exp(by * torch.randn(frames, 1, generator=rng, dtype=torch.float64))
    noise = 1 + 0.1 * torch.randn(frames, cells, generator=rng, dtype=torch.float64)
    return with_depth_prior(problem, truth.inverse_depth * scale * noise, information)


def with_own(problem: Problem, scale: float, shift: float) -> Problem:
    own = replace(problem.priors, inverse_depth_scale_sigma=scale, inverse_depth_shift_sigma=shift)
    return replace(problem, priors=own)


@settings(max_examples=3, deadline=None)
@given(
    st.sampled_from(["pinhole", "mei"]),
    st.sampled_from([(0.05, 0.0), (0.0, 0.1), (0.05, 0.1)]),
    st.sampled_from(["plain", "rig", "tracks", "held"]),
    st.integers(0, 100),
)
def test_a_step_is_the_oracles(model: CameraModel, sigmas: tuple[float, float], kind: str, seed: int) -> None:
    """Which knows scale and shift as unknowns beside all others."""
    problem, truth = rig_scene(model, 3, 2, True, seed, 3, 4) if kind == "rig" else scene(model, 4, 3, 4, seed=seed)
    if kind == "tracks":
        problem, truth = with_tracks(problem, truth, 5, seed)
    problem = replace(problem, free=replace(problem.free, focal=True, distortion=model == "mei"))
    if kind == "held":
        problem = replace(problem, free=replace(problem.free, inverse_depth=torch.arange(4) != 1))
    problem = with_own(flickering(with_noise(problem, 0.05, seed), truth, 0.1, seed, 20.0), *sigmas)
    state = disturbed_rig(problem, truth, seed, 2e-3) if kind == "rig" else disturbed(truth, seed, 2e-3, 0.02, 0.01)
    options = Options(robust_scale_px=0.5)
    for damping in (1e-3, 1.0):
        expected = oracle.newton_step(problem, state, options, damping)
        for actual in (newton_step(problem, state, options, damping), torch_step(problem, state, options, damping)):
            for name in STEP:
                assert relative_error(getattr(actual, name), getattr(expected, name)) < 1e-8, name


def test_scale_and_shift_cost_least() -> None:
    problem, truth = scene("pinhole", 3, 3, 4)
    priors = with_own(flickering(problem, truth, 0.1, 0, 20.0), 0.05, 0.1).priors
    depth = truth.inverse_depth.clone().requires_grad_()
    assert priors.inverse_depth is not None
    found = depth_prior(priors, truth.inverse_depth, slice(None))
    assert found is not None

    def cost(change: torch.Tensor) -> torch.Tensor:
        assert priors.inverse_depth is not None
        off = change[:, :1] * priors.inverse_depth + change[:, 1:] - depth
        own = ((change - torch.tensor([1.0, 0.0])) / torch.tensor([0.05, 0.1], dtype=torch.float64)).square()
        return 20.0 * off.square().sum() + own.sum()

    change = torch.tensor([[1.0, 0.0]] * 3, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(cost(change), change, create_graph=True)
    curvature = torch.stack([torch.autograd.grad(slope[:, k].sum(), change, retain_graph=True)[0] for k in range(2)], 1)
    best = (change - torch.linalg.solve(curvature, slope[..., None])[..., 0]).detach()
    theirs = 20.0 * found.off.square().sum() + found.cost.sum()
    assert float(theirs) == pytest.approx(float(cost(best).detach()), rel=1e-9)
    # Its slope by the depths is that of the minimum.
    (by_depth,) = torch.autograd.grad(cost(best), depth)
    torch.testing.assert_close(-2 * 20.0 * found.off, by_depth)


@pytest.mark.parametrize("single", [False, True])
def test_both_solvers_judge_alike(single: bool) -> None:
    problem, truth = scene("pinhole", 5, 17, 19)
    problem, state = with_own(flickering(problem, truth, 0.1, 1, 20.0), 0.05, 0.02), disturbed(truth)
    if single:
        problem, state = float32(problem, state)
    options = Options()
    host, other = (kind(problem, options, state).cost(state, 3.0).priors for kind in (HostSolver, TorchSolver))
    assert float(host) == pytest.approx(float(other), rel=1e-5 if single else 1e-12)
    actual, expected = newton_step(problem, state, options, 1e-3), torch_step(problem, state, options, 1e-3)
    assert relative_error(actual.inverse_depth, expected.inverse_depth) < (1e-2 if single else 1e-10)
    assert not cuda.takes(problem, state)


def test_a_flickering_prior_bends_a_path_less_where_frames_have_a_scale_of_their_own() -> None:
    """Trusted as much as matching: 5 % of flicker are then in the poses, or in the scales."""

    def error(seed: int, sigma: float) -> float:
        problem, truth = scene("pinhole", 12, 6, 8, seed=seed, focal_free=False)
        problem = with_own(flickering(with_noise(problem, 0.3, seed), truth, 0.05, seed, 150.0), sigma, 0.0)
        options = Options(max_iterations=15, relative_tolerance=1e-6)
        found = solve(problem, disturbed(truth, seed, 0.01, 0.1, 0.0), options).state
        ours, theirs = (se3.inverse(state.cam_from_world)[:, :3, 3] for state in (found, truth))
        ours, theirs = ours - ours[:1], theirs - theirs[:1]
        scale = (ours * theirs).sum() / ours.square().sum()
        return float((scale * ours - theirs).norm() / theirs.norm())

    held, own = (sum(error(seed, sigma) for seed in range(3)) for sigma in (0.0, 0.05))
    assert own < 0.85 * held
