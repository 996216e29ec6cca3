"""The solver of bundle adjustment for a CPU: compiled loops and a sparse reduced system.

The same problem and the same step as `torch_solver.py`, which documents the algebra. The reduced system is stored as
6x6 blocks in the structure of its Cholesky factor, one block row per free pose and one for the intrinsics, so memory
grows with the edges and not with the square of the frames.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from vipe_core.ba import block_cholesky, depth_prior, kernels, robust
from vipe_core.ba.kernel_inputs import Array, DepthPrior, Graph, Pose, Robust
from vipe_core.ba.problem import Options, Points, Problem, State
from vipe_core.ba.reduced import add_frames, add_twists, damp
from vipe_core.ba.reprojection import cameras_of, median_inverse_depth, rays_of
from vipe_core.ba.rigs import extrinsic_prior, moved_poses, turns_of, unknowns_of
from vipe_core.ba.rules import ALPHA_RANGE, MAX_LOG_FOCAL_STEP
from vipe_core.ba.solver import Cost, Step
from vipe_core.cameras import projection
from vipe_core.geometry import se3

# Less work than this many edge cells is not worth waking another thread for.
_CELLS_PER_THREAD = 1 << 16


@dataclass(frozen=True, slots=True)
class HostSystem:
    """The normal equations at a state, in the structure of the factor.

    Attributes:
        direct: (B, 6, 6) float64 J^T J of poses and intrinsics.
        eliminated: The same shape: what eliminating the undamped depths subtracts.
        direct_gradient: (nodes, 6) float64 -J^T r, in order of elimination.
        eliminated_gradient: The same shape.
        pose: What the kernels need of the state.
        adjoint: (E, 6, 6) of target_from_source, edges in order.
        state: Where.
        scale: (2,) squares of the robust kernel's scale and of the one it ends at, px^2.
        cost: By-product of the linearisation.
        prior: Of the depths.
        of_prior: By frame, see `HostSolver._eliminate_priors`.
    """

    direct: Array
    eliminated: Array
    direct_gradient: Array
    eliminated_gradient: Array
    pose: Pose
    adjoint: Array
    state: State
    scale: Array
    cost: Cost
    prior: DepthPrior
    of_prior: list[Array] | None


class HostSolver:
    """Cost, linearisation and step of one problem on the CPU. Built once per solve."""

    def __init__(self, problem: Problem, options: Options, state: State) -> None:
        self.problem, self.options = problem, options
        dtype = state.inverse_depth.dtype
        self._dtype = dtype
        edges, free = problem.edges, problem.free
        num_frames = len(free.poses)
        cameras, camera_of = cameras_of(state.intrinsics, problem.rig, num_frames)
        self._num_cameras = len(cameras)
        order = torch.argsort(edges.source * num_frames + edges.target, stable=True)
        self._source, self._target = edges.source[order], edges.target[order]
        degree = torch.bincount(edges.source, minlength=num_frames)
        first = np.zeros(num_frames + 1, np.int64)
        np.cumsum(degree.numpy(), out=first[1:])
        depth_free = (free.inverse_depth.cpu() & (degree > 0)).numpy()
        self._depth_free = depth_free
        self._camera_of = camera_of
        grid = problem.grid
        real = grid.count.cpu() if isinstance(grid, Points) else torch.full((num_frames,), grid.num_cells)
        self._graph = Graph(
            first=first,
            edge=order.numpy(),
            target_px=_flat(edges.target_px, dtype),
            weight=_flat(edges.weight, dtype),
            depth_free=depth_free,
            num_cells=real.numpy(),
            table=(torch.arange(num_frames) if isinstance(grid, Points) else camera_of).numpy(),
            source_camera=camera_of.numpy(),
            target_camera=camera_of[self._target].numpy(),
        )
        sigmas = (problem.priors.inverse_depth_scale_sigma, problem.priors.inverse_depth_shift_sigma)
        self._own_priors = np.array(sigmas) > 0 if depth_prior.has_freedom(problem.priors) else np.zeros(2, bool)
        self._prior, _ = self._depth_prior(state)

        self._unknowns = unknowns = unknowns_of(problem)
        # Of the rig poses, then of the extrinsics that move, their numbers among the unknowns; -1 for what is held.
        number = np.cumsum(np.concatenate((unknowns.poses.numpy(), unknowns.views.numpy()))) - 1
        number[~np.concatenate((unknowns.poses.numpy(), unknowns.views.numpy()))] = -1
        self._num_unknown = int(unknowns.poses.sum() + unknowns.views.sum())
        self._pose_of = number[unknowns.pose_of_frame.numpy()]
        self._number_of_view = number[len(unknowns.poses) :]
        self.intrinsics_free = (free.focal, free.distortion and problem.camera_model == "mei")
        self._free = np.array(self.intrinsics_free)
        # Cameras with unknowns of their own; where nothing is free, one that stands for all.
        self._num_apart = self._num_cameras if self._free.any() else 1
        tail = kernels.TAIL * (self._num_apart + bool(self._own_priors.any()))
        size = np.where(depth_free, 6 * degree.numpy() + tail, 0)
        self._offset = np.zeros(num_frames + 1, np.int64)
        np.cumsum(size * size, out=self._offset[1:])
        self.anything_free = bool(self._num_unknown or self._free.any() or depth_free.any())
        self._structure = self._analyse()
        # Columns of each frame's pose and of each view's extrinsics; -1 where held.
        place = np.append(self._structure.place[: self._num_unknown], -1)
        self._pose_place, self._view_place = place[self._pose_of], place[self._number_of_view]
        self._per_frame = None if problem.rig is None else self._structure_of_frames()

        self._kernel = Robust(robust.CODE[options.robust], options.componentwise)
        self._sample_px = problem.grid.sample_px()
        self._rays: tuple[Tensor, Array, Array, Array] | None = None
        self._seen: tuple[State, Pose, Tensor] | None = None
        median = median_inverse_depth(grid, state.inverse_depth)
        self._depth_range = (options.min_inverse_depth * median, options.max_inverse_depth * median)
        held = torch.from_numpy(~depth_free)
        self._held = held[:, None] | ~grid.real() if isinstance(grid, Points) else held
        cells = len(self._source) * grid.num_cells
        self._threads = max(1, min(torch.get_num_threads(), cells // _CELLS_PER_THREAD))

    def _depth_prior(self, state: State) -> tuple[DepthPrior, depth_prior.DepthPrior | None]:
        """For the kernels, and what it is. Where no frame has a scale or a shift of its own, always the same."""
        priors, cells, dtype = self.problem.priors, self.problem.grid.num_cells, self._dtype
        nothing = torch.empty(0, cells, dtype=dtype).numpy()
        none = np.empty((0, 2, cells), nothing.dtype)
        if priors.inverse_depth is None or priors.inverse_depth_weight is None:
            return DepthPrior(nothing, nothing, none), None
        weight = priors.inverse_depth_weight.to(dtype).contiguous()
        fitted = depth_prior.depth_prior(priors, state.inverse_depth, slice(None)) if self._own_priors.any() else None
        if fitted is None or fitted.coupling is None:
            return DepthPrior(priors.inverse_depth.to(dtype).contiguous().numpy(), weight.numpy(), none), None
        coupling = np.zeros((len(weight), 2, cells), nothing.dtype)
        coupling[:, self._own_priors] = fitted.coupling.numpy()
        return DepthPrior((state.inverse_depth + fitted.off).numpy(), weight.numpy(), coupling), fitted

    def _cliques(self, of_frame: Callable[[int], list[int]]) -> list[list[int]]:
        """Sets of unknowns that are coupled: a frame with free depths couples all that see it, an edge with fixed ones
        what is at its ends.

        Args:
            of_frame: The unknowns behind a frame's twist.
        """
        behind = [of_frame(frame) for frame in range(len(self._depth_free))]
        target = self._target.tolist()
        cliques: list[list[int]] = []
        first = self._graph.first
        for frame, free in enumerate(self._depth_free):
            begin, end = first[frame], first[frame + 1]
            if free:
                cliques.append([node for k in (frame, *target[begin:end]) for node in behind[k]])
            else:
                cliques += [[*behind[frame], *behind[j]] for j in target[begin:end]]
        return cliques

    def _analyse(self) -> block_cholesky.Structure:
        view_of = self._number_of_view[self._unknowns.view_of_frame.numpy()].tolist()
        pose_of = self._pose_of.tolist()

        def unknown(frame: int) -> list[int]:
            return [node for node in (pose_of[frame], view_of[frame]) if node >= 0]

        return block_cholesky.analyse(self._num_unknown, self._cliques(unknown), self._num_dense)

    def _structure_of_frames(self) -> block_cholesky.Structure:
        """Blocks of the system in the twists of frames, before it is taken to those of a rig: nothing is eliminated."""
        moving = self._unknowns.frames.tolist()

        def alone(frame: int) -> list[int]:
            return [frame] if moving[frame] else []

        return block_cholesky.pattern(len(moving), self._cliques(alone), self._num_dense)

    @property
    def _num_dense(self) -> int:
        """Nodes of intrinsics."""
        return self._num_apart if self._free.any() else 0

    # -- state -----------------------------------------------------------------------------------------------------

    def _pose(self, state: State) -> tuple[Pose, Tensor]:
        """What the kernels need of a state, and the transforms of the edges. The last one is kept.

        An accepted state is judged first and linearised next.
        """
        if self._seen is None or self._seen[0] is not state:
            self._seen = (state, *self._see(state))
        return self._seen[1:]

    def _see(self, state: State) -> tuple[Pose, Tensor]:
        model, intrinsics = self.problem.camera_model, state.intrinsics.reshape(self._num_cameras, -1)
        transform = se3.relative(state.cam_from_world[self._target], state.cam_from_world[self._source])
        if self._rays is None or not torch.equal(self._rays[0], intrinsics):
            through = rays_of(model, self._sample_px, intrinsics, self._camera_of, self.options.min_depth_ratio)
            by_intrinsics = projection.unproject_jacobian(model, through.params, self._sample_px).permute(0, 3, 2, 1)
            slopes = torch.zeros(len(by_intrinsics), 2, *by_intrinsics.shape[2:], dtype=self._dtype)
            slopes[:, : by_intrinsics.shape[1]] = by_intrinsics
            tables = through.rays.mT.to(self._dtype).contiguous()
            self._rays = (intrinsics.clone(), tables.numpy(), slopes.numpy(), through.min_s.to(self._dtype).numpy())
        cameras = torch.zeros(self._num_cameras, 5, dtype=self._dtype)
        cameras[:, : intrinsics.shape[1]] = intrinsics
        return (
            Pose(
                transform=transform[:, :3].flatten(1).to(self._dtype).contiguous().numpy(),
                rays=self._rays[1],
                rays_by_intrinsics=self._rays[2],
                min_s=self._rays[3],
                inverse_depth=state.inverse_depth.contiguous().numpy(),
                camera=cameras.numpy(),
            ),
            transform,
        )

    def _over_frames(self, work: Callable[[int, int], None]) -> None:
        """Run `work(begin, end)` over all frames, in ranges of about as many edges each where there are threads."""
        first = self._graph.first
        if self._threads == 1:
            work(0, len(first) - 1)
            return
        shares = np.linspace(0, first[-1], 4 * self._threads + 1)
        bounds = np.unique(np.concatenate(([0], np.searchsorted(first, shares[1:-1]), [len(first) - 1])))
        with ThreadPoolExecutor(self._threads) as pool:
            for done in [pool.submit(work, begin, end) for begin, end in pairwise(bounds.tolist())]:
                done.result()

    def _numbers(self, *values: float) -> Array:
        """Scalars in the dtype of the pixels, as the kernels take them."""
        return np.array(values, self._graph.weight.dtype)

    def _scale(self, scale_px: float) -> Array:
        return self._numbers(scale_px**2, self.options.robust_scale_px**2)

    def _prior_at(self, state: State) -> tuple[DepthPrior, depth_prior.DepthPrior | None]:
        return self._depth_prior(state) if self._own_priors.any() else (self._prior, None)

    def _cost(self, sums: Array, state: State, fitted: depth_prior.DepthPrior | None) -> Cost:
        measurements, weight, everything, prior = sums.sum(axis=0).tolist()
        if fitted is not None:
            prior += float(fitted.cost.numpy()[self._depth_free].sum())
        priors = self.problem.priors
        if priors.log_focal is not None and self.intrinsics_free[0]:
            prior += float(np.square(self._log_focal_off(state) / priors.log_focal_sigma).sum())
        if (extrinsic := self._extrinsic_prior(state)) is not None:
            prior += float(extrinsic[0].square().sum())
        return Cost(*torch.tensor([measurements, weight, everything - weight, prior], dtype=torch.float64))

    def _log_focal_off(self, state: State) -> Array:
        """(C,) prior of log f minus what it is."""
        now = state.intrinsics.reshape(self._num_cameras, -1)[:, 0].log()
        return np.asarray((now.new_tensor(self.problem.priors.log_focal) - now).numpy())

    def _extrinsic_prior(self, state: State) -> tuple[Tensor, Tensor, Tensor] | None:
        return extrinsic_prior(self.problem.priors, state) if self.problem.free.extrinsics else None

    # -- the solver's interface ------------------------------------------------------------------------------------

    def cost(self, state: State, scale_px: float) -> Cost:
        """The robust cost at a state."""
        pose, _ = self._pose(state)
        prior, fitted = self._prior_at(state)
        sums, scale = np.zeros((len(self._depth_free), 4)), self._scale(scale_px)
        self._over_frames(
            lambda begin, end: kernels.evaluate(self._graph, pose, prior, self._kernel, scale, begin, end, sums)
        )
        return self._cost(sums, state, fitted)

    def linearise(self, state: State, scale_px: float) -> HostSystem:
        """The normal equations at a state."""
        pose, transform = self._pose(state)
        graph, structure, scale = self._graph, self._structure, self._scale(scale_px)
        prior, fitted = self._prior_at(state)
        sums = np.zeros((len(self._depth_free), 4))
        rows = kernels.ROWS if self._num_apart == 1 else kernels.ROWS_APART
        per_edge = np.zeros(rows**2 * len(self._source))
        per_frame = np.zeros(self._offset[-1])
        self._over_frames(
            lambda begin, end: kernels.linearise(
                graph,
                pose,
                prior,
                self._kernel,
                scale,
                np.append(self._free, self._num_apart > 1),
                self._num_apart,
                begin,
                end,
                sums,
                per_edge,
                self._offset,
                per_frame,
            )
        )
        of_prior = self._eliminate_priors(per_frame, fitted)
        adjoint = se3.adjoint(transform).contiguous().numpy()
        turn = None if self._per_frame is None else np.asarray(turns_of(self.problem, state))
        assembled = self._per_frame or structure
        # The blocks of a frame: those of its pose, or of its own twist where these are still to be taken to a rig.
        place = self._pose_place
        if self._per_frame is not None:
            place = np.where(self._unknowns.frames.numpy(), np.arange(len(place)), -1)
        source, target = place[self._source.numpy()], place[self._target.numpy()]
        dense, source_camera = self._num_dense, graph.source_camera[self._source.numpy()]
        # Columns of the intrinsics, of all cameras, and of those of an edge.
        of_cameras = assembled.num_nodes - dense + np.arange(dense) if dense else np.full(1, -1)
        of_edges = of_cameras[np.stack((source_camera, graph.target_camera), axis=1)] if dense > 1 else of_cameras

        def add(group: Array, offset: Array, matrices: Array, cameras: Array) -> tuple[Array, Array]:
            blocks, gradient = np.zeros((assembled.num_blocks, 6, 6)), np.zeros((assembled.num_nodes, 6))
            add_twists(
                assembled.first,
                assembled.rows,
                group,
                source,
                target,
                np.ascontiguousarray(np.broadcast_to(cameras, (len(group) - 1, cameras.shape[-1]))),
                adjoint,
                offset,
                matrices,
                blocks,
                gradient,
            )
            if turn is None:
                return blocks, gradient
            into, into_gradient = np.zeros((structure.num_blocks, 6, 6)), np.zeros((structure.num_nodes, 6))
            last = structure.num_nodes - dense + np.arange(dense)
            add_frames(
                assembled.first,
                assembled.rows,
                blocks,
                gradient,
                turn,
                np.append(self._pose_place, np.full(dense, -1)),
                np.append(self._view_place[self._unknowns.view_of_frame.numpy()], last),
                structure.first,
                structure.rows,
                into,
                into_gradient,
            )
            return into, into_gradient

        singly = np.arange(len(source) + 1)
        direct, direct_gradient = add(singly, rows**2 * singly, per_edge, of_edges)
        # Scale and shift of a prior are no unknowns of the system any more.
        of_frames = np.append(of_cameras, -1) if of_prior is not None else of_cameras
        eliminated, eliminated_gradient = add(graph.first, self._offset, per_frame, of_frames)
        if (extrinsic := self._extrinsic_prior(state)) is not None:
            _, hessian, pull = extrinsic
            for view in np.flatnonzero(self._view_place >= 0):
                node = self._view_place[view]
                direct[structure.first[node]] += hessian[view].numpy()
                direct_gradient[node] += pull[view].numpy()
        priors = self.problem.priors
        if priors.log_focal is not None and self.intrinsics_free[0]:
            information = 1 / priors.log_focal_sigma**2
            direct[structure.first[-1 - dense : -1], 0, 0] += information
            direct_gradient[-dense:, 0] += information * self._log_focal_off(state)
        return HostSystem(
            direct,
            eliminated,
            direct_gradient,
            eliminated_gradient,
            pose,
            adjoint,
            state,
            scale,
            self._cost(sums, state, fitted),
            prior,
            of_prior,
        )

    def _eliminate_priors(self, per_frame: Array, fitted: depth_prior.DepthPrior | None) -> list[Array] | None:
        """Eliminate scales and shifts of priors from the frames' matrices.

        Returns:
            Of each frame S^-1 U^T Q [e_1; ..; v] (2, size), see `depth_prior.py`; None where they are held.
        """
        if fitted is None or fitted.curvature is None:
            return None
        own, found = np.flatnonzero(self._own_priors), []
        for frame, (begin, end) in enumerate(pairwise(self._offset.tolist())):
            size = math.isqrt(end - begin)
            matrix = per_frame[begin:end].reshape(size, size)
            pull = np.zeros((2, size))
            if size:
                rows = matrix[size - kernels.TAIL + own]
                pull[own] = np.linalg.solve(fitted.curvature[frame].numpy() - rows[:, size - kernels.TAIL + own], rows)
                matrix += rows.T @ pull[own]
            found.append(pull)
        return found

    def _factorise(self, system: HostSystem, damping: float) -> tuple[Array, Array, bool]:
        """Scale (nodes, 6), factor, and success of the damped, scaled reduced system."""
        structure = self._structure
        factor = np.empty_like(system.direct)
        scale = np.empty_like(system.direct_gradient)
        damp(structure.first, structure.rows, system.direct, system.eliminated, damping, factor, scale)
        return scale, factor, bool(block_cholesky.factorise(structure.first, structure.rows, factor))

    def step(self, system: HostSystem, damping: float) -> Step:
        """Solve the damped system: reduced system first, then every inverse depth."""
        structure, state = self._structure, system.state
        scale, factor, factorised = self._factorise(system, damping)
        solution = (system.direct_gradient - system.eliminated_gradient / (1 + damping)) * scale
        if factorised:
            block_cholesky.substitute(structure.first, structure.rows, factor, solution)
            solution *= scale
        else:
            solution[:] = np.nan
        moved, dense = np.zeros((self._num_cameras, 2)), self._num_dense
        of_cameras = solution[len(solution) - dense :]
        if self.intrinsics_free[0]:
            moved[:, 0] = of_cameras[:, 0] = np.clip(of_cameras[:, 0], -MAX_LOG_FOCAL_STEP, MAX_LOG_FOCAL_STEP)
        if self._free[1]:
            current = state.intrinsics.reshape(self._num_cameras, -1)[:, 4].numpy()
            moved[:, 1] = of_cameras[:, 1] = np.clip(current + of_cameras[:, 1], *ALPHA_RANGE) - current
        padded = np.concatenate((solution, np.zeros((1, 6))))
        pose = padded[self._pose_place]
        total, extrinsic = pose, None
        if self.problem.rig is not None:
            turn = np.asarray(turns_of(self.problem, state))
            pose = (turn @ pose[:, :, None])[:, :, 0]
            by_view = padded[self._view_place]
            total = pose + by_view[self._unknowns.view_of_frame.numpy()]
            extrinsic = torch.from_numpy(by_view)
        predicted_drop = float((system.direct_gradient * solution).sum())

        depth = torch.zeros_like(state.inverse_depth)
        if factorised and self._depth_free.any():
            twist = np.empty((len(self._source), 10), self._graph.weight.dtype)
            of_source = (system.adjoint @ total[self._source.numpy()][:, :, None])[:, :, 0]
            twist[:, :6] = total[self._target.numpy()] - of_source
            twist[:, 6:8] = moved[self._graph.source_camera[self._source.numpy()]]
            twist[:, 8:] = moved[self._graph.target_camera]
            shift, gain = self._prior_step(system, twist, moved), np.empty(len(self._depth_free))
            damping_of, out = self._numbers(damping), depth.numpy()
            self._over_frames(
                lambda begin, end: kernels.back_substitute(
                    self._graph,
                    system.pose,
                    system.prior,
                    self._kernel,
                    system.scale,
                    twist,
                    damping_of,
                    begin,
                    end,
                    shift,
                    out,
                    gain,
                )
            )
            predicted_drop += float(gain.sum())
        return Step(
            pose=torch.from_numpy(pose),
            log_focal=torch.from_numpy(moved[:, 0].copy()).reshape(state.intrinsics.shape[:-1]),
            alpha=torch.from_numpy(moved[:, 1].copy()).reshape(state.intrinsics.shape[:-1]),
            inverse_depth=depth,
            predicted_drop=torch.tensor(predicted_drop, dtype=torch.float64),
            factorised=torch.tensor(factorised),
            extrinsic=extrinsic,
        )

    def _prior_step(self, system: HostSystem, twist: Array, moved: Array) -> Array:
        """(N, 2) what scales and shifts of priors do to the right-hand sides of the depths."""
        if system.of_prior is None:
            return np.empty((0, 2), twist.dtype)
        first, found = self._graph.first, np.zeros((len(self._depth_free), 2), twist.dtype)
        for frame in np.flatnonzero(self._depth_free):
            edges = twist[first[frame] : first[frame + 1], :6]
            cameras = np.zeros((self._num_apart + 1, kernels.TAIL))
            cameras[:-1, :2] = -moved[: self._num_apart]
            cameras[0, 2] = 1
            found[frame] = system.of_prior[frame] @ np.concatenate((-edges.ravel(), cameras.ravel()))
        return found

    def retract(self, state: State, step: Step) -> State:
        """The state after a step. Whatever the step does not touch keeps its bits."""
        intrinsics = state.intrinsics.clone()
        intrinsics[..., :2] *= step.log_focal.exp()[..., None]
        if self._free[1]:
            intrinsics[..., 4] += step.alpha
        inverse_depth = (state.inverse_depth + step.inverse_depth).clamp_(*self._depth_range)
        inverse_depth[self._held] = state.inverse_depth[self._held]
        cam_from_world, cam_from_rig = moved_poses(self.problem, state, step)
        return State(cam_from_world, inverse_depth, intrinsics, cam_from_rig)

    def intrinsics_covariance(self, system: HostSystem, damping: float) -> Tensor:
        """See `Solver.intrinsics_covariance`."""
        scale, factor, factorised = self._factorise(system, damping)
        free = np.flatnonzero(self._free)
        covariances = np.zeros((self._num_apart, 2, 2))
        for camera in range(self._num_dense):
            at, covariance = len(scale) - self._num_dense + camera, covariances[camera]
            if not factorised or not (scale[at, free] > 0).all():
                covariance[np.ix_(free, free)] = np.nan
                continue
            for column in free:
                unit = np.zeros_like(scale)
                unit[at, column] = scale[at, column]
                block_cholesky.substitute(self._structure.first, self._structure.rows, factor, unit)
                covariance[free, column] = (scale[at] * unit[at])[free]
        return torch.from_numpy(covariances)

    def extrinsic_covariance(self, system: HostSystem, damping: float) -> Tensor:
        """See `Solver.extrinsic_covariance`."""
        return self._covariance_of(self._view_place, system, damping)

    def pose_covariance(self, system: HostSystem, damping: float, frame: int) -> Tensor:
        """See `Solver.pose_covariance`."""
        return self._covariance_of(self._pose_place[[frame]], system, damping)[0]

    def _covariance_of(self, places: Array, system: HostSystem, damping: float) -> Tensor:
        """(G, 6, 6) of the twists in G columns; 0 for -1, NaN where the system says nothing."""
        scale, factor, factorised = self._factorise(system, damping)
        covariance = np.zeros((len(places), 6, 6))
        for number in np.flatnonzero(places >= 0):
            place = places[number]
            if not factorised or not (scale[place] > 0).all():
                covariance[number] = np.nan
                continue
            for column in range(6):
                unit = np.zeros_like(scale)
                unit[place, column] = scale[place, column]
                block_cholesky.substitute(self._structure.first, self._structure.rows, factor, unit)
                covariance[number, :, column] = scale[place] * unit[place]
        return torch.from_numpy(covariance)


def _flat(measurements: Tensor, dtype: torch.dtype) -> Array:
    """(E, P, 2) -> (E, 2 P) without a copy where it has that layout and type."""
    return np.asarray(measurements.to(dtype).contiguous().flatten(1).numpy())
