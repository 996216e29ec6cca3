"""Bundle adjustment as an operator of torch: schema, shapes, no aliases, and that `solve` is it."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from typing import Any

import pytest
import torch
from ba_scenes import disturbed, float32, scene, with_depth_prior, with_noise, with_tracks
from rig_scenes import disturbed_rig, rig_scene

from vipe_core.ba import Options, Priors, Problem, Result, State, Status, levenberg, operator, solve
from vipe_core.ba.answer import answer_of, report_size, result_of


def plain() -> tuple[Problem, State]:
    problem, truth = scene("mei", num_frames=3, height=3, width=4, distortion_free=True)
    problem = with_depth_prior(with_noise(problem, 0.1), truth.inverse_depth, 0.5)
    problem = replace(problem, priors=replace(problem.priors, log_focal=4.0, log_focal_sigma=0.2))
    own = replace(problem.priors, inverse_depth_scale_sigma=0.1, inverse_depth_shift_sigma=0.2)
    return float32(replace(problem, priors=own), disturbed(truth))


def tracks() -> tuple[Problem, State]:
    problem, truth = with_tracks(*scene("mei", num_frames=3, height=3, width=4))
    return float32(with_noise(problem, 0.1), disturbed(truth))


def rig() -> tuple[Problem, State]:
    problem, truth = rig_scene(num_poses=3, own_intrinsics=True, height=3, width=4)
    sigma = torch.tensor([[0.1, 0.2], [0.3, 0.4]])
    prior = Priors(log_focal=(3.0, 3.1), cam_from_rig=truth.cam_from_rig, extrinsic_sigma=sigma)
    free = replace(problem.free, focal=True, extrinsics=True)
    return replace(with_noise(problem, 0.05), free=free, priors=prior), disturbed_rig(problem, truth)


@pytest.mark.parametrize("case", [plain, tracks, rig])
def test_torch_accepts_the_operator(case: Any) -> None:
    """Its schema, that it neither changes nor returns what it is given, and the shapes that its fake foretells."""
    arguments = operator._arguments(*case(), Options(max_iterations=2))
    torch.library.opcheck(torch.ops.vipe_core.bundle_adjustment.default, arguments)


@pytest.mark.parametrize("case", [plain, tracks, rig])
def test_what_is_asked_arrives(case: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every field of problem, state and options, none of them at its default."""
    problem, state = case()
    options = Options(
        max_iterations=3,
        relative_tolerance=1e-3,
        robust="cauchy",
        componentwise=True,
        robust_scale_px=2.0,
        initial_scale_px=math.inf,
        initial_damping=1e-3,
        min_inverse_depth=2e-3,
        max_inverse_depth=2e3,
        min_depth_ratio=0.2,
    )
    assert all(getattr(options, field.name) != field.default for field in fields(options))
    arrived: list[tuple[Problem, State, Options]] = []
    descend = levenberg.descend
    monkeypatch.setattr(levenberg, "descend", lambda *given: arrived.append(given) or descend(*given))
    solve(problem, state, options)
    ((there, start, how),) = arrived
    assert how == options
    assert _equal(there, problem)
    assert _equal(start, state)


def _equal(one: Any, other: Any) -> bool:
    if isinstance(one, torch.Tensor):
        return torch.equal(one, other)
    if hasattr(one, "__dataclass_fields__"):
        return all(_equal(getattr(one, field.name), getattr(other, field.name)) for field in fields(one))
    return bool(one == other)


@pytest.mark.parametrize("case", [plain, tracks, rig])
def test_an_answer_says_what_the_result_does(case: Any) -> None:
    problem, state = case()
    result = levenberg.descend(problem, state, Options(max_iterations=2))
    size = report_size(problem, state)
    assert _equal(result_of(answer_of(result, size), state), result)
    assert (result.extrinsic_covariances is not None) is problem.refines_rig
    held = replace(result, intrinsics_covariances=result.intrinsics_covariances[:1])
    assert _equal(result_of(answer_of(held, size), state).extrinsic_covariances, result.extrinsic_covariances)
    for status in (Status.EMPTY, Status.NON_FINITE):
        nothing = Result(state, status, 0, 1.0, 1.0, 1.0)
        assert len(answer_of(nothing, size).report) == size
        assert result_of(answer_of(nothing, size), state).state is state
