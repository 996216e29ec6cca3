"""How the answer of a solve comes back: tensors where the problem is, and one of numbers that the host reads once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from vipe_core.ba.problem import Covariance, Problem, Result, State, Status

_STATUS = tuple(Status)
_NUMBERS = 5


class Answer(NamedTuple):
    """What a solve leaves on its device.

    Attributes:
        cam_from_world, inverse_depth, intrinsics: As in `State`.
        cam_from_rig: (V, 4, 4); (0, 4, 4) without a rig.
        report: (5 + 4 C,) float64 for C cameras: number of the status in `Status`, steps tried, cost before and after,
            weight, and the covariances of log f and alpha row by row; then (36 V,) those of refined extrinsics.
    """

    cam_from_world: Tensor
    inverse_depth: Tensor
    intrinsics: Tensor
    cam_from_rig: Tensor
    report: Tensor


def num_cameras(state: State) -> int:
    """How many intrinsics a state has: one, or one for each view of a rig."""
    return 1 if state.intrinsics.ndim == 1 else len(state.intrinsics)


def report_size(problem: Problem, state: State, *, extrinsics: bool = True) -> int:
    """Numbers in a report, or without what it says of extrinsics."""
    refined = len(state.cam_from_rig) if extrinsics and problem.refines_rig and state.cam_from_rig is not None else 0
    return _NUMBERS + 4 * num_cameras(state) + 36 * refined


def answer_of(result: Result, size: int) -> Answer:
    """A result as an answer with a report of a size; nothing of it is shared."""
    state, device = result.state, result.state.inverse_depth.device
    numbers = [_STATUS.index(result.status), result.iterations, result.initial_cost, result.cost, result.weight_sum]
    numbers += [value for covariance in result.intrinsics_covariances for row in covariance for value in row]
    # Of several cameras that are held, a result has one covariance for all.
    numbers += [0.0] * (_NUMBERS + 4 * num_cameras(state) - len(numbers))
    if result.extrinsic_covariances is not None:
        numbers += result.extrinsic_covariances.flatten().tolist()
    # Where nothing was solved there is less to say.
    numbers += [0.0] * (size - len(numbers))
    return Answer(
        state.cam_from_world.clone(),
        state.inverse_depth.clone(),
        state.intrinsics.clone(),
        state.cam_from_world.new_empty(0, 4, 4) if state.cam_from_rig is None else state.cam_from_rig.clone(),
        torch.tensor(numbers, dtype=torch.float64, device=device),
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
    solved = status not in (Status.NON_FINITE, Status.EMPTY)
    rest = _NUMBERS + 4 * num_cameras(given)
    extrinsic = torch.tensor(report[rest:], dtype=torch.float64).view(-1, 6, 6)
    return Result(
        state if solved else given,
        status,
        iterations=int(report[1]),
        initial_cost=report[2],
        cost=report[3],
        weight_sum=report[4],
        intrinsics_covariances=_covariances(report[_NUMBERS:rest]),
        extrinsic_covariances=extrinsic if solved and len(extrinsic) else None,
    )


def _covariances(values: Sequence[float]) -> tuple[Covariance, ...]:
    found: list[Covariance] = []
    for k in range(0, len(values), 4):
        a, b, c, d = values[k : k + 4]
        found.append(((a, b), (c, d)))
    return tuple(found)
