"""How the answer of a solve comes back: tensors where the problem is, and one of numbers that the host reads once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from vipe_core.ba.problem import Covariance, Result, State, Status

_STATUS = tuple(Status)
_NUMBERS = 5


class Answer(NamedTuple):
    """What a solve leaves on its device.

    Attributes:
        cam_from_world, inverse_depth, intrinsics: As in `State`.
        cam_from_rig: (V, 4, 4); (0, 4, 4) without a rig.
        report: (5 + 4 C,) float64 for C cameras: number of the status in `Status`, steps tried, cost before and after,
            weight, and the covariances of log f and alpha row by row.
    """

    cam_from_world: Tensor
    inverse_depth: Tensor
    intrinsics: Tensor
    cam_from_rig: Tensor
    report: Tensor


def report_size(state: State) -> int:
    """Numbers in a report."""
    return _NUMBERS + 4 * (1 if state.intrinsics.ndim == 1 else len(state.intrinsics))


def answer_of(result: Result) -> Answer:
    """A result as an answer; nothing of it is shared."""
    state = result.state
    covariances = [value for covariance in result.intrinsics_covariances for row in covariance for value in row]
    # Where nothing was solved there is only one.
    covariances += [0.0] * (report_size(state) - _NUMBERS - len(covariances))
    numbers = [_STATUS.index(result.status), result.iterations, result.initial_cost, result.cost, result.weight_sum]
    return Answer(
        state.cam_from_world.clone(),
        state.inverse_depth.clone(),
        state.intrinsics.clone(),
        state.cam_from_world.new_empty(0, 4, 4) if state.cam_from_rig is None else state.cam_from_rig.clone(),
        torch.tensor([*numbers, *covariances], dtype=torch.float64, device=state.inverse_depth.device),
    )


def result_of(answer: Answer, given: State) -> Result:
    """Wait for an answer and read it. Where nothing was solved, the state is the one given."""
    report: list[float] = answer.report.tolist()
    status = _STATUS[int(report[0])]
    state = State(
        answer.cam_from_world,
        answer.inverse_depth,
        answer.intrinsics,
        None if given.cam_from_rig is None else answer.cam_from_rig,
    )
    return Result(
        given if status in (Status.NON_FINITE, Status.EMPTY) else state,
        status,
        iterations=int(report[1]),
        initial_cost=report[2],
        cost=report[3],
        weight_sum=report[4],
        intrinsics_covariances=_covariances(report[_NUMBERS:]),
    )


def _covariances(values: Sequence[float]) -> tuple[Covariance, ...]:
    found: list[Covariance] = []
    for k in range(0, len(values), 4):
        a, b, c, d = values[k : k + 4]
        found.append(((a, b), (c, d)))
    return tuple(found)
