"""Bundle adjustment in CUDA kernels: single precision per cell, double from 6x6 blocks on, every decision on the GPU.

The algebra is that of `torch_solver.py`, the descent that of `levenberg.py`. Per Levenberg-Marquardt step:

    transform     edges of the proposed state, twists of the proposed step          (per edge)
    tile          finish the step of the depths, then cost and normal equations     (per slice of a unit)
    fold          slices -> 6x6 blocks of frames, tail and right-hand side          (per unit)
    turn          of a rig, -> blocks of its poses and views                        (per 7 blocks)
    assemble      -> blocks of the reduced system                                   (per 7 blocks)
    judge         accept or reject, damping, convergence                            (one)
    damp, gather, factorise, substitute                                             (per tile of the factor, by level)
    propose       step of poses and intrinsics, what it is expected to gain         (one)

A solve launches a fixed sequence; whatever is left when it has converged returns at once. `layout.py` works out the
graph, `compiler.py` and `launcher.py` turn `kernels/*.cu` into code for the GPU at hand, `solver.py` runs it.
"""

from __future__ import annotations

import torch

from vipe_core.ba.answer import Answer
from vipe_core.ba.cuda.launcher import device_launcher
from vipe_core.ba.cuda.solver import Adjustment, specialisation
from vipe_core.ba.depth_prior import has_freedom
from vipe_core.ba.problem import Options, Problem, State


def takes(problem: Problem, state: State) -> bool:
    """Whether the kernels are for a problem: single precision, something measured, no scales or shifts of depth priors.

    Those of a frame depend on all of its depths, and a pass over the cells finishes the step of a tile's depths where
    it already needs what the prior says of them.
    """
    measured = len(problem.edges.source) > 0
    return state.inverse_depth.dtype == torch.float32 and measured and not has_freedom(problem.priors)


def prepare(problem: Problem, state: State, options: Options) -> Adjustment | None:
    """A problem that the kernels take, ready to run; None where they cannot be compiled or loaded (logged once)."""
    device = state.inverse_depth.device
    index = torch.cuda.current_device() if device.index is None else device.index
    launcher = device_launcher(index, specialisation(problem, state, options))
    if launcher is None:
        return None
    return Adjustment(problem, state, options, launcher)


def solve(problem: Problem, state: State, options: Options) -> Answer | None:
    """See `vipe_core.ba.solve`. Nothing waits for the GPU where graph and flags are on the host; None as `prepare`."""
    with torch.cuda.device(state.inverse_depth.device):
        adjustment = prepare(problem, state, options)
        if adjustment is None:
            return None
        adjustment.run()
        return adjustment.answer()
