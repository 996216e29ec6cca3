"""A solver's step, and how far it is from another one's."""

from __future__ import annotations

import torch

from vipe_core.ba import Options, Problem, State, Step
from vipe_core.ba.torch_solver import TorchSolver

STEP = ("pose", "log_focal", "alpha", "inverse_depth", "predicted_drop")


def relative_error(actual: torch.Tensor, expected: torch.Tensor) -> float:
    return float((actual - expected).norm() / expected.norm().clamp_min(1e-300))


def torch_step(problem: Problem, state: State, options: Options, damping: float) -> Step:
    solver = TorchSolver(problem, options, state)
    return solver.step(solver.linearise(state, options.robust_scale_px), damping)
