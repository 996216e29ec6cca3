"""Bundle adjustment as one operator of torch: `vipe_core::bundle_adjustment`, and the entry point that calls it.

An operator is a whole solve and not a step of it. Steps are decided on by costs that the solver has; between two
operators they would come back to the host, or every caller would carry the state of the descent around. So there is one
place where a device is chosen (torch's dispatcher), nothing but the answer is read, and what a tracer or a compiler of
torch sees is one opaque function without side effects.

Where `State.inverse_depth` is on a CPU, the descent of `levenberg.py` runs over compiled loops; on a GPU, the CUDA
kernels run it, or `levenberg.py` over torch on that GPU: for what `cuda.takes` says they are not for, and where
they cannot be had.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import torch
from torch import Tensor

from vipe_core.ba import cuda, levenberg
from vipe_core.ba.answer import Answer, answer_of, report_size, result_of
from vipe_core.ba.problem import Edges, Free, Grid, Options, Points, Priors, Problem, Result, Rig, RobustKernel, State
from vipe_core.cameras import CameraModel


def solve(problem: Problem, state: State, options: Options | None = None) -> Result:
    """Minimise the robust cost from a state, accepting only steps that lower it.

    Measurements and state may be on different devices; the work is done where `state.inverse_depth` is, in its dtype
    (float32, or float64 throughout), with everything from 6x6 blocks on in float64. A graph, and what is free of it,
    that are on the host save waits for the GPU.

    Args:
        problem: Graph, measurements, priors and what is free.
        state: Where to start. It is not changed.
        options: How to solve.

    Returns:
        The new state, on the same device, and why the solve ended. `cost` and `initial_cost` are of the measurements
        alone; priors, and a charge for points that fall behind their target camera, take part in accepting a step.

    Raises:
        ConfigError: A camera model without derivatives here.
        ValueError: Inverse depths that are neither float32 nor float64; a rig without its extrinsics, or with a pose
            that is free in some frames only.
    """
    levenberg.require_solvable(problem, state)
    answer = bundle_adjustment(*_arguments(problem, state, options or Options()))
    return result_of(answer, state)


def _arguments(problem: Problem, state: State, options: Options) -> tuple[Any, ...]:
    """Problem, state and options as the operator takes them: what says how a graph is laid out on the host, all else
    where the inverse depths are."""
    device = state.inverse_depth.device
    edges, free, priors, rig = problem.edges, problem.free, problem.priors, problem.rig
    grid, log_focal = problem.grid, priors.log_focal
    points = grid if isinstance(grid, Points) else None
    return (
        problem.camera_model,
        [] if isinstance(grid, Points) else [grid.height, grid.width],
        [] if isinstance(grid, Points) else [grid.stride, grid.offset],
        None if points is None else points.px.to(device),
        None if points is None else points.count.cpu(),
        edges.source.cpu(),
        edges.target.cpu(),
        edges.target_px.to(device),
        edges.weight.to(device),
        free.poses.cpu(),
        free.inverse_depth.cpu(),
        [free.focal, free.distortion, free.extrinsics],
        None if priors.inverse_depth is None else priors.inverse_depth.to(device),
        None if priors.inverse_depth_weight is None else priors.inverse_depth_weight.to(device),
        [] if log_focal is None else list(log_focal) if isinstance(log_focal, tuple) else [log_focal],
        priors.cam_from_rig,
        [priors.log_focal_sigma, priors.inverse_depth_scale_sigma, priors.inverse_depth_shift_sigma],
        priors.extrinsic_sigma,
        None if rig is None else rig.pose_of_frame.cpu(),
        None if rig is None else rig.view_of_frame.cpu(),
        state.cam_from_world.to(device),
        state.inverse_depth,
        state.intrinsics.to(device),
        None if state.cam_from_rig is None else state.cam_from_rig.to(device),
        options.robust,
        options.componentwise,
        options.max_iterations,
        options.initial_scale_px,
        [
            options.relative_tolerance,
            options.robust_scale_px,
            options.initial_damping,
            options.min_inverse_depth,
            options.max_inverse_depth,
            options.min_depth_ratio,
        ],
    )


def _problem(
    camera_model: str,
    grid_cells: Sequence[int],
    grid_px: Sequence[float],
    points_px: Tensor | None,
    points_count: Tensor | None,
    source: Tensor,
    target: Tensor,
    target_px: Tensor,
    weight: Tensor,
    free_poses: Tensor,
    free_depths: Tensor,
    free: Sequence[bool],
    prior_depth: Tensor | None,
    prior_depth_weight: Tensor | None,
    prior_log_focal: Sequence[float],
    prior_cam_from_rig: Tensor | None,
    prior_sigmas: Sequence[float],
    prior_extrinsic_sigma: Tensor | None,
    pose_of_frame: Tensor | None,
    view_of_frame: Tensor | None,
    cam_from_world: Tensor,
    inverse_depth: Tensor,
    intrinsics: Tensor,
    cam_from_rig: Tensor | None,
    robust: str,
    componentwise: bool,
    max_iterations: int,
    initial_scale_px: float | None,
    settings: Sequence[float],
) -> tuple[Problem, State, Options]:
    """The arguments of the operator, put together again."""
    log_focal = tuple(prior_log_focal)
    tolerance, scale_px, damping, least_depth, most_depth, depth_ratio = settings
    problem = Problem(
        cast("CameraModel", camera_model),
        Grid(*grid_cells, *grid_px) if points_px is None or points_count is None else Points(points_px, points_count),
        Edges(source, target, target_px, weight),
        Free(free_poses, free_depths, *free),
        Priors(
            prior_depth,
            prior_depth_weight,
            None if not log_focal else log_focal[0] if len(log_focal) == 1 else log_focal,
            prior_sigmas[0],
            prior_cam_from_rig,
            prior_extrinsic_sigma,
            *prior_sigmas[1:],
        ),
        None if pose_of_frame is None or view_of_frame is None else Rig(pose_of_frame, view_of_frame),
    )
    options = Options(
        max_iterations=max_iterations,
        relative_tolerance=tolerance,
        robust=cast("RobustKernel", robust),
        componentwise=componentwise,
        robust_scale_px=scale_px,
        initial_scale_px=initial_scale_px,
        initial_damping=damping,
        min_inverse_depth=least_depth,
        max_inverse_depth=most_depth,
        min_depth_ratio=depth_ratio,
    )
    return problem, State(cam_from_world, inverse_depth, intrinsics, cam_from_rig), options


# As `_problem`, and `Answer`.
_SCHEMA = (
    "(str camera_model, int[] grid_cells, float[] grid_px, Tensor? points_px, Tensor? points_count, Tensor source, "
    "Tensor target, Tensor target_px, Tensor weight, Tensor free_poses, Tensor free_depths, bool[] free, "
    "Tensor? prior_depth, Tensor? prior_depth_weight, float[] prior_log_focal, Tensor? prior_cam_from_rig, "
    "float[] prior_sigmas, Tensor? prior_extrinsic_sigma, "
    "Tensor? pose_of_frame, Tensor? view_of_frame, Tensor cam_from_world, Tensor inverse_depth, Tensor intrinsics, "
    "Tensor? cam_from_rig, str robust, bool componentwise, int max_iterations, float? initial_scale_px, "
    "float[] settings) "
    "-> (Tensor cam_from_world, Tensor inverse_depth, Tensor intrinsics, Tensor cam_from_rig, Tensor report)"
)


# Not by `torch.library.custom_op`: its first call imports torch's compiler, two seconds for every process.
_library: Any = torch.library  # has no types
_LIBRARY = _library.Library("vipe_core", "FRAGMENT")
_LIBRARY.define(f"bundle_adjustment{_SCHEMA}")


def bundle_adjustment(*arguments: Any) -> Answer:
    """`Answer` of the arguments that `_arguments` gives."""
    return Answer(*torch.ops.vipe_core.bundle_adjustment.default(*arguments))


def _on_host(*arguments: Any) -> Answer:
    return _descended(*_problem(*arguments))


def _descended(problem: Problem, state: State, options: Options) -> Answer:
    return answer_of(levenberg.descend(problem, state, options), report_size(problem, state))


def _on_gpu(*arguments: Any) -> Answer:
    problem, state, options = _problem(*arguments)
    answer = cuda.solve(problem, state, options) if cuda.takes(problem, state) else None
    if answer is None:
        return _descended(problem, state, options)
    if not problem.refines_rig:
        return answer
    # Of extrinsics that are refined, the kernels leave it to torch to say how sure they are.
    solved = State(answer.cam_from_world, answer.inverse_depth, answer.intrinsics, answer.cam_from_rig)
    covariances = levenberg.extrinsic_covariances(problem, solved, options)
    return answer._replace(report=torch.cat((answer.report, covariances.flatten())))


def _shapes(*arguments: Any) -> Answer:
    problem, state, _ = _problem(*arguments)
    return Answer(
        torch.empty_like(state.cam_from_world),
        torch.empty_like(state.inverse_depth),
        torch.empty_like(state.intrinsics),
        state.cam_from_world.new_empty(0, 4, 4) if state.cam_from_rig is None else torch.empty_like(state.cam_from_rig),
        state.inverse_depth.new_empty(report_size(problem, state), dtype=torch.float64),
    )


_LIBRARY.impl("bundle_adjustment", _on_host, "CPU")
_LIBRARY.impl("bundle_adjustment", _on_gpu, "CUDA")
_library.register_fake("vipe_core::bundle_adjustment", _shapes, lib=_LIBRARY)
