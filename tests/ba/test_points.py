"""Points of a frame's own instead of a grid's cells: tracks alone, or beside the cells."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from ba_scenes import disturbed, float32, scene, with_depth_prior, with_noise, with_tracks
from hypothesis import given, settings
from hypothesis import strategies as st
from rig_scenes import disturbed_rig, rig_scene
from solver_steps import STEP, relative_error, torch_step

from vipe_core.ba import Grid, Options, Points, Status, newton_step, oracle, residuals, solve
from vipe_core.ba.host_solver import HostSolver
from vipe_core.ba.torch_solver import TorchSolver
from vipe_core.cameras import CameraModel


@settings(max_examples=5, deadline=None)
@given(
    model=st.sampled_from(["pinhole", "mei"]),
    alone=st.booleans(),
    own_cameras=st.booleans(),
    most=st.sampled_from([3, 12]),
    seed=st.integers(0, 100),
)
def test_a_step_is_the_oracles(model: CameraModel, alone: bool, own_cameras: bool, most: int, seed: int) -> None:
    """Frames with other numbers of tracks, one camera or one for each view of a rig."""
    problem, truth = rig_scene(model, 3, 2, True, seed, 3, 4) if own_cameras else scene(model, 3, 3, 4, seed=seed)
    problem, truth = with_tracks(problem, truth, most, seed, alone=alone)
    free = replace(problem.free, focal=True, distortion=model == "mei")
    problem = replace(with_noise(problem, 0.05, seed), free=free)
    state = disturbed_rig(problem, truth, seed, 2e-3) if own_cameras else disturbed(truth, seed, 2e-3, 0.02, 0.01)
    options = Options(robust_scale_px=0.5)
    expected = oracle.newton_step(problem, state, options, 1e-3)
    for actual in (newton_step(problem, state, options, 1e-3), torch_step(problem, state, options, 1e-3)):
        for name in STEP:
            assert relative_error(getattr(actual, name), getattr(expected, name)) < 1e-8, name


def test_more_points_than_a_tile_are_the_torch_solvers() -> None:
    problem, truth = with_tracks(*scene("mei", 3, 3, 4, distortion_free=True), most=600)
    problem, state = with_noise(problem, 0.1), disturbed(truth, twist=2e-3, depth=0.02, log_focal=0.01)
    actual, expected = newton_step(problem, state, Options(), 1e-3), torch_step(problem, state, Options(), 1e-3)
    for name in STEP:
        assert relative_error(getattr(actual, name), getattr(expected, name)) < 1e-9, name


@pytest.mark.parametrize("model", ["pinhole", "mei"])
def test_the_points_of_a_grid_are_the_grid(model: CameraModel) -> None:
    problem, truth = scene(model, distortion_free=model == "mei")
    problem, start = with_noise(problem, 0.3), disturbed(truth)
    assert isinstance(problem.grid, Grid)
    none = torch.zeros(len(start.cam_from_world), 0, 2), torch.zeros(len(start.cam_from_world), dtype=torch.int64)
    pointed = replace(problem, grid=Points.beside(problem.grid, *none))
    found, expected = solve(pointed, start), solve(problem, start)
    assert torch.equal(found.state.cam_from_world, expected.state.cam_from_world)
    assert torch.equal(found.state.inverse_depth, expected.state.inverse_depth)
    assert replace(found, state=expected.state) == expected


@pytest.mark.parametrize("single", [False, True])
def test_what_fills_up_moves_nothing(single: bool) -> None:
    """Nor do the bounds of inverse depths depend on it, though it is far from all others."""
    problem, truth = with_tracks(*scene("pinhole", height=3, width=4), most=5)
    problem = with_depth_prior(with_noise(problem, 0.2), truth.inverse_depth, 0.3)
    grid = problem.grid
    assert isinstance(grid, Points)
    real = grid.real()
    start = disturbed(truth)
    options = Options(max_iterations=5, min_inverse_depth=0.4, max_inverse_depth=1.6)
    if single:
        problem, start = float32(problem, start)

    def filled_more(values: torch.Tensor, by: float) -> torch.Tensor:
        return torch.cat((values, values.new_full((len(values), 40, *values.shape[2:]), by)), dim=1)

    edges, prior = problem.edges, problem.priors
    assert prior.inverse_depth is not None
    assert prior.inverse_depth_weight is not None
    more = replace(
        problem,
        grid=Points(filled_more(grid.px, 3.0), grid.count),
        edges=replace(edges, target_px=filled_more(edges.target_px, 7.0), weight=filled_more(edges.weight, 0.0)),
        priors=replace(
            prior,
            inverse_depth=filled_more(prior.inverse_depth, 5.0),
            inverse_depth_weight=filled_more(prior.inverse_depth_weight, 0.0),
        ),
    )
    further = replace(start, inverse_depth=filled_more(start.inverse_depth, 1e-9))
    expected, found = solve(problem, start, options), solve(more, further, options)
    assert expected.status is not Status.EMPTY
    assert torch.equal(found.state.cam_from_world, expected.state.cam_from_world)
    assert torch.equal(found.state.inverse_depth[:, : real.shape[1]], expected.state.inverse_depth)
    assert torch.equal(expected.state.inverse_depth[~real], start.inverse_depth[~real])
    assert expected.cost < expected.initial_cost
    low, high = (bound * start.inverse_depth[real].median() for bound in (0.4, 1.6))
    for kind in (HostSolver, TorchSolver):
        solver = kind(more, options, further)
        step = replace(newton_step(more, further, options), inverse_depth=10 * (further.inverse_depth.frac() - 0.5))
        moved = solver.retract(further, step).inverse_depth
        expected_depth = (further.inverse_depth + step.inverse_depth).clamp(low, high)
        assert torch.equal(moved[:, : real.shape[1]][real], expected_depth[:, : real.shape[1]][real])
        assert torch.equal(moved[:, : real.shape[1]][~real], start.inverse_depth[~real])
        assert torch.equal(moved[:, real.shape[1] :], further.inverse_depth[:, real.shape[1] :])


def test_sparse_tracks_alone_are_solved() -> None:
    problem, truth = with_tracks(*scene("pinhole", num_frames=6), most=30, alone=True)
    poses = torch.arange(6) > 1
    problem = replace(problem, free=replace(problem.free, poses=poses, focal=False))
    start = disturbed(truth, twist=0.01, log_focal=0.0)
    start.cam_from_world[1] = truth.cam_from_world[1]
    result = solve(problem, start, Options(max_iterations=40, relative_tolerance=1e-10))
    torch.testing.assert_close(result.state.cam_from_world, truth.cam_from_world, rtol=0, atol=1e-5)
    error, seen = residuals(problem, result.state)
    assert seen.any()
    assert error.abs().max() < 1e-3


def test_points_that_are_none_are_refused() -> None:
    with pytest.raises(ValueError, match="points disagree"):
        Points(torch.zeros(3, 4, 2), torch.zeros(2, dtype=torch.int64))
    problem, state = with_tracks(*scene("pinhole"))
    assert isinstance(problem.grid, Points)
    problem.grid.px[0, 0, 0] = torch.nan
    assert solve(problem, state).status is Status.NON_FINITE
