"""A whole bundle adjustment on the GPU: buffers, the sequence of launches, and the answer.

`Adjustment` prepares a problem once; `run` only launches work on the current stream, always the same, so it can be
captured in a CUDA graph and replayed after the tensors of problem and state were overwritten in place. The engine does
not: its window of edges changes with every keyframe, laying that out takes the host longer than all launches of the
three or four solves that follow, and these do not wait for the GPU. What each kernel does is in `kernels/*.cu`.
"""

from __future__ import annotations

import ctypes
import math
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from vipe_core.ba.answer import Answer, num_cameras, report_size
from vipe_core.ba.cuda.compiler import COMPONENTWISE, Specialisation
from vipe_core.ba.cuda.context import (
    ASSEMBLE_BLOCKS,
    CONTROL_BYTES,
    EDGE_FLOATS,
    FACTOR_THREADS,
    SIDE,
    SLICE,
    TILE,
    TILE_THREADS,
    TWIST_FLOATS,
    WIDE_THREADS,
    Context,
)
from vipe_core.ba.cuda.launcher import Launch, Launcher
from vipe_core.ba.cuda.layout import LARGE_SHARED_BYTES, Layout, Tail, Unknowns, build_layout
from vipe_core.ba.problem import Grid, Options, Points, Problem, State
from vipe_core.ba.reprojection import median_inverse_depth
from vipe_core.ba.rigs import unknowns_of
from vipe_core.ba.robust import CODE
from vipe_core.ba.rules import MIN_DAMPING, SIGMA_DAMPINGS


def specialisation(problem: Problem, state: State, options: Options) -> Specialisation:
    """The kernels that a problem needs."""
    unified, free = problem.camera_model == "mei", problem.free
    focal, alpha = free.focal, unified and free.distortion
    apart, points = (focal or alpha) and num_cameras(state) > 1, isinstance(problem.grid, Points)
    robust = COMPONENTWISE if options.componentwise else options.robust
    return Specialisation(unified, focal, alpha, robust, apart, points)


class Adjustment:
    """One problem, ready to be solved.

    Args:
        problem: Measurements and priors on one device in float32 (others are copied); the graph and what is free may be
            on the host, which saves a wait for the device.
        state: float32 inverse depths, on that device.
        options: How to solve.
        launcher: The kernels of `specialisation(problem, state, options)`.
    """

    def __init__(self, problem: Problem, state: State, options: Options, launcher: Launcher) -> None:
        self._problem, self._state, self._options, self._launcher = problem, state, options, launcher
        self._on_stream: Launch
        self._device = state.inverse_depth.device
        edges, free, priors = problem.edges, problem.free, problem.priors
        self._kind = kind = specialisation(problem, state, options)
        self._intrinsics_free = (kind.focal, kind.alpha)
        unknowns = unknowns_of(problem)
        self._num_views = 0 if state.cam_from_rig is None or problem.rig is None else len(state.cam_from_rig)
        self._num_cameras = num_cameras(state)
        self._tail = Tail(kind.focal + kind.alpha, self._num_cameras if kind.apart else 1)
        views = torch.zeros(max(self._num_views, 1), dtype=torch.bool)
        views[: len(unknowns.views)] = unknowns.views
        self._views_free = bool(views.any())
        self._layout = layout = _layout(
            *(_bytes(frames, torch.int64) for frames in (edges.source, edges.target)),
            *(_bytes(frames, torch.int64) for frames in (unknowns.pose_of_frame, unknowns.view_of_frame)),
            *(_bytes(what, torch.bool) for what in (unknowns.poses, views, free.inverse_depth)),
            self._num_views > 0,
            self._num_cameras,
            problem.grid.num_cells,
            self._tail,
        )
        self._tensors: dict[str, Tensor] = {}
        self._has_prior = priors.inverse_depth is not None and priors.inverse_depth_weight is not None
        self._has_view_prior = priors.cam_from_rig is not None and free.extrinsics and self._num_views > 0
        self._allocate(layout)
        self._upload(layout)
        self._context = self._fill_context(layout)
        self._parameters = _Parameters(self._context)
        self._levels = len(layout.level_columns) - 1

    # -- memory ----------------------------------------------------------------------------------------------------

    def _allocate(self, layout: Layout) -> None:
        edges, priors = self._problem.edges, self._problem.priors
        frames, cells = self._state.inverse_depth.shape
        count, single, double = len(edges.source), torch.float32, torch.float64
        tensors = self._tensors
        if isinstance(self._problem.grid, Points):
            tensors["points"] = self._input(self._problem.grid.px)
        tensors["target_px"] = self._input(edges.target_px)
        tensors["weight"] = self._input(edges.weight)
        if self._has_prior and priors.inverse_depth is not None and priors.inverse_depth_weight is not None:
            tensors["prior_value"] = self._input(priors.inverse_depth)
            tensors["prior_weight"] = self._input(priors.inverse_depth_weight)
        if priors.cam_from_rig is not None and priors.extrinsic_sigma is not None and self._has_view_prior:
            for name, given in (("prior_view", priors.cam_from_rig), ("prior_sigma", priors.extrinsic_sigma)):
                tensors[name] = given.to(self._device, double, non_blocking=True).contiguous()
        sides, tiles = layout.num_sides, layout.num_tiles
        large_blocks = layout.num_large * self._slices
        shapes: dict[str, tuple[torch.dtype, tuple[int, ...]]] = {
            "finite": (torch.uint8, (1,)),
            "median": (single, (1,)),
            "largest": (single, (count,)),
            "pose": (double, (2, frames, 16)),
            "depth": (single, (2, frames, cells)),
            "intrinsics": (double, (2, self._num_cameras, 5)),
            "view": (double, (2, self._num_views, 16)),
            "edge_transform": (single, (2, count, EDGE_FLOATS)),
            "edge_adjoint": (double, (count, 36)),
            "edge_twist": (single, (count, TWIST_FLOATS)),
            "pose_step": (double, (6 * frames + 2 * self._num_cameras,)),
            "partial": (single, (layout.partial_size,)),
            "scratch": (single, (large_blocks * layout.scratch_stride,)),
            "pool": (double, (layout.pool_parts, layout.pool_size, 36)),
            "unit_sums": (double, (layout.num_units, 5)),
            "blocks": (double, (2, layout.num_blocks, 2, 36)),
            "factor": (double, (tiles, SIDE, SIDE)),
            "diagonal_factor": (double, (sides, SIDE, SIDE)),
            "scale": (double, (sides * SIDE,)),
            "solution": (double, (sides * SIDE,)),
            "inverse": (double, (2, self._tail.intrinsics)),
            "control": (torch.uint8, (CONTROL_BYTES,)),
            "report": (double, (report_size(self._problem, self._state, extrinsics=False),)),
        }
        for name, (dtype, shape) in shapes.items():
            tensors[name] = torch.empty(shape, dtype=dtype, device=self._device)

    def _input(self, tensor: Tensor) -> Tensor:
        return tensor.to(self._device, torch.float32).contiguous()

    @property
    def _slices(self) -> int:
        return -(-self._problem.grid.num_cells // SLICE)

    def _upload(self, layout: Layout) -> None:
        """All tables in one copy."""
        log_focal = self._problem.priors.log_focal
        of_cameras = np.broadcast_to(0.0 if log_focal is None else np.asarray(log_focal, float), self._num_cameras)
        grid, frames = self._problem.grid, len(self._state.inverse_depth)
        cells = np.broadcast_to(grid.num_cells if isinstance(grid, Grid) else grid.count.cpu().numpy(), frames)
        tables = layout.tables | {"prior_log_focal": of_cameras, "frame_cells": cells.astype(np.int32)}
        offsets, size = {}, 0
        for name, table in tables.items():
            offsets[name] = size
            size += -(-table.nbytes // 16) * 16
        packed = np.zeros(size, np.uint8)
        for name, table in tables.items():
            packed[offsets[name] : offsets[name] + table.nbytes] = np.frombuffer(table.tobytes(), np.uint8)
        on_host = torch.from_numpy(packed)
        # Does not wait for the GPU: what is not pinned is copied to where the driver sends it from.
        self._tables = on_host.to(self._device, non_blocking=True)
        self._table_offsets = offsets

    def _fill_context(self, layout: Layout) -> Context:
        problem, options, priors = self._problem, self._options, self._problem.priors
        frames, cells = self._state.inverse_depth.shape
        grid = problem.grid if isinstance(problem.grid, Grid) else None
        focal_free, alpha_free = self._intrinsics_free
        any_depth = bool(layout.tables["unit_free"].any())
        information = 1 / priors.log_focal_sigma**2 if priors.log_focal is not None and focal_free else 0.0
        context = Context(
            num_frames=frames,
            num_edges=len(problem.edges.source),
            num_cells=cells,
            width=cells if grid is None else grid.width,
            num_units=layout.num_units,
            num_slices=self._slices,
            num_nodes=layout.num_nodes,
            num_tail=self._tail.nodes,
            num_intrinsics=self._tail.intrinsics,
            num_blocks=layout.num_blocks,
            num_sides=layout.num_sides,
            unified=problem.camera_model == "mei",
            focal_free=focal_free,
            alpha_free=alpha_free,
            robust=CODE[options.robust],
            anything_free=layout.num_nodes > 0 or focal_free or alpha_free or any_depth,
            max_iterations=options.max_iterations,
            has_prior=self._has_prior,
            scratch_stride=layout.scratch_stride,
            num_cameras=self._num_cameras,
            apart=self._kind.apart,
            num_views=self._num_views,
            views_free=self._views_free,
            has_view_prior=self._has_view_prior,
            num_pool=layout.pool_size,
            stride=0.0 if grid is None else grid.stride,
            offset=0.0 if grid is None else grid.offset,
            robust_scale=options.robust_scale_px,
            first_scale=options.initial_scale_px or 0.0,
            tolerance=options.relative_tolerance,
            initial_damping=options.initial_damping,
            min_damping=MIN_DAMPING[torch.float32],
            min_depth_ratio=options.min_depth_ratio,
            min_depth=options.min_inverse_depth,
            max_depth=options.max_inverse_depth,
            log_focal_information=information,
            components=1.0 + options.componentwise,
        )
        for name, tensor in self._tensors.items():
            setattr(context, name, tensor.data_ptr())
        for name, offset in self._table_offsets.items():
            setattr(context, name, self._tables.data_ptr() + offset)
        return context

    # -- work ------------------------------------------------------------------------------------------------------

    def run(self) -> None:
        """Launch everything, without waiting for any of it. May be captured."""
        self._on_stream = self._launcher.on_current_stream()
        self._reset()
        layout, options = self._layout, self._options
        first = options.initial_scale_px
        self._launch("begin", 1, 1)
        if first is not None and math.isinf(first):
            self._launch("transform", self._edge_blocks, WIDE_THREADS)
            self._launch("largest", len(self._problem.edges.source), TILE)
            self._launch("widen", 1, WIDE_THREADS)
        # Graduated non-convexity linearises anew where a level ended without a step, and once at the last scale.
        levels = max(options.max_iterations // 2, 1) + 1 if first is not None else 0
        for _ in range(options.max_iterations + levels):
            self._linearise()
            self._factorise(0)
            for level in reversed(range(self._levels)):
                begin, end = layout.level_columns[level : level + 2]
                self._launch("substitute", end - begin, FACTOR_THREADS, begin)
            self._launch("propose", 1, WIDE_THREADS)
        self._linearise()
        for attempt in range(1, len(SIGMA_DAMPINGS) + 1) if any(self._intrinsics_free) else ():
            self._factorise(attempt)
            self._launch("covariance", 1, 1, attempt)
        frames, cells = self._state.inverse_depth.shape
        copied = max(frames * cells, 16 * frames, 16 * self._num_views, 5 * self._num_cameras)
        self._launch("finish", -(-copied // WIDE_THREADS), WIDE_THREADS)

    def assemble(self, times: int) -> None:
        """Launch what a linearisation of the state given takes, so many times: to measure it."""
        self._on_stream = self._launcher.on_current_stream()
        self._reset()
        self._launch("begin", 1, 1)
        for _ in range(times):
            self._linearise()

    def _reset(self) -> None:
        """The state into both buffers, and what depends on the input only."""
        state, priors, tensors = self._state, self._problem.priors, self._tensors
        tensors["pose"].copy_(state.cam_from_world.flatten(1))
        tensors["depth"].copy_(state.inverse_depth)
        tensors["intrinsics"].zero_()
        tensors["intrinsics"][..., : state.intrinsics.shape[-1]].copy_(state.intrinsics)
        if state.cam_from_rig is not None and self._num_views:
            tensors["view"].copy_(state.cam_from_rig.flatten(1))
        tensors["median"].copy_(median_inverse_depth(self._problem.grid, state.inverse_depth))
        checks = [tensors[name].isfinite().all() for name in ("pose", "depth", "intrinsics", "view")]
        if "points" in tensors:
            checks.append(tensors["points"].isfinite().all())
        if self._has_prior and priors.inverse_depth is not None and priors.inverse_depth_weight is not None:
            weight = tensors["prior_weight"]
            checks.append(weight.isfinite().all())
            checks.append((tensors["prior_value"].isfinite() | (weight <= 0)).all())
        tensors["finite"].copy_(torch.stack(checks).all())

    def _linearise(self) -> None:
        layout = self._layout
        small = layout.num_units - layout.num_large
        self._launch("transform", self._edge_blocks, WIDE_THREADS)
        if layout.num_large:
            self._launch("tile_large", layout.num_large * self._slices, TILE_THREADS, 0, LARGE_SHARED_BYTES)
        if small:
            self._launch("tile", small * self._slices, TILE_THREADS, layout.num_large, layout.shared_bytes)
        self._launch("fold", layout.num_units, WIDE_THREADS)
        if self._num_views:
            self._launch("turn", -(-layout.pool_size // ASSEMBLE_BLOCKS), WIDE_THREADS)
        self._launch("assemble", -(-layout.num_blocks // ASSEMBLE_BLOCKS), WIDE_THREADS)
        self._launch("judge", 1, WIDE_THREADS)

    def _factorise(self, covariance: int) -> None:
        layout = self._layout
        self._launch("damp", layout.num_tiles, FACTOR_THREADS, covariance)
        for level in range(self._levels):
            begin, end = layout.level_tiles[level : level + 2]
            if level:
                self._launch("gather", end - begin, FACTOR_THREADS, covariance, second=begin)
            self._launch("factorise", end - begin, FACTOR_THREADS, covariance, second=begin)

    @property
    def _edge_blocks(self) -> int:
        return -(-len(self._problem.edges.source) // WIDE_THREADS)

    def _launch(
        self, kernel: str, blocks: int, threads: int, first: int = 0, shared_bytes: int = 0, *, second: int = 0
    ) -> None:
        address = self._parameters.address(first, second)
        self._on_stream(kernel, blocks, threads, shared_bytes, address)

    # -- answer ----------------------------------------------------------------------------------------------------

    def answer(self) -> Answer:
        """What the last `run` leaves; copies, so another one may follow. Nothing is said of how sure extrinsics are."""
        tensors, given = self._tensors, self._state
        views = tensors["view"][0].view(-1, 4, 4)
        return Answer(
            tensors["pose"][0].view_as(given.cam_from_world).clone(),
            tensors["depth"][0].clone(),
            tensors["intrinsics"][0, :, : given.intrinsics.shape[-1]].reshape(given.intrinsics.shape).clone(),
            (views if self._num_views or given.cam_from_rig is None else given.cam_from_rig).clone(),
            tensors["report"].clone(),
        )


class _Parameters:
    """The arguments of a launch where the driver finds them: the context, and up to two numbers."""

    def __init__(self, context: Context) -> None:
        self._context = context
        self._numbers = (ctypes.c_int * 2)()
        start = ctypes.addressof(self._numbers)
        self._addresses = (ctypes.c_void_p * 3)(ctypes.addressof(context), start, start + ctypes.sizeof(ctypes.c_int))
        self._address = ctypes.addressof(self._addresses)

    def address(self, first: int, second: int) -> int:
        self._numbers[0], self._numbers[1] = first, second
        return self._address


def _bytes(tensor: Tensor, dtype: torch.dtype) -> bytes:
    return tensor.detach().cpu().to(dtype).contiguous().numpy().tobytes()


@lru_cache(maxsize=32)
def _layout(
    source: bytes,
    target: bytes,
    pose_of_frame: bytes,
    view_of_frame: bytes,
    poses: bytes,
    views: bytes,
    depths: bytes,
    rig: bool,
    cameras: int,
    cells: int,
    tail: Tail,
) -> Layout:
    """`build_layout`, kept for the graphs solved last: a schedule of kernels solves the same graph several times."""
    ints = [np.frombuffer(frames, np.int64) for frames in (source, target, pose_of_frame, view_of_frame)]
    flags = [np.frombuffer(free, np.bool_) for free in (poses, views, depths)]
    unknowns = Unknowns(ints[2], ints[3], flags[0], flags[1], rig, cameras)
    return build_layout(ints[0], ints[1], unknowns, flags[2], cells, tail)
