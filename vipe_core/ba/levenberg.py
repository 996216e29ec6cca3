"""Levenberg-Marquardt over the normal equations: the entry points of bundle adjustment.

The host reads one small tensor per step, to accept or reject it.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from vipe_core.ba import robust
from vipe_core.ba.host_solver import HostSolver
from vipe_core.ba.problem import Edges, Options, Problem, Result, State, Status
from vipe_core.ba.reprojection import require_supported
from vipe_core.ba.solver import Cost, Solver, Step
from vipe_core.ba.torch_solver import TorchSolver

_MAX_DAMPING = 1e8
# Single precision leaves errors of this size in the reduced system: less damping only makes it indefinite.
_MIN_DAMPING = {torch.float32: 1e-7, torch.float64: 1e-10}
# A free gauge does not couple with the focal length, so the least damping that makes the system invertible will do.
_SIGMA_DAMPINGS = (1e-9, 1e-7, 1e-5)
_ACCEPTED_FACTOR = 0.2
_REJECTED_FACTOR = 10.0
# Mean squared residual, px^2, at which exact data is solved and only rounding is left.
_NEGLIGIBLE_COST = 1e-14


def solve(problem: Problem, state: State, options: Options | None = None) -> Result:
    """Minimise the robust cost from a state, accepting only steps that lower it.

    Measurements and state may be on different devices; the work is done where `state.inverse_depth` is, in its dtype
    (float32, or float64 throughout), with everything from 6x6 blocks on in float64.

    Args:
        problem: Graph, measurements, priors and what is free.
        state: Where to start. It is not changed.
        options: How to solve.

    Returns:
        The new state, on the same device, and why the solve ended. `cost` and `initial_cost` are of the measurements
        alone; priors, and a charge for points that fall behind their target camera, take part in accepting a step.

    Raises:
        ConfigError: A camera model without derivatives here.
        ValueError: Inverse depths that are neither float32 nor float64.
    """
    options = options or Options()
    problem, state = _on_device(problem, state)
    if not _finite(problem, state):
        return Result(state, Status.NON_FINITE, 0, math.nan, math.nan, 0.0)
    solver = _solver(problem, options, state)
    cost = solver.cost(state)
    measured, weight = _read(cost.measurements, cost.weight)
    if not math.isfinite(measured):
        return Result(state, Status.NON_FINITE, 0, measured, measured, weight)
    if not solver.anything_free or not weight > 0:
        return Result(state, Status.EMPTY, 0, measured, measured, weight)
    initial_cost = measured

    lost_rho = _lost_rho(options, cost)
    total = cost.total(lost_rho)
    system = solver.linearise(state)
    linearised_state = state
    damping, min_damping = options.initial_damping, _MIN_DAMPING[state.inverse_depth.dtype]
    status = Status.MAX_ITERATIONS
    iterations = 0
    while iterations < options.max_iterations:
        iterations += 1
        step = solver.step(system, damping)
        new_state = solver.retract(state, step)
        new_cost = solver.cost(new_state)
        new_total = new_cost.total(lost_rho)
        old, new, predicted, factorised, mean = _read(
            total, new_total, step.predicted_drop, step.factorised, new_total / new_cost.weight
        )
        if factorised and new < old:
            state, cost, total = new_state, new_cost, new_total
            damping = max(damping * _ACCEPTED_FACTOR, min_damping)
            if old - new < options.relative_tolerance * old or mean < _NEGLIGIBLE_COST:
                status = Status.CONVERGED
                break
            if iterations < options.max_iterations:
                system, linearised_state = solver.linearise(state), state
        else:
            if factorised and predicted < options.relative_tolerance * old:
                status = Status.CONVERGED
                break
            damping = max(damping * _REJECTED_FACTOR, min_damping)
            if damping > _MAX_DAMPING:
                status = Status.NO_PROGRESS if factorised else Status.SINGULAR
                break

    variance = math.nan
    if solver.focal_free:
        if linearised_state is not state:
            system = solver.linearise(state)
        variances = _read(*(solver.log_focal_variance(system, damping) for damping in _SIGMA_DAMPINGS))
        variance = next((value for value in variances if value > 0), math.nan)
    measured, weight = _read(cost.measurements, cost.weight)
    sigma = math.sqrt(variance) if variance > 0 else math.nan
    return Result(state, status, iterations, initial_cost, measured, weight, sigma)


def newton_step(problem: Problem, state: State, options: Options | None = None, damping: float = 0.0) -> Step:
    """One damped Gauss-Newton step (iteratively reweighted), not applied. For tests and diagnosis.

    Raises:
        ConfigError: A camera model without derivatives here.
    """
    options = options or Options()
    problem, state = _on_device(problem, state)
    solver = _solver(problem, options, state)
    return solver.step(solver.linearise(state), damping)


def _solver(problem: Problem, options: Options, state: State) -> Solver[Any]:
    on_host = state.inverse_depth.device.type == "cpu"
    return HostSolver(problem, options, state) if on_host else TorchSolver(problem, options, state)


def _on_device(problem: Problem, state: State) -> tuple[Problem, State]:
    """All tensors where the inverse depths are."""
    require_supported(problem.camera_model)
    if state.inverse_depth.dtype not in (torch.float32, torch.float64):
        raise ValueError(f"inverse depths must be float32 or float64, got {state.inverse_depth.dtype}")
    device = state.inverse_depth.device
    if state.cam_from_world.device != device or state.intrinsics.device != device:
        state = State(state.cam_from_world.to(device), state.inverse_depth, state.intrinsics.to(device))
    edges, priors = problem.edges, problem.priors
    if priors.inverse_depth is not None and priors.inverse_depth_weight is not None:
        priors = replace(
            priors,
            inverse_depth=priors.inverse_depth.to(device),
            inverse_depth_weight=priors.inverse_depth_weight.to(device),
        )
    edges = Edges(edges.source.to(device), edges.target.to(device), edges.target_px.to(device), edges.weight.to(device))
    return replace(problem, edges=edges, priors=priors), state


def _finite(problem: Problem, state: State) -> bool:
    """Whether state and priors are finite. Measurements with a weight that are not make the cost so."""
    priors = problem.priors
    checks = [tensor.isfinite().all() for tensor in (state.cam_from_world, state.inverse_depth, state.intrinsics)]
    if priors.inverse_depth is not None and priors.inverse_depth_weight is not None:
        checks.append(priors.inverse_depth_weight.isfinite().all())
        checks.append((priors.inverse_depth.isfinite() | (priors.inverse_depth_weight <= 0)).all())
    return bool(torch.stack(checks).all())


def _lost_rho(options: Options, cost: Cost) -> Tensor:
    """What a measurement costs whose point is not in front of its camera: as much as a gross outlier, px^2."""
    outlier = robust.cost(
        options.robust, options.robust_scale_px, torch.full_like(cost.weight, (10 * options.robust_scale_px) ** 2)
    )
    return torch.maximum(outlier, 4 * cost.measurements / cost.weight)


def _read(*values: Tensor) -> list[float]:
    """0-dim tensors of one device to the host, at once."""
    numbers: list[float] = torch.stack([value.double() for value in values]).tolist()
    return numbers
