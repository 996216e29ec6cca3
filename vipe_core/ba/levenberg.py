"""Levenberg-Marquardt over the normal equations, with the loop on the host.

`cuda/` follows the rules of this file on the GPU. Convergence is a predicate of the expected and the actual gain,
computed where the numbers are. On a GPU the host reads it once per step, with everything else that it decides on; on a
CPU, where reading is free, a state that is at its minimum already costs one linearisation.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from vipe_core.ba import robust
from vipe_core.ba.host_solver import HostSolver
from vipe_core.ba.problem import NO_COVARIANCE, Covariance, Edges, Options, Points, Problem, Result, Rig, State, Status
from vipe_core.ba.reprojection import require_supported
from vipe_core.ba.rules import (
    ACCEPTED_FACTOR,
    MAX_DAMPING,
    MIN_DAMPING,
    NARROWING,
    NEGLIGIBLE_COST,
    REJECTED_FACTOR,
    SIGMA_DAMPINGS,
    TRUSTED_DAMPING,
    UNTRIED_SHARE,
)
from vipe_core.ba.scale import largest_residual_px
from vipe_core.ba.solver import Cost, Solver, Step
from vipe_core.ba.torch_solver import TorchSolver


def require_solvable(problem: Problem, state: State) -> None:
    """Raises what `solve` says of a problem that it does not take."""
    require_supported(problem.camera_model)
    if state.inverse_depth.dtype not in (torch.float32, torch.float64):
        raise ValueError(f"inverse depths must be float32 or float64, got {state.inverse_depth.dtype}")
    if problem.rig is not None and state.cam_from_rig is None:
        raise ValueError("the state of a rig needs cam_from_rig")


def descend(problem: Problem, state: State, options: Options) -> Result:
    """`vipe_core.ba.solve`, with the loop on the host; of what `require_solvable` lets pass."""
    problem, state = _on_device(problem, state)
    if not _finite(problem, state):
        return Result(state, Status.NON_FINITE, 0, math.nan, math.nan, 0.0)
    solver = _solver(problem, options, state)
    descent = _Descent(solver, options, state)
    measured, weight = _read(descent.cost.measurements, descent.cost.weight)
    if not math.isfinite(measured):
        return Result(state, Status.NON_FINITE, 0, measured, measured, weight)
    if not solver.anything_free or not weight > 0:
        return Result(state, Status.EMPTY, 0, measured, measured, weight)
    initial_cost = measured

    for scale_px in _wider_scales(problem, state, options):
        descent.judge_at(scale_px)
        descent.run(until_accepted=True)
    descent.judge_at(options.robust_scale_px)
    status = descent.run()

    covariances = _intrinsics_covariances(solver, descent) if any(solver.intrinsics_free) else (NO_COVARIANCE,)
    extrinsic = _extrinsic_covariances(solver, descent.system()).cpu() if problem.refines_rig else None
    measured, weight = _read(descent.cost.measurements, descent.cost.weight)
    return Result(descent.state, status, descent.iterations, initial_cost, measured, weight, covariances, extrinsic)


def _intrinsics_covariances(solver: Solver[Any], descent: _Descent) -> tuple[Covariance, ...]:
    """Of each camera, by the least damping at which the system can be solved."""
    found = torch.stack([solver.intrinsics_covariance(descent.system(), damping) for damping in SIGMA_DAMPINGS])
    values = np.array(_read(*found.flatten())).reshape(len(SIGMA_DAMPINGS), -1, 4)
    chosen: list[Covariance] = []
    for camera in range(values.shape[1]):
        nan = math.nan
        best: Covariance = ((nan, nan), (nan, nan))
        for a, b, c, d in values[:, camera].tolist():
            if all(value > 0 for value, free in zip((a, d), solver.intrinsics_free, strict=True) if free):
                best = (a, b), (c, d)
                break
        chosen.append(best)
    return tuple(chosen)


def _extrinsic_covariances(solver: Solver[Any], system: Any) -> Tensor:
    """(V, 6, 6) of each camera of a rig, likewise."""
    return _sound([solver.extrinsic_covariance(system, damping) for damping in SIGMA_DAMPINGS])


def extrinsic_covariances(problem: Problem, state: State, options: Options) -> Tensor:
    """`Result.extrinsic_covariances` of a state that was solved for, on the device of the problem."""
    problem, state = _on_device(problem, state)
    solver = _solver(problem, options, state)
    return _extrinsic_covariances(solver, solver.linearise(state, options.robust_scale_px))


def pose_covariance(problem: Problem, state: State, frame: int, options: Options | None = None) -> Tensor:
    """How sure a pose is, with everything else that is free marginalised.

    Args:
        state: A solution of the problem.

    Returns:
        (6, 6) float64 on the host: the covariance of the left twist (translation, rotation) of the frame's
        cam_from_world, or of the rig_from_world behind it; zero for a fixed pose, NaN where the problem says nothing.

    Raises:
        ConfigError, ValueError: As `solve`.
    """
    options = options or Options()
    require_solvable(problem, state)
    problem, state = _on_device(problem, state)
    solver = _solver(problem, options, state)
    system = solver.linearise(state, options.robust_scale_px)
    return _sound([solver.pose_covariance(system, damping, frame)[None] for damping in SIGMA_DAMPINGS])[0].cpu()


def _sound(by_damping: Sequence[Tensor]) -> Tensor:
    """(G, n, n) covariances, each by the least damping at which the system could be solved; NaN if by none."""
    found = torch.stack(tuple(by_damping))
    sound = (found.diagonal(dim1=-2, dim2=-1) >= 0).all(-1)
    first = sound.int().argmax(0)
    chosen = found[first, torch.arange(found.shape[1], device=found.device)]
    return torch.where(sound.any(0)[:, None, None], chosen, torch.nan)


class _Descent:
    """Levenberg-Marquardt steps from a state, each accepted only if it lowers the cost."""

    def __init__(self, solver: Solver[Any], options: Options, state: State) -> None:
        self.state = state
        self.iterations = 0
        self._solver = solver
        self._options = options
        self._on_host = state.inverse_depth.device.type == "cpu"
        self._damping = options.initial_damping
        self._min_damping = MIN_DAMPING[state.inverse_depth.dtype]
        self._scale_px = math.nan
        self.judge_at(options.robust_scale_px)

    def judge_at(self, scale_px: float) -> None:
        """From here on, the robust kernel has this scale."""
        if scale_px == self._scale_px:
            return
        self._scale_px = scale_px
        self._system = self._solver.linearise(self.state, scale_px)
        self._linearised = self.state
        self.cost: Cost = self._system.cost
        self._lost_rho = _lost_rho(self._options, scale_px, self.cost)

    def system(self) -> Any:
        """The normal equations at the state."""
        if self._linearised is not self.state:
            self._system = self._solver.linearise(self.state, self._scale_px)
            self._linearised = self.state
        return self._system

    def run(self, *, until_accepted: bool = False) -> Status:
        """Take steps until the cost does not fall any more, or up to the first that lowers it."""
        while self.iterations < self._options.max_iterations:
            before = self.state
            status = self._try_step()
            if status is not None:
                return status
            if until_accepted and self.state is not before:
                break
        return Status.MAX_ITERATIONS

    def _try_step(self) -> Status | None:
        options, solver, damping = self._options, self._solver, self._damping
        step = solver.step(self.system(), damping)
        total = self.cost.total(self._lost_rho)
        enough = options.relative_tolerance * total
        minimum = step.factorised & (step.predicted_drop < UNTRIED_SHARE * enough) & (damping <= TRUSTED_DAMPING)
        if self._on_host and bool(minimum):
            return Status.CONVERGED
        self.iterations += 1
        state = solver.retract(self.state, step)
        cost = solver.cost(state, self._scale_px)
        new_total = cost.total(self._lost_rho)
        better = step.factorised & (new_total < total)
        gain = torch.where(better, total - new_total, step.predicted_drop)
        solved = step.factorised & (gain < enough) | better & (new_total < NEGLIGIBLE_COST * cost.weight)
        at_minimum, factorised, accepted, converged = _read(minimum, step.factorised, better, solved)
        if at_minimum:
            return Status.CONVERGED
        if accepted:
            self.state, self.cost = state, cost
            self._damping = max(damping * ACCEPTED_FACTOR, self._min_damping)
        else:
            self._damping = max(damping * REJECTED_FACTOR, self._min_damping)
        if converged:
            return Status.CONVERGED
        if self._damping > MAX_DAMPING:
            return Status.NO_PROGRESS if factorised else Status.SINGULAR
        return None


def newton_step(problem: Problem, state: State, options: Options | None = None, damping: float = 0.0) -> Step:
    """One damped Gauss-Newton step (iteratively reweighted), not applied. For tests and diagnosis.

    Raises:
        ConfigError: A camera model without derivatives here.
    """
    options = options or Options()
    require_solvable(problem, state)
    problem, state = _on_device(problem, state)
    solver = _solver(problem, options, state)
    return solver.step(solver.linearise(state, options.robust_scale_px), damping)


def _wider_scales(problem: Problem, state: State, options: Options) -> list[float]:
    """Scales of the robust kernel before the one asked for, narrowing.

    Geman-McClure with squared scale mu c^2 is convex where s < mu c^2 / 3; Yang et al. 2020 begin at mu c^2 = 2 max s
    and divide mu by 1.4, and so it is with the end of truncation (`robust.py`). Here the steps are larger where more
    than half of the iterations would go into them.
    """
    final, first = options.robust_scale_px, options.initial_scale_px
    if first is None or options.robust == "none":
        return []
    if math.isinf(first):
        first = math.sqrt(2) * largest_residual_px(problem, state, componentwise=options.componentwise)
    if first <= final:
        return []
    span = 2 * math.log(first / final)
    levels = min(math.ceil(span / math.log(NARROWING)), max(options.max_iterations // 2, 1))
    return [final * math.exp(span / 2 * (levels - k) / levels) for k in range(levels)]


def _solver(problem: Problem, options: Options, state: State) -> Solver[Any]:
    on_host = state.inverse_depth.device.type == "cpu"
    return HostSolver(problem, options, state) if on_host else TorchSolver(problem, options, state)


def _on_device(problem: Problem, state: State) -> tuple[Problem, State]:
    """All tensors where the inverse depths are."""
    device = state.inverse_depth.device
    if state.cam_from_world.device != device or state.intrinsics.device != device:
        state = replace(state, cam_from_world=state.cam_from_world.to(device), intrinsics=state.intrinsics.to(device))
    rig = problem.rig
    if rig is not None and state.cam_from_rig is not None:
        state = replace(state, cam_from_rig=state.cam_from_rig.to(device))
        rig = Rig(rig.pose_of_frame.to(device), rig.view_of_frame.to(device))
    edges, priors = problem.edges, problem.priors
    if priors.inverse_depth is not None and priors.inverse_depth_weight is not None:
        priors = replace(
            priors,
            inverse_depth=priors.inverse_depth.to(device),
            inverse_depth_weight=priors.inverse_depth_weight.to(device),
        )
    edges = Edges(edges.source.to(device), edges.target.to(device), edges.target_px.to(device), edges.weight.to(device))
    grid = problem.grid
    if isinstance(grid, Points):
        grid = Points(grid.px.to(device), grid.count.to(device))
    return replace(problem, grid=grid, edges=edges, priors=priors, rig=rig), state


def _finite(problem: Problem, state: State) -> bool:
    """Whether state and priors are finite. Measurements with a weight that are not make the cost so."""
    priors = problem.priors
    tensors = [state.cam_from_world, state.inverse_depth, state.intrinsics]
    if isinstance(problem.grid, Points):
        tensors.append(problem.grid.px)
    if problem.rig is not None and state.cam_from_rig is not None:
        tensors.append(state.cam_from_rig)
    checks = [tensor.isfinite().all() for tensor in tensors]
    if priors.inverse_depth is not None and priors.inverse_depth_weight is not None:
        checks.append(priors.inverse_depth_weight.isfinite().all())
        checks.append((priors.inverse_depth.isfinite() | (priors.inverse_depth_weight <= 0)).all())
    return bool(torch.stack(checks).all())


def _lost_rho(options: Options, scale_px: float, cost: Cost) -> Tensor:
    """What a measurement costs whose point is not in front of its camera: as much as a gross outlier, px^2."""
    far = torch.full_like(cost.weight, (10 * scale_px) ** 2)
    outlier = robust.cost(options.robust, scale_px, far, options.robust_scale_px)
    if options.componentwise:
        outlier = 2 * outlier
    return torch.maximum(outlier, 4 * cost.measurements / cost.weight)


def _read(*values: Tensor) -> list[float]:
    """0-dim tensors of one device to the host, at once."""
    numbers: list[float] = torch.stack([value.double() for value in values]).tolist()
    return numbers
