"""From the keyframe map and the graph to one bundle adjustment, and back.

Robust annealing: a redescending kernel ignores whatever starts far away, so every adjustment runs a schedule of kernels
from wide to narrow.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from vipe_core.ba import pose_covariance, robust_scale_px, solve
from vipe_core.ba.problem import Free, Grid, Options, Priors, Problem, Result, Rig, RobustKernel, State, Status
from vipe_core.geometry.arrays import inverse
from vipe_core.slam.graph import Graph
from vipe_core.slam.keyframes import KeyframeMap
from vipe_core.slam.settings import SlamSettings
from vipe_core.slam.smoothness import smooth_inverse_depth
from vipe_core.transfer import downloaded, uploaded

logger = logging.getLogger(__name__)

Array = NDArray[Any]

_MIN_ROBUST_SCALE_PX = 1.0
# Matching is hardly ever better than a tenth of a pixel, and errors of that size are not Gaussian.
_LEAST_SCALE_PX = 0.5
PROBED_SHARE = 0.25
"""Share of the cells that `Adjuster.probe` takes."""

# A focal length that is probed is hardly held: a zoom lens changes its own tenfold.
_PROBED_FOCAL_SIGMA = 0.2

_FAILED = (Status.SINGULAR, Status.NON_FINITE)


@dataclass(frozen=True, slots=True)
class Step:
    """One kernel of an annealing schedule.

    Attributes:
        robust: Kernel of the residual norm.
        scale: Its scale as a multiple of `SlamSettings.robust_scale_px`.
        iterations: Bound on solver steps.
        tolerance: The solve goes on while a step lowers the cost by at least this share.
        measured_scale: `scale` is the most; where the residuals are smaller, it is what makes the kernel efficient for
            them. What moves a pixel or two a frame is an outlier then, and does not bend the map.
        initial_damping: Of the solver.
    """

    robust: RobustKernel
    scale: float
    iterations: int
    tolerance: float = 1e-2
    measured_scale: bool = False
    initial_damping: float = 1e-4


FROM_SCRATCH = (
    Step("huber", 1.0, 12),
    Step("geman_mcclure", 4.0, 8),
    Step("geman_mcclure", 1.0, 8, 1e-3, measured_scale=True),
)
"""The start may be anything: a convex kernel first."""

TRACK = (Step("geman_mcclure", 4.0, 4), Step("geman_mcclure", 1.0, 4, 1e-3))
"""One new pose that motion-only tracking has brought within a few pixels."""

REFINE = (Step("geman_mcclure", 4.0, 10), Step("geman_mcclure", 1.0, 15, 1e-3, measured_scale=True))
"""Everything is near its place."""

SETTLE = (Step("geman_mcclure", 1.0, 15, 1e-4, measured_scale=True),)
"""Everything is in its place but for the last digit."""


# The size of a rig, and its extrinsics, hang on little differences of much: what they still have to gain is a tiny
# share of the cost, and damping stops them.
_ARRIVE = Step("geman_mcclure", 1.0, 40, 1e-6, measured_scale=True, initial_damping=1e-7)


@dataclass(frozen=True, slots=True)
class FocalPrior:
    """What the initialisation knows of the focal length: log(fx) at the working size and its standard deviation.

    Attributes:
        rivals: Other values of log(fx) for which there is evidence.
        same_lens: The other intrinsics are known as well and held.
        held: The focal length is, too: the camera is given, and nothing of it is adjusted.
        of_views: In place of `log_focal` where every view of a rig has its own.
    """

    log_focal: float
    sigma: float
    rivals: tuple[float, ...] = ()
    same_lens: bool = False
    held: bool = False
    of_views: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class ExtrinsicPrior:
    """What is known of a rig before.

    Attributes:
        cam_from_rig: (V, 4, 4).
        place_sigma: (V,) standard deviation of each camera's place, in the same units.
        rotation_sigma: (V,) of its rotation, radians.
    """

    cam_from_rig: NDArray[np.float64]
    place_sigma: NDArray[np.float64]
    rotation_sigma: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class ProbedFocals:
    """Focal lengths that keyframes would have if each had its own.

    Attributes:
        logs: (K,) logarithms, beside the map's; (1,) of one for all.
        sigmas: Their formal 1-sigmas.
        cost: Mean squared robust residual, px^2.
    """

    logs: NDArray[np.float64]
    sigmas: NDArray[np.float64]
    cost: float


class Adjuster:
    """Runs adjustments on one device.

    Args:
        focal_prior: Holds log(fx) softly whenever the focal length is free.
        extrinsic_prior: Holds the extrinsics of a rig softly; None where they are not refined.

    Attributes:
        extrinsic_sigma: (V, 2) of the extrinsics as the last adjustment that freed them left them: of the place in the
            units that they were given in, of the rotation in radians, in their worst direction; before, the prior's.
        alive: Called before every solve, and between the measurements of a global adjustment: a sign of life for a
            supervisor. What it raises ends the adjustment.
    """

    def __init__(
        self,
        settings: SlamSettings,
        device: torch.device,
        focal_prior: FocalPrior,
        scale_px: float,
        extrinsic_prior: ExtrinsicPrior | None = None,
    ) -> None:
        self.extrinsic_prior = extrinsic_prior
        self.extrinsic_sigma: NDArray[np.float64] | None = None
        if extrinsic_prior is not None:
            self.extrinsic_sigma = np.stack((extrinsic_prior.place_sigma, extrinsic_prior.rotation_sigma), axis=1)
        self.settings = settings
        self.device = device
        self.focal_prior = focal_prior
        self.alive: Callable[[], None] = _nothing
        # Geometry shrinks with the image, the noise of matching does not.
        self.robust_scale_px = max(_MIN_ROBUST_SCALE_PX, settings.robust_scale_px * scale_px)
        # The cost is in px^2 of the working image: a smaller image has smaller residuals for the same geometry.
        self._depth_prior_weight = settings.depth_prior_weight * scale_px**2

    def adjust(
        self,
        keyframes: KeyframeMap,
        graph: Graph,
        frames: Sequence[int],
        fixed_poses: Sequence[int],
        schedule: Sequence[Step],
        *,
        edges: Sequence[tuple[int, int]] | None = None,
        free_focal: bool = False,
        free_depth: bool = True,
        free_extrinsics: bool = False,
        free_scale: bool = False,
    ) -> Result | None:
        """Adjust the keyframes `frames` with the edges among them; writes the result into `keyframes`.

        Args:
            frames: Of a rig, all views of an instant or none.
            fixed_poses: Keyframes of `frames` whose poses hold the gauge; of a rig, one per instant is enough.
            edges: Use these edges only.
            free_extrinsics: Of a rig, adjust its extrinsics too; `frames` are all keyframes then.
            free_scale: Of a rig, find the scale of the map anew: `frames` are all keyframes, and one pose is fixed.

        Returns:
            The last solve, or None when nothing could be solved and the map is as it was.
        """
        edges = graph.among(frames) if edges is None else list(edges)
        if not edges:
            return None
        problem, state = self._pose_problem(
            keyframes, graph, frames, fixed_poses, edges, free_focal=free_focal, free_depth=free_depth
        )
        if free_extrinsics:
            problem = self._with_free_extrinsics(problem, keyframes)
        result = self.anneal(problem, state, schedule)
        if result is None:
            return None
        if free_scale or free_extrinsics:
            result = self._arrive(keyframes, graph, frames, edges, problem, result)
        after = result.state
        new_poses, new_depths, intrinsics = downloaded(after.cam_from_world, after.inverse_depth, after.intrinsics)
        for row, k in enumerate(frames):
            keyframes.set_pose(k, new_poses[row])
            keyframes.set_depth(k, new_depths[row])
        keyframes.intrinsics = intrinsics.astype(np.float64)
        if free_extrinsics and result.state.cam_from_rig is not None:
            keyframes.cam_from_rig = result.state.cam_from_rig.cpu().numpy()
            self._take_extrinsics(keyframes, result)
        return result

    def _arrive(
        self,
        keyframes: KeyframeMap,
        graph: Graph,
        frames: Sequence[int],
        edges: Sequence[tuple[int, int]],
        problem: Problem,
        result: Result,
    ) -> Result:
        """Go on without the depth prior until scale and extrinsics stand, then settle with the prior where they are.

        The prior is around depths as they were. It is weak in every cell, but all cells together hold the scale of the
        map where it was, against the little that tells how large the rig is.
        """
        bare = replace(problem, priors=replace(problem.priors, inverse_depth=None, inverse_depth_weight=None))
        arrived = self.anneal(bare, result.state, (_ARRIVE,))
        if arrived is None:
            return result
        before, after = result.state.inverse_depth, arrived.state.inverse_depth
        # What is hardly measured goes astray meanwhile.
        state = replace(arrived.state, inverse_depth=before * (after / before).median())
        if problem.priors.inverse_depth is not None:
            number = {k: row for row, k in enumerate(frames)}
            depths = state.inverse_depth.cpu().numpy()
            prior, weight = self._depth_prior(keyframes, graph, frames, edges, number, depths)
            priors = replace(problem.priors, inverse_depth=prior, inverse_depth_weight=weight)
            problem = replace(problem, priors=priors)
        settled = self.anneal(problem, state, SETTLE) or arrived
        # How sure the extrinsics are is asked where nothing holds the scale.
        return replace(settled, extrinsic_covariances=arrived.extrinsic_covariances)

    def scale_sigma(self, keyframes: KeyframeMap, graph: Graph) -> float:
        """1-sigma of the logarithm of the scale that the size of a rig gives its map; infinite where it gives none.

        That of the distance between the first instant and the one farthest from it, with everything else free.
        """
        views = keyframes.num_views
        frames = range(len(keyframes))
        edges = graph.among(frames)
        if not keyframes.has_size or not edges:
            return math.inf
        poses = np.stack([keyframes.rig_pose(instant) for instant in range(len(keyframes) // views)])
        centres = inverse(poses)[:, :3, 3]
        far = int(np.argmax(np.linalg.norm(centres - centres[0], axis=1)))
        reach = centres[far] - centres[0]
        distance = float(np.linalg.norm(reach))
        if not distance > 0:
            return math.inf
        problem, state = self._pose_problem(keyframes, graph, frames, (0,), edges, free_focal=True, free_depth=True)
        problem = replace(problem, priors=replace(problem.priors, inverse_depth=None, inverse_depth_weight=None))
        if self.extrinsic_prior is not None:
            problem = self._with_free_extrinsics(problem, keyframes)
        scale_px = robust_scale_px(problem, state, _ARRIVE.robust, (_LEAST_SCALE_PX, self.robust_scale_px))
        options = Options(robust=_ARRIVE.robust, robust_scale_px=scale_px)
        covariance = pose_covariance(problem, state, far * views, options).numpy()
        towards = poses[far, :3, :3] @ (reach / distance)
        variance = float(towards @ covariance[:3, :3] @ towards)
        if not variance > 0:
            return math.inf
        return self.settings.focal_sigma_inflation * math.sqrt(variance) / distance

    def _take_extrinsics(self, keyframes: KeyframeMap, result: Result) -> None:
        """Note how sure the extrinsics are, and let the rig have the size in the map at which it is most like it was
        given.

        No measurement knows the scale of map and rig together. The adjustment brings it to the prior's in ever smaller
        steps; here it is solved for.
        """
        prior, covariances = self.extrinsic_prior, result.extrinsic_covariances
        assert keyframes.cam_from_rig is not None
        if prior is None or covariances is None or self.extrinsic_sigma is None:
            return
        weight = 1 / np.square(prior.place_sigma)[1:, None]
        centres = [inverse(mounts)[:, :3, 3] for mounts in (keyframes.cam_from_rig, prior.cam_from_rig)]
        found, given = (places[1:] - places[0] for places in centres)
        size = float((weight * found * found).sum())
        units = float((weight * found * given).sum()) / size if size > 0 else math.nan
        if math.isfinite(units) and units > 0:
            # The first camera stays where it is in the rig.
            first = prior.cam_from_rig[0].copy()
            first[:3, 3] /= units
            keyframes.cam_from_rig = keyframes.cam_from_rig @ (inverse(keyframes.cam_from_rig[0]) @ first)
            keyframes.rig_units = units
        blocks = covariances.numpy()
        for column, part in enumerate((slice(0, 3), slice(3, 6))):
            variance = np.nan_to_num(blocks[:, part, part], nan=math.inf)
            largest = [np.linalg.eigvalsh(block)[-1] if np.isfinite(block).all() else math.inf for block in variance]
            unit = keyframes.rig_units if column == 0 else 1.0
            sigma = unit * self.settings.focal_sigma_inflation * np.sqrt(np.maximum(largest, 0.0))
            most = (prior.place_sigma, prior.rotation_sigma)[column]
            self.extrinsic_sigma[:, column] = np.minimum(sigma, most)

    def _with_free_extrinsics(self, problem: Problem, keyframes: KeyframeMap) -> Problem:
        """Extrinsics are held softly where they were given, by sigmas of the same currency as the focal length's."""
        prior = self.extrinsic_prior
        if prior is None or keyframes.cam_from_rig is None:
            return problem
        given = prior.cam_from_rig.copy()
        given[:, :3, 3] /= keyframes.rig_units
        inflation = self.settings.focal_sigma_inflation
        sigmas = np.stack((prior.place_sigma / keyframes.rig_units, prior.rotation_sigma), axis=1) / inflation
        return replace(
            problem,
            free=replace(problem.free, extrinsics=True),
            priors=replace(
                problem.priors, cam_from_rig=torch.from_numpy(given), extrinsic_sigma=torch.from_numpy(sigmas)
            ),
        )

    def probe(
        self,
        keyframes: KeyframeMap,
        graph: Graph,
        frames: Sequence[int],
        fixed_poses: Sequence[int],
        schedule: Sequence[Step],
    ) -> Result | None:
        """What adjusting `frames` with a free focal length would come to, by a quarter of the cells; the map stays."""
        edges = graph.among(frames)
        if not edges:
            return None
        whole = self._pose_problem(keyframes, graph, frames, fixed_poses, edges, free_focal=True, free_depth=True)
        return self.anneal(*_thinned(*whole), schedule)

    def probe_focals(
        self,
        keyframes: KeyframeMap,
        graph: Graph,
        frames: Sequence[int],
        schedule: Sequence[Step],
        *,
        shared: bool = False,
    ) -> ProbedFocals | None:
        """What adjusting `frames` with a focal length for each of them would come to, by a quarter of the cells and by
        the measurements alone; the map stays.

        Args:
            shared: One focal length for all of them instead, for comparison.

        Returns:
            None where nothing could be solved.
        """
        edges = graph.among(frames)
        if not edges:
            return None
        problem, state = self._pose_problem(
            keyframes, graph, frames, frames[:1], edges, free_focal=False, free_depth=True
        )
        count, log_focal = len(frames), math.log(float(keyframes.intrinsics[0]))
        problem = replace(
            problem,
            free=replace(problem.free, focal=True),
            priors=Priors(log_focal=log_focal, log_focal_sigma=_PROBED_FOCAL_SIGMA),
        )
        if not shared:
            # Every keyframe is the only view of a rig of its own place.
            number = torch.arange(count, device=self.device)
            problem = replace(problem, rig=Rig(number, number))
            eye = torch.eye(4, dtype=torch.float64, device=self.device)
            state = replace(state, intrinsics=state.intrinsics.repeat(count, 1), cam_from_rig=eye.repeat(count, 1, 1))
        result = self.anneal(*_thinned(problem, state), schedule)
        if result is None or not result.weight_sum > 0:
            return None
        focals = np.atleast_2d(result.state.intrinsics.cpu().numpy())[:, 0]
        variances = np.array([covariance[0][0] for covariance in result.intrinsics_covariances])
        return ProbedFocals(np.log(focals) - log_focal, np.sqrt(variances), result.cost / result.weight_sum)

    def _pose_problem(
        self,
        keyframes: KeyframeMap,
        graph: Graph,
        frames: Sequence[int],
        fixed_poses: Sequence[int],
        edges: list[tuple[int, int]],
        *,
        free_focal: bool,
        free_depth: bool,
    ) -> tuple[Problem, State]:
        number = {k: row for row, k in enumerate(frames)}
        free_focal = free_focal and not self.focal_prior.held
        held = {keyframes.instant(k) for k in fixed_poses}
        poses = np.stack([keyframes.pose(k) for k in frames])
        depths = np.stack([keyframes.depth(k) for k in frames])
        measured = graph.read(edges, number, keyframes, self.device)
        prior = prior_weight = None
        if free_depth and self.settings.terms.depth_prior:
            prior, prior_weight = self._depth_prior(keyframes, graph, frames, edges, number, depths)
        problem = Problem(
            camera_model=keyframes.camera_model,
            grid=keyframes.grid,
            edges=measured,
            free=Free(
                poses=torch.tensor([keyframes.instant(k) not in held for k in frames]),
                inverse_depth=torch.full((len(frames),), free_depth, dtype=torch.bool),
                focal=free_focal,
                distortion=free_focal and not self.focal_prior.same_lens,
            ),
            priors=Priors(
                inverse_depth=prior,
                inverse_depth_weight=prior_weight,
                log_focal=self._log_focal(keyframes) if free_focal else None,
                # Formal sigmas of dense measurements are too small because their errors are correlated. Dividing the
                # prior's by the same factor weighs the two against each other as they really are.
                log_focal_sigma=self.focal_prior.sigma / self.settings.focal_sigma_inflation,
            ),
            rig=None if keyframes.cam_from_rig is None else rig_of(frames, keyframes.num_views, self.device),
        )
        return problem, self.state(poses, depths, keyframes.intrinsics, keyframes.cam_from_rig)

    def _log_focal(self, keyframes: KeyframeMap) -> float | tuple[float, ...]:
        if keyframes.intrinsics.ndim == 1 or not self.focal_prior.of_views:
            return self.focal_prior.log_focal
        return self.focal_prior.of_views

    def anneal(self, problem: Problem, state: State, schedule: Sequence[Step]) -> Result | None:
        """Solve with each kernel of the schedule in turn; None when the very first solve fails."""
        result: Result | None = None
        for step in schedule:
            self.alive()
            scale_px = step.scale * self.robust_scale_px
            at = state if result is None else result.state
            if step.measured_scale:
                least = min(_LEAST_SCALE_PX, scale_px)
                scale_px = robust_scale_px(problem, at, step.robust, (least, scale_px))
            options = Options(
                max_iterations=step.iterations,
                robust=step.robust,
                robust_scale_px=scale_px,
                relative_tolerance=step.tolerance,
                initial_damping=step.initial_damping,
            )
            solved = solve(problem, at, options)
            if solved.status is Status.EMPTY:
                return result
            if solved.status in _FAILED:
                logger.warning("bundle adjustment ended %s after %d steps", solved.status, solved.iterations)
                return result
            result = solved
        return result

    def state(self, poses: Array, depths: Array, intrinsics: Array, cam_from_rig: Array | None = None) -> State:
        """Poses (N, 4, 4), inverse depths (N, P), intrinsics and extrinsics on the device."""
        return State(
            cam_from_world=uploaded(np.ascontiguousarray(poses), self.device),
            inverse_depth=uploaded(np.ascontiguousarray(depths), self.device),
            intrinsics=uploaded(np.array(intrinsics, dtype=np.float64), self.device),
            cam_from_rig=None if cam_from_rig is None else uploaded(cam_from_rig.copy(), self.device),
        )

    def _depth_prior(
        self,
        keyframes: KeyframeMap,
        graph: Graph,
        frames: Sequence[int],
        edges: Sequence[tuple[int, int]],
        number: dict[int, int],
        depths: Array,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        confidence = np.zeros(depths.shape, dtype=np.float32)
        for i, j in edges:
            confidence[number[i]] += graph[i, j].weight.mean(axis=1) * keyframes.static(i)
        prior = np.stack(
            [smooth_inverse_depth(depths[row], confidence[row], keyframes.grid) for row in range(len(frames))]
        )
        median = max(float(np.median(depths)), 1e-6)
        information = np.full(depths.shape, self._depth_prior_weight / median**2, dtype=np.float32)
        return uploaded(prior, self.device), uploaded(information, self.device)


def _thinned(problem: Problem, state: State) -> tuple[Problem, State]:
    """The same with every other cell of every other row."""
    grid = problem.grid
    assert isinstance(grid, Grid)
    kept = torch.arange(grid.num_cells, device=state.inverse_depth.device).reshape(grid.height, grid.width)[::2, ::2]
    cells = kept.reshape(-1)
    edges, priors = problem.edges, problem.priors
    if priors.inverse_depth is not None and priors.inverse_depth_weight is not None:
        priors = replace(
            priors,
            inverse_depth=priors.inverse_depth[:, cells],
            inverse_depth_weight=priors.inverse_depth_weight[:, cells],
        )
    edges = replace(edges, target_px=edges.target_px[:, cells], weight=edges.weight[:, cells])
    coarse = Grid(kept.shape[0], kept.shape[1], 2 * grid.stride, grid.offset)
    thin = replace(problem, grid=coarse, edges=edges, priors=priors)
    return thin, replace(state, inverse_depth=state.inverse_depth[:, cells])


def rig_of(frames: Sequence[int], num_views: int, device: torch.device) -> Rig:
    """The rig behind keyframes of a map, in the order of a problem."""
    instants = np.unique(np.array(frames) // num_views, return_inverse=True)[1]
    views = np.array(frames) % num_views
    return Rig(uploaded(instants, device), uploaded(views, device))


def _nothing() -> None:
    pass
