"""The normal equations of dense bundle adjustment, reduced to poses and intrinsics, in torch, on any device.

It solves on a GPU what the kernels there (`cuda/`) are not for, and where they cannot be had; and it is what these and
the compiled loops of a CPU (`host_solver.py`) are held to.

Problem. Minimise over poses G_i = cam_from_world, intrinsics k = (log f, alpha) and one inverse depth d per cell

    sum_e sum_p  wmax rho(s),   s = r^T W r / wmax,   r = project(R_e ray(p; k) + d(p) t_e; k) - target,   W = diag(w)

plus priors on d and log f. wmax is the larger of the two weights of a measurement, so that rho judges pixels and not
confidences, and a component without weight has no say. Where rho judges components, w_u rho(r_u^2) + w_v rho(r_v^2)
takes the place of wmax rho(s). (R_e, t_e) = T_e = G_j G_i^-1 for edge e = (i -> j).

Linearisation. One step of iteratively reweighted least squares: residual and Jacobian rows are scaled by
sqrt(w rho'(s)). Poses act on a pixel only through the left twist tau_e of T_e. With left perturbations of both poses

    exp(delta_j) G_j G_i^-1 exp(-delta_i) = exp(delta_j - Ad(T_e) delta_i) T_e      =>      tau_e = delta_j - Ad delta_i

so the per-pixel work sees 6 columns and not 12, and knows nothing of gauge or of what is fixed. With homogeneous
X = R ray + d t and J_X = d project / d X the columns are

    tau: [ d J_X ,  X x J_X ]        d: J_X t        k: J_X R d ray/dk + d project/dk

Rigs. What is said of the twists of frames is said of the poses and extrinsics behind them (`rigs.py`): the small matrix
of a source frame, see below, is taken to them before it is scattered. Where every view has intrinsics of its own, an
edge has 6 + n rows of its own, the target's intrinsics being among them, and k is the source's.

Elimination. A depth is touched only by the edges that leave its frame. Per cell of source frame i with D edges, let
e_m = J_tau^T J_d (6 rows of edge m), f = sum J_k^T J_d, v = -sum J_d r, C = sum J_d^2 + prior. Then everything that
frame i says about (tau_1..tau_D, k, right-hand side) is one small matrix,

    B_i = blockdiag(H_m) with intrinsics borders - X X^T,     column p of X = [e_1; ..; e_D; f; v] / sqrt(C)

a batched matrix product of 6 D + n + 1 rows with itself (a SYRK), and the reduced system is sum_i L_i^T B_i L_i with
L_i = [-Ad | 1], scattered to the columns of the free parameters; fixed ones fall into a dump column.

Damping. Levenberg-Marquardt scales C by (1 + lambda), hence X X^T by 1 / (1 + lambda): both sums are kept apart and a
rejected step costs one factorisation, not another linearisation. The reduced matrix is scaled to a unit diagonal
(Jacobi) and gets lambda on it. Back-substitution is dz = (v - e^T tau - f^T dk) / (C (1 + lambda)), again from X.

Precision. Per-pixel arrays are in the dtype of the inverse depths (float32, or float64 for tests); from B_i on it is
float64. Nothing here reads a value back to the host.

Arrays per chunk of F source frames with D edges (see `plan.py`): (F, D, rows, 2, P), the pixel components planar, so
that every operation runs along P.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import torch
from torch import Tensor

from vipe_core.ba import depth_prior, robust
from vipe_core.ba.depth_prior import DepthPrior
from vipe_core.ba.plan import Chunk, build_plan
from vipe_core.ba.problem import Options, Points, Problem, State
from vipe_core.ba.reprojection import cameras_of, median_inverse_depth, rays_of
from vipe_core.ba.rigs import extrinsic_prior, moved_poses, turns_of
from vipe_core.ba.rules import ALPHA_RANGE, MAX_LOG_FOCAL_STEP, MIN_CURVATURE
from vipe_core.ba.solver import Cost, Step
from vipe_core.cameras import projection
from vipe_core.geometry import se3

# What is kept between passes (sorted measurements, factors of the elimination) up to this size, else made again.
_CPU_KEEP_BYTES = 1 << 30
_GPU_KEEP_BYTES = 1 << 34


@dataclass(frozen=True, slots=True)
class _Measured:
    """Measurements of a chunk: target (F, D, 2, P), root of the weight (F, D, 2, P), larger weight (F, D, P)."""

    target_px: Tensor
    root_weight: Tensor
    max_weight: Tensor


@dataclass(frozen=True, slots=True)
class _View:
    """A chunk seen from a state.

    points (F, D, 3, P) homogeneous, rotation (F, D, 3, 3), translation (F, D, 3, 1), s (F, D, 1, P), norm (F, D, 1, P)
    or None, xy (F, D, 2, P) = points / s, valid (F, D, P), weighted (F, D, 2, P) = sqrt(w) r (zero where not valid),
    squared (F, D, 1, P) = s of the robust kernel, px^2, or (F, D, 2, P) componentwise.
    """

    points: Tensor
    rotation: Tensor
    translation: Tensor
    s: Tensor
    norm: Tensor | None
    xy: Tensor
    valid: Tensor
    weighted: Tensor
    squared: Tensor


@dataclass(frozen=True, slots=True)
class _Eliminated:
    """Factors of a chunk's elimination: x (F, 6 D + n + 1, P), with n D more after the first 6 D where every view has
    intrinsics of its own; root_q (F, P), adjoint (F, D, 6, 6); of a prior with a scale or a shift of its own, k more
    cells of x and of_prior (F, k, P), see `depth_prior.py`."""

    x: Tensor
    root_q: Tensor
    adjoint: Tensor
    of_prior: Tensor | None


@dataclass(frozen=True, slots=True)
class Linearisation:
    """The normal equations at a state; `TorchSolver.step` solves them for any damping.

    Attributes:
        direct: (n + 1, n + 1) float64 J^T J of poses and intrinsics, bordered by the negative gradient.
        eliminated: The same shape: what eliminating the undamped depths subtracts.
        state: Where.
        cost: By-product of the linearisation.
        factors: Iterates over the chunks with free depths.
    """

    direct: Tensor
    eliminated: Tensor
    state: State
    cost: Cost
    factors: Callable[[], Iterable[tuple[Chunk, _Eliminated]]]


class _Geometry:
    """What depends on poses and intrinsics only: transforms per edge, rays per table (`reprojection.Rays`) and cell."""

    def __init__(
        self, problem: Problem, options: Options, state: State, sample_px: Tensor, cameras: Tensor, camera_of: Tensor
    ) -> None:
        model, dtype = problem.camera_model, state.inverse_depth.dtype
        source_from_world = state.cam_from_world[problem.edges.source]
        transform = se3.relative(state.cam_from_world[problem.edges.target], source_from_world)
        self.adjoint = se3.adjoint(transform)
        self.turn = turns_of(problem, state)
        self.rotation = transform[:, :3, :3].to(dtype)
        self.translation = transform[:, :3, 3:].to(dtype)
        through = rays_of(model, sample_px, cameras, camera_of, options.min_depth_ratio)
        by_intrinsics = projection.unproject_jacobian(model, through.params, sample_px)
        # (T, 3, P), (T, n, 3, P), (T, P).
        self.rays = through.rays.mT.to(dtype).contiguous()
        self.rays_by_intrinsics = by_intrinsics.permute(0, 3, 2, 1).to(dtype).contiguous()
        self.min_s = through.min_s.to(dtype)
        self._table_of = through.of_frame
        # (C, 2, 1) and (C, 1, 1).
        self.focal = cameras[:, :2, None].to(dtype)
        self.centre = cameras[:, 2:4, None].to(dtype)
        self.alpha = cameras[:, 4:, None].to(dtype) if model == "mei" else None

    def tables(self, chunk: Chunk) -> Tensor | int:
        """Which tables of rays the sources (F,) of a chunk have; 0 where there is one only."""
        return 0 if len(self.rays) == 1 else self._table_of[chunk.frames]


class TorchSolver:
    """Cost, linearisation and step of one problem. Built once per solve; holds no state of the unknowns."""

    def __init__(self, problem: Problem, options: Options, state: State) -> None:
        self.problem, self.options = problem, options
        self.dtype, self.device = state.inverse_depth.dtype, state.inverse_depth.device
        cameras, self._camera_of = cameras_of(state.intrinsics, problem.rig, len(state.cam_from_world))
        self._num_cameras = len(cameras)
        self.plan = plan = build_plan(problem, self._camera_of, self._num_cameras, self.device)
        self.intrinsics_free = (0 in plan.free_intrinsics, 1 in plan.free_intrinsics)
        self.anything_free = plan.num_columns > 0 or plan.any_depth_free
        self._sample_px = problem.grid.sample_px(device=self.device)
        grid = problem.grid
        self._real = grid.real(self.device) if isinstance(grid, Points) else None
        median = median_inverse_depth(grid, state.inverse_depth)
        self._depth_range = (options.min_inverse_depth * median, options.max_inverse_depth * median)
        cells = len(problem.edges.source) * problem.grid.num_cells
        keep_bytes = _CPU_KEEP_BYTES if self.device.type == "cpu" else _GPU_KEEP_BYTES
        self._keep = cells * 12 * self.dtype.itemsize <= keep_bytes
        self._measured: dict[int, _Measured] = {}

    # -- measurement model ---------------------------------------------------------------------------------------

    def _measure(self, index: int, chunk: Chunk) -> _Measured:
        found = self._measured.get(index)
        if found is None:
            edges = self.problem.edges
            weight = edges.weight[chunk.edges].to(self.dtype) * chunk.real[..., None, None]
            target_px = torch.where(weight > 0, edges.target_px[chunk.edges].to(self.dtype), 0)
            root = weight.clamp_min(0).sqrt().mT.contiguous()
            found = _Measured(target_px.mT.contiguous(), root, weight.amax(-1).clamp_min(0))
            if self._keep:
                self._measured[index] = found
        return found

    def _geometry(self, state: State) -> _Geometry:
        cameras = state.intrinsics.reshape(self._num_cameras, -1)
        return _Geometry(self.problem, self.options, state, self._sample_px, cameras, self._camera_of)

    def _cameras(self, chunk: Chunk) -> tuple[Tensor | int, Tensor | int]:
        """Which cameras the sources (F,) and the targets (F, D) of a chunk have; 0 where there is one only."""
        if self._num_cameras == 1:
            return 0, 0
        return self._camera_of[chunk.frames], self._camera_of[chunk.targets]

    def _view(self, chunk: Chunk, measured: _Measured, state: State, geometry: _Geometry) -> _View:
        rotation, translation = geometry.rotation[chunk.edges], geometry.translation[chunk.edges]
        _, at_target = self._cameras(chunk)
        tables = geometry.tables(chunk)
        rays, least = geometry.rays[tables], geometry.min_s[tables]
        if rays.ndim == 3:
            rays, least = rays[:, None], least[:, None]
        points = rotation @ rays
        points.addcmul_(translation, state.inverse_depth[chunk.frames][:, None, None])
        s, norm = points[:, :, 2:], None
        valid = s[:, :, 0] > least
        if geometry.alpha is not None:
            alpha = geometry.alpha[at_target]
            norm = (points * points).sum(2, keepdim=True).sqrt()
            s = s + alpha * norm
            beyond = (alpha[..., 0] > 1) & (alpha[..., 0] * points[:, :, 2] <= -norm[:, :, 0])
            valid = (s[:, :, 0] > least) & ~beyond
            norm = torch.where(valid[:, :, None], norm, 1)
        s = torch.where(valid[:, :, None], s, 1)
        xy = points[:, :, :2] / s
        error = torch.addcmul(geometry.centre[at_target] - measured.target_px, xy, geometry.focal[at_target])
        weighted = error.mul_(measured.root_weight).mul_(valid[:, :, None])
        squared, tiny = weighted * weighted, torch.finfo(self.dtype).tiny
        if self.options.componentwise:
            squared = squared.div_(measured.root_weight.square().clamp_min(tiny))
        else:
            squared = squared.sum(2).div_(measured.max_weight.clamp_min(tiny))[:, :, None]
        return _View(points, rotation, translation, s, norm, xy, valid, weighted, squared)

    def cost(self, state: State, scale_px: float) -> Cost:
        """The robust cost at a state."""
        geometry = self._geometry(state)
        sums = torch.zeros(4, dtype=torch.float64, device=self.device)
        for index, chunk in enumerate(self.plan.chunks):
            measured = self._measure(index, chunk)
            view = self._view(chunk, measured, state, geometry)
            self._add_cost(sums, chunk, measured, view, state, scale_px)
        return self._cost(sums, state)

    def _add_cost(
        self, sums: Tensor, chunk: Chunk, measured: _Measured, view: _View, state: State, scale_px: float
    ) -> None:
        """Add robust cost, valid weight, all weight and depth prior of a chunk to `sums` (4,)."""
        componentwise = self.options.componentwise
        kept_weight = measured.max_weight * view.valid
        rho = robust.cost(self.options.robust, scale_px, view.squared, self.options.robust_scale_px)
        weight = measured.root_weight.square() * view.valid[:, :, None] if componentwise else kept_weight[:, :, None]
        sums[0] += (rho * weight).sum(-1).double().sum()
        sums[1] += kept_weight.sum(-1).double().sum()
        sums[2] += measured.max_weight.sum(-1).double().sum()
        prior = self._depth_prior(chunk, state)
        if chunk.depth_free and prior is not None:
            sums[3] += (prior.weight * prior.off * prior.off).sum(-1).double().sum() + prior.cost.sum()

    def _cost(self, sums: Tensor, state: State) -> Cost:
        priors, prior_cost = self.problem.priors, sums[3]
        if priors.log_focal is not None and self.intrinsics_free[0]:
            off = state.intrinsics[..., 0].log() - state.intrinsics.new_tensor(priors.log_focal)
            prior_cost = prior_cost + (off / priors.log_focal_sigma).square().sum()
        extrinsic = self._extrinsic_prior(state)
        if extrinsic is not None:
            prior_cost = prior_cost + extrinsic[0].square().sum()
        return Cost(sums[0], sums[1], sums[2] - sums[1], prior_cost)

    def _extrinsic_prior(self, state: State) -> tuple[Tensor, Tensor, Tensor] | None:
        return extrinsic_prior(self.problem.priors, state) if self.problem.free.extrinsics else None

    def _depth_prior(self, chunk: Chunk, state: State) -> DepthPrior | None:
        return depth_prior.depth_prior(self.problem.priors, state.inverse_depth, chunk.frames)

    # -- normal equations ----------------------------------------------------------------------------------------

    def _rows(
        self, chunk: Chunk, view: _View, measured: _Measured, state: State, geometry: _Geometry, scale_px: float
    ) -> tuple[Tensor, Tensor]:
        """Scaled Jacobian rows of tau and intrinsics, then the negative residual; and the scaled J_X.

        Returns:
            (F, D, 6 + n + 1, 2, P), with n more after the first 6, the target's, where every view has intrinsics of its
            own; and (F, D, 3, 2, P).
        """
        _, at_target = self._cameras(chunk)
        scale = measured.root_weight * view.valid[:, :, None]
        residual = view.weighted
        slope = robust.root_slope(self.options.robust, scale_px, view.squared, self.options.robust_scale_px)
        if slope is not None:
            scale = scale * slope
            residual = residual * slope
        # J_X = scale f / s (1 - xy slope^T), slope = e_z + alpha X / |X|.
        diagonal = scale * geometry.focal[at_target] / view.s
        outer = -diagonal * view.xy
        frames, degree, _, cells = view.points.shape
        by_point = torch.empty(frames, degree, 3, 2, cells, dtype=self.dtype, device=self.device)
        if geometry.alpha is not None and view.norm is not None:
            bend = geometry.alpha[at_target] * view.points / view.norm
            torch.mul(bend[:, :, :, None], outer[:, :, None], out=by_point)
            by_point[:, :, 2] += outer
            by_point[:, :, 0, 0] += diagonal[:, :, 0]
            by_point[:, :, 1, 1] += diagonal[:, :, 1]
        else:
            by_point[:, :, 0, 0] = diagonal[:, :, 0]
            by_point[:, :, 0, 1] = 0
            by_point[:, :, 1, 0] = 0
            by_point[:, :, 1, 1] = diagonal[:, :, 1]
            by_point[:, :, 2] = outer

        each, apart = len(self.plan.free_intrinsics), self._num_cameras > 1
        num_rows = 7 + each + each * apart
        rows = torch.empty(frames, degree, num_rows, 2, cells, dtype=self.dtype, device=self.device)
        torch.mul(by_point, state.inverse_depth[chunk.frames][:, None, None, None], out=rows[:, :, :3])
        for k in range(3):
            a, b = (k + 1) % 3, (k + 2) % 3
            row = rows[:, :, 3 + k]
            torch.mul(by_point[:, :, b], view.points[:, :, a, None], out=row)
            row.addcmul_(by_point[:, :, a], view.points[:, :, b, None], value=-1)
        for index, intrinsic in enumerate(self.plan.free_intrinsics):
            by_intrinsic = geometry.rays_by_intrinsics[geometry.tables(chunk), intrinsic]
            ray = view.rotation @ (by_intrinsic[:, None] if by_intrinsic.ndim == 3 else by_intrinsic)
            # Both camera derivatives are multiples of xy f: s outer = -scale f xy.
            share = view.s if intrinsic == 0 or view.norm is None else -view.norm
            if apart:
                torch.mul(outer, -share, out=rows[:, :, 6 + index])
            row = rows[:, :, 6 + each * apart + index]
            torch.sum(by_point * ray[:, :, :, None], dim=2, out=row)
            if not apart:
                row.addcmul_(outer, share, value=-1)
        torch.neg(residual, out=rows[:, :, -1])
        return rows, by_point

    def _eliminate(
        self, chunk: Chunk, rows: Tensor, by_point: Tensor, geometry: _Geometry, state: State
    ) -> _Eliminated:
        frames, degree, num_rows, _, cells = rows.shape
        translation = geometry.translation[chunk.edges]
        by_depth = (translation.mT @ by_point.flatten(3)).view(frames, degree, 2, cells)
        tail = 1 + len(self.plan.free_intrinsics)
        own = num_rows - tail
        x = torch.empty(frames, own * degree + tail, cells, dtype=self.dtype, device=self.device)
        first, second = by_depth[:, :, None, 0], by_depth[:, :, None, 1]
        for start, stop in ((0, 6), (6, own)):
            part = x[:, start * degree : stop * degree].view(frames, degree, stop - start, cells)
            torch.mul(rows[:, :, start:stop, 0], first, out=part)
            part.addcmul_(rows[:, :, start:stop, 1], second)
        shared = rows[:, :, own:, 0] * first
        shared.addcmul_(rows[:, :, own:, 1], second)
        torch.sum(shared, dim=1, out=x[:, own * degree :])
        curvature = (by_depth * by_depth).sum(dim=(1, 2))
        prior = self._depth_prior(chunk, state)
        if prior is not None:
            curvature += prior.weight
            x[:, -1].addcmul_(prior.weight, prior.off)
        seen = curvature > torch.finfo(self.dtype).tiny
        root_q = torch.where(seen, curvature, 1).rsqrt().mul_(seen)
        x.mul_(root_q[:, None])
        x, of_prior = depth_prior.eliminate(prior, x, root_q)
        return _Eliminated(x, root_q, geometry.adjoint[chunk.edges], of_prior)

    def linearise(self, state: State, scale_px: float) -> Linearisation:
        """The normal equations at a state."""
        geometry = self._geometry(state)
        size = self.plan.num_columns + 2
        direct = torch.zeros(size, size, dtype=torch.float64, device=self.device)
        eliminated = torch.zeros_like(direct)
        kept: list[tuple[Chunk, _Eliminated]] = []

        sums = torch.zeros(4, dtype=torch.float64, device=self.device)

        def seen(index: int, chunk: Chunk) -> tuple[_Measured, _View]:
            measured = self._measure(index, chunk)
            return measured, self._view(chunk, measured, state, geometry)

        for index, chunk in enumerate(self.plan.chunks):
            measured, view = seen(index, chunk)
            self._add_cost(sums, chunk, measured, view, state, scale_px)
            rows, by_point = self._rows(chunk, view, measured, state, geometry, scale_px)
            flat = rows.flatten(3)
            adjoint, turn = geometry.adjoint[chunk.edges], None
            if geometry.turn is not None:
                turn = torch.cat((geometry.turn[chunk.frames][:, None], geometry.turn[chunk.targets]), dim=1)
            tail = 1 + len(self.plan.free_intrinsics)
            _scatter(direct, chunk, _border(flat @ flat.mT, tail), adjoint, turn)
            if chunk.depth_free:
                factor = self._eliminate(chunk, rows, by_point, geometry, state)
                _scatter(eliminated, chunk, (factor.x @ factor.x.mT).double(), adjoint, turn)
                if self._keep:
                    kept.append((chunk, factor))

        def factors() -> Iterable[tuple[Chunk, _Eliminated]]:
            if self._keep:
                yield from kept
                return
            for index, chunk in enumerate(self.plan.chunks):
                if chunk.depth_free:
                    measured, view = seen(index, chunk)
                    rows, by_point = self._rows(chunk, view, measured, state, geometry, scale_px)
                    yield chunk, self._eliminate(chunk, rows, by_point, geometry, state)

        priors = self.problem.priors
        if priors.log_focal is not None and self.intrinsics_free[0]:
            information = 1 / priors.log_focal_sigma**2
            pull = information * (state.intrinsics.new_tensor(priors.log_focal) - state.intrinsics[..., 0].log())
            columns = self.plan.intrinsic_columns[:, 0]
            direct[columns, columns] += information
            direct[columns, -2] += pull.reshape(-1)
            direct[-2, columns] += pull.reshape(-1)
        extrinsic = self._extrinsic_prior(state)
        if extrinsic is not None:
            _, hessian, gradient = extrinsic
            columns = self.plan.view_columns
            right = torch.full_like(columns, self.plan.num_columns)
            direct.index_put_((columns[:, :, None], columns[:, None, :]), hessian, accumulate=True)
            direct.index_put_((columns, right), gradient, accumulate=True)
            direct.index_put_((right, columns), gradient, accumulate=True)
        return Linearisation(direct[:-1, :-1], eliminated[:-1, :-1], state, self._cost(sums, state), factors)

    # -- solution ------------------------------------------------------------------------------------------------

    def _factorise(self, system: Linearisation, damping: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Scale (n,), lower Cholesky factor, right-hand side (n,) and success of the damped reduced system."""
        reduced = system.direct - system.eliminated / (1 + damping)
        matrix, gradient = reduced[:-1, :-1], reduced[:-1, -1]
        diagonal = matrix.diagonal()
        # A column without any curvature has no gradient either: scaled to a unit row, it does not move.
        known = diagonal > MIN_CURVATURE * system.direct[:-1, :-1].diagonal()
        scale = torch.where(known, diagonal, 1).rsqrt() * known
        scaled = matrix * scale[:, None] * scale
        scaled.diagonal().add_(damping + (~known).double())
        factor, info = torch.linalg.cholesky_ex(scaled)
        return scale, factor, gradient, info == 0

    def step(self, system: Linearisation, damping: float) -> Step:
        """Solve the damped system: reduced system first, then every inverse depth."""
        scale, factor, gradient, factorised = self._factorise(system, damping)
        solution = torch.cholesky_solve((gradient * scale)[:, None], factor)[:, 0] * scale
        solution = torch.where(factorised, solution, torch.nan)
        state, free = system.state, self.plan.free_intrinsics
        change = solution.new_zeros(self._num_cameras, 2)
        for index, intrinsic in enumerate(free):
            columns = self.plan.intrinsic_columns[:, index]
            if intrinsic == 0:
                change[:, 0] = solution[columns].clamp(-MAX_LOG_FOCAL_STEP, MAX_LOG_FOCAL_STEP)
            else:
                current = state.intrinsics[..., 4].reshape(-1)
                change[:, 1] = (current + solution[columns]).clamp(*ALPHA_RANGE) - current
            solution[columns] = change[:, intrinsic]
        padded = torch.cat((solution, solution.new_zeros(2)))
        pose, extrinsic = padded[self.plan.pose_columns], None
        total = pose
        if (turn := turns_of(self.problem, state)) is not None and self.problem.rig is not None:
            pose = (turn @ pose[..., None])[..., 0]
            extrinsic = padded[self.plan.view_columns]
            total = pose + extrinsic[self.problem.rig.view_of_frame]
        predicted_drop = system.direct[:-1, -1] @ solution

        depth = torch.zeros_like(state.inverse_depth)
        moved = -change[:, list(free)]
        one = solution.new_ones(1)
        for chunk, factors in system.factors():
            source = total[chunk.frames][:, None, :, None]
            twist = (factors.adjoint @ source)[..., 0] - total[chunk.targets]
            at_source, at_target = self._cameras(chunk)
            parts = [twist.flatten(1)]
            if self._num_cameras > 1:
                parts.append(moved[at_target].flatten(1))
            parts += [moved[at_source].expand(len(twist), -1), one.expand(len(twist), -1)]
            combination = torch.cat(parts, dim=1).to(self.dtype)
            scaled_step = (combination[:, None] @ factors.x)[:, 0].div_(1 + damping)
            predicted_drop = predicted_drop + (scaled_step * factors.x[:, -1]).sum(-1).double().sum()
            if factors.of_prior is not None:
                cells = depth.shape[1]
                more = scaled_step[:, None, cells:] @ factors.of_prior
                scaled_step = scaled_step[:, :cells] + more[:, 0]
            depth[chunk.frames] = scaled_step * factors.root_q
        shape = state.intrinsics.shape[:-1]
        log_focal, alpha = change[:, 0].reshape(shape), change[:, 1].reshape(shape)
        return Step(pose, log_focal, alpha, depth, predicted_drop, factorised, extrinsic)

    def retract(self, state: State, step: Step) -> State:
        """The state after a step. Whatever the step does not touch keeps its bits."""
        intrinsics = state.intrinsics.clone()
        intrinsics[..., :2] *= step.log_focal.exp()[..., None]
        if self.intrinsics_free[1]:
            intrinsics[..., 4] += step.alpha
        inverse_depth = state.inverse_depth.clone()
        for chunk in self.plan.chunks:
            if chunk.depth_free:
                before = state.inverse_depth[chunk.frames]
                moved = (before + step.inverse_depth[chunk.frames]).clamp(*self._depth_range)
                if self._real is not None:
                    moved = torch.where(self._real[chunk.frames], moved, before)
                inverse_depth[chunk.frames] = moved
        cam_from_world, cam_from_rig = moved_poses(self.problem, state, step)
        return State(cam_from_world, inverse_depth, intrinsics, cam_from_rig)

    def intrinsics_covariance(self, system: Linearisation, damping: float) -> Tensor:
        """See `Solver.intrinsics_covariance`."""
        scale, factor, _, factorised = self._factorise(system, damping)
        columns = self.plan.intrinsic_columns
        covariance = torch.zeros(len(columns), 2, 2, dtype=torch.float64, device=scale.device)
        at = torch.tensor(self.plan.free_intrinsics, device=scale.device)
        covariance[:, at[:, None], at] = _marginal(columns, scale, factor, factorised)
        return covariance

    def extrinsic_covariance(self, system: Linearisation, damping: float) -> Tensor:
        """See `Solver.extrinsic_covariance`."""
        return self._covariance_of(self.plan.view_columns, system, damping)

    def pose_covariance(self, system: Linearisation, damping: float, frame: int) -> Tensor:
        """See `Solver.pose_covariance`."""
        return self._covariance_of(self.plan.pose_columns[[frame]], system, damping)[0]

    def _covariance_of(self, columns: Tensor, system: Linearisation, damping: float) -> Tensor:
        """(G, 6, 6) of the twists in (G, 6) columns; 0 for what is held."""
        scale, factor, _, factorised = self._factorise(system, damping)
        covariance = torch.zeros(len(columns), 6, 6, dtype=torch.float64, device=scale.device)
        # What is held has the number of a column that is none.
        moves = (columns < len(scale)).all(-1)
        covariance[moves] = _marginal(columns[moves], scale, factor, factorised)
        return covariance


def _marginal(columns: Tensor, scale: Tensor, factor: Tensor, factorised: Tensor) -> Tensor:
    """(G, n, n) blocks of the inverse for groups (G, n) of columns; NaN where the system says nothing."""
    groups, each = columns.shape
    flat = columns.flatten()
    units = torch.zeros(len(scale), len(flat), dtype=scale.dtype, device=scale.device)
    units[flat, torch.arange(len(flat), device=flat.device)] = scale[flat]
    solved = scale[flat][:, None] * torch.cholesky_solve(units, factor)[flat]
    found = solved.reshape(groups, each, groups, each).diagonal(dim1=0, dim2=2).permute(2, 0, 1)
    return torch.where(factorised & (scale[columns] > 0).all(-1)[:, None, None], found, torch.nan)


def _border(per_edge: Tensor, tail: int) -> Tensor:
    """Products of the rows of each edge to one matrix per frame, with twists per edge and the tail shared.

    Args:
        per_edge: (F, D, w + tail, w + tail): w >= 6 rows that the edge has for itself, and those of the tail.

    Returns:
        (F, w D + tail, w D + tail) float64; the first 6 rows of each edge, then what else they have, then the tail.
    """
    frames, degree, width, _ = per_edge.shape
    per_edge = per_edge.double()
    own = width - tail
    apart = own * degree
    size = apart + tail
    matrix = torch.zeros(frames, size, size, dtype=torch.float64, device=per_edge.device)
    blocks = matrix[:, :apart, :apart].view(frames, degree, own, degree, own)
    blocks.diagonal(dim1=1, dim2=3).copy_(per_edge[:, :, :own, :own].permute(0, 2, 3, 1))
    matrix[:, :apart, apart:] = per_edge[:, :, :own, own:].flatten(1, 2)
    matrix[:, apart:, :apart] = matrix[:, :apart, apart:].mT
    matrix[:, apart:, apart:] = per_edge[:, :, own:, own:].sum(1)
    if own > 6:
        number = torch.arange(apart, device=per_edge.device).view(degree, own)
        rest = torch.arange(apart, size, device=per_edge.device)
        order = torch.cat((number[:, :6].flatten(), number[:, 6:].flatten(), rest))
        matrix = matrix[:, order][:, :, order]
    return matrix


def _scatter(total: Tensor, chunk: Chunk, matrix: Tensor, adjoint: Tensor, turn: Tensor | None) -> None:
    """total += L^T matrix L with L = [-Ad | 1], in the columns of the chunk.

    Args:
        turn: (F, 1 + D, 6, 6) maps from the twists of rig poses to those of the source and the targets, of a rig.
    """
    twists = 6 * chunk.degree
    to_source = matrix[:, :, :twists] @ -adjoint.flatten(1, 2)
    source = -adjoint.flatten(1, 2).mT @ to_source[:, :twists]
    local = torch.cat((torch.cat((source, to_source.mT), dim=2), torch.cat((to_source, matrix), dim=2)), dim=1)
    if turn is not None:
        local = _to_rig(local, turn, len(chunk.columns[0]))
    total.index_put_((chunk.columns[:, :, None], chunk.columns[:, None, :]), local, accumulate=True)


def _to_rig(local: Tensor, turn: Tensor, width: int) -> Tensor:
    """K^T local K with K from poses, and extrinsics where `width` has room for them, to the twists of frames."""
    frames, size, _ = local.shape
    twists = 6 * turn.shape[1]
    by_pose = local.new_zeros(frames, twists, twists)
    blocks = by_pose.view(frames, turn.shape[1], 6, turn.shape[1], 6)
    blocks.diagonal(dim1=1, dim2=3).copy_(turn.permute(0, 2, 3, 1))
    rest = torch.eye(size, dtype=local.dtype, device=local.device).expand(frames, -1, -1)
    parts = [torch.nn.functional.pad(by_pose, (0, 0, 0, size - twists))]
    # Extrinsics are twists of the frames themselves; without them, only what is behind the twists follows.
    parts.append(rest if width > size else rest[:, :, twists:])
    to_frames = torch.cat(parts, dim=2)
    return to_frames.mT @ local @ to_frames
