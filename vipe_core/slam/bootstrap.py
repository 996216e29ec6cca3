"""The first keyframes: from measurements and a focal length to a map that tracking can extend.

A start is the two-view geometry of a pair with parallax, grown one keyframe at a time: its cells are triangulated, the
next keyframe takes the pose that explains the largest area of them, and what it measures refines the depths. Nothing
is adjusted before all keyframes stand, and area decides all the way (see `consensus.py`), so that a textured thing that
moves cannot bend the beginning. The start that explains most is then adjusted with what moves masked.

Where no pair has parallax, dense adjustment from a flat scene takes its place.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import poselib
from numpy.typing import NDArray

from vipe_core.cameras.ideal import ideal_camera, ideal_px
from vipe_core.slam.adjustment import FROM_SCRATCH, REFINE, TRACK, Adjuster, FocalPrior, Step
from vipe_core.slam.consensus import MIN_WEIGHT, consensus_pose
from vipe_core.slam.keyframes import Snapshot
from vipe_core.slam.masks import MotionMasks
from vipe_core.slam.measuring import MeasuredGraph
from vipe_core.slam.reprojection import Reprojector, splat_inverse_depth
from vipe_core.slam.selection import Keyframe

logger = logging.getLogger(__name__)

Array = NDArray[Any]

POSE_ONLY = (Step("huber", 1.0, 8), Step("geman_mcclure", 2.0, 8), Step("geman_mcclure", 1.0, 4, 1e-3))
"""A motion-only fit whose start may be off by a whole keyframe step."""

_MAX_SEEDS = 3
_MIN_POINTS = 50
_MAX_POINTS = 1500
_DEPTH_SPREAD = 20.0
# Growth goes by the distance at which the robust kernel leaves a measurement half of its weight.
_HALF_WEIGHT = math.sqrt(math.sqrt(2) - 1)
# A start that explains most of the picture needs no rival.
_CONVINCING = 0.5
# Where the focal length is hardly observable all starts cost the same, and the surest evidence decides.
_CLEARLY_CHEAPER = 0.98
# Masks that change by less than this share of a keyframe's cells have settled; they do in a few rounds.
_STABLE = 0.02
_MAX_ROUNDS = 3


@dataclass(frozen=True, slots=True)
class Seed:
    """Two keyframes to start from.

    Attributes:
        first: Becomes the origin.
        second: Its partner.
        second_from_first: (4, 4), unit translation.
        parallax_px: Median displacement of what the pair explains beyond that of its rotation.
        information: How well it determines the direction between the two, up to the noise of the matches: by the
            square root of the number of cells and by the parallax. A narrow pair explains more of the picture, and
            with it things that move.
    """

    first: int
    second: int
    second_from_first: NDArray[np.float64]
    parallax_px: float
    information: float


@dataclass(frozen=True, slots=True)
class _Start:
    """A finished start: the share of the measurements that it explains, and the map."""

    explained: float
    snapshot: Snapshot


class Bootstrap:
    """Builds the map of the first keyframes.

    Args:
        neighbours: Previous keyframes that each one is matched with.
    """

    def __init__(
        self,
        measured: MeasuredGraph,
        adjuster: Adjuster,
        reprojector: Reprojector,
        masks: MotionMasks,
        neighbours: int,
    ) -> None:
        self._measured = measured
        self._keyframes = measured.keyframes
        self._graph = measured.graph
        self._adjuster = adjuster
        self._reprojector = reprojector
        self._masks = masks
        self._neighbours = neighbours
        self._grow_px = _HALF_WEIGHT * masks.robust_scale_px

    def run(self, first: Sequence[Keyframe], times_s: Sequence[float]) -> None:
        """Fill the empty map with the keyframes `first`. One keyframe becomes the origin of a flat scene."""
        for keyframe, time_s in zip(first, times_s, strict=True):
            self._keyframes.append(keyframe, time_s, np.eye(4), np.ones(self._keyframes.grid.num_cells))
        for k in range(1, len(first)):
            consistent = self._measured.connect(k - 1, k, guided=False)
            for i in range(max(0, k - self._measured.reach(consistent, self._neighbours)), k - 1):
                self._measured.connect(i, k, guided=False)
        if len(first) > 1:
            if self._adjuster.focal_prior.rivals:
                self._start_from_each_focal()
            else:
                self._start()
            self._keyframes.normalise_scale()

    def _start_from_each_focal(self) -> None:
        """A start for every focal length that there is evidence for, adjusted with it free; the cheapest stays.

        The prior moves to the focal length that the cheapest came from, since the measurements refute the others.
        """
        keyframes = self._keyframes
        everything = range(len(keyframes))
        prior = self._adjuster.focal_prior
        blank = keyframes.snapshot()
        best: tuple[float, float, Snapshot, NDArray[np.bool_]] | None = None
        for log_focal in (prior.log_focal, *prior.rivals):
            keyframes.restore(blank)
            for k in everything:
                keyframes.set_static(k, np.ones(keyframes.grid.num_cells, dtype=np.bool_))
            scale = math.exp(log_focal - prior.log_focal)
            keyframes.intrinsics[:2] *= scale
            self._start()
            self._adjuster.adjust(keyframes, self._graph, everything, (0,), REFINE, free_focal=True)
            self._masks.update(everything)
            cost = self._cost()
            logger.debug("start at %.1f px: now %.1f, cost %.4f", math.exp(log_focal), keyframes.intrinsics[0], cost)
            if best is None or cost < _CLEARLY_CHEAPER * best[0]:
                best = cost, log_focal, keyframes.snapshot(), keyframes.statics()
        if best is not None:
            _, log_focal, snapshot, static = best
            self._adjuster.focal_prior = FocalPrior(log_focal, prior.sigma)
            keyframes.restore(snapshot)
            for k in everything:
                keyframes.set_static(k, static[k])

    def _cost(self) -> float:
        """Mean robust cost of all measurements, 0..1, whatever the masks say: starts differ in their masks."""
        good, measured = 0.0, 0
        everything = range(len(self._keyframes))
        for k in everything:
            found = self._masks.agreement(k, everything)
            if found is not None:
                good += float((1 / (1 + np.square(found.error_px[found.measured] / self._grow_px))).sum())
                measured += int(found.measured.sum())
        return 1 - good / measured if measured else 1.0

    def _start(self) -> None:
        """The start that explains the largest area, adjusted; or the flat one where that explains more."""
        blank = self._keyframes.snapshot()
        grown: list[_Start] = []
        for seed in self._seeds()[:_MAX_SEEDS]:
            self._keyframes.restore(blank)
            if self._grow(seed):
                grown.append(_Start(self._explained(), self._keyframes.snapshot()))
                logger.debug("start from %d-%d: explains %.4f", seed.first, seed.second, grown[-1].explained)
        best: _Start | None = None
        if grown:
            best = max(grown, key=lambda start: start.explained)
            self._keyframes.restore(best.snapshot)
            self._adjust_masked()
            best = _Start(self._explained(), self._keyframes.snapshot())
            logger.debug("adjusted: explains %.4f", best.explained)
        if best is None or best.explained < _CONVINCING:
            masks = self._keyframes.statics()
            self._keyframes.restore(blank)
            for k in range(len(self._keyframes)):
                self._keyframes.set_static(k, np.ones(self._keyframes.grid.num_cells, dtype=np.bool_))
            if self._grow_flat():
                flat = self._explained()
                logger.debug("flat start: explains %.4f", flat)
                if best is None or flat > best.explained:
                    return
            if best is not None:
                self._keyframes.restore(best.snapshot)
                for k in range(len(self._keyframes)):
                    self._keyframes.set_static(k, masks[k])

    def _seeds(self) -> list[Seed]:
        """The pairs with parallax, the most telling first, from essential matrices at the initial focal length."""
        seeds = [self._two_view(i, j) for i, j in self._graph if i < j]
        found = [seed for seed in seeds if seed is not None and seed.parallax_px > self._grow_px]
        return sorted(found, key=lambda seed: (-seed.information, seed.first, seed.second))

    def _two_view(self, i: int, j: int) -> Seed | None:
        match = self._graph[i, j]
        kept = np.flatnonzero(match.weight.max(axis=1) > MIN_WEIGHT)
        if len(kept) < _MIN_POINTS:
            return None
        kept = kept[np.linspace(0, len(kept) - 1, min(len(kept), _MAX_POINTS)).astype(np.int64)]
        camera = self._keyframes.camera
        source, imaged = ideal_px(camera, self._keyframes.grid.sample_px().numpy()[kept])
        target, seen = ideal_px(camera, match.target_px[kept])
        both = imaged & seen
        kept, source, target = kept[both], source[both], target[both]
        if len(kept) < _MIN_POINTS:
            return None
        error_px = 0.5 * self._grow_px
        ransac = {
            "max_iterations": 500,
            "min_iterations": 100,
            "max_epipolar_error": error_px,
            "seed": 0,
        }
        pose, report = poselib.estimate_relative_pose(
            source, target, ideal_camera(camera), ideal_camera(camera), ransac, {}
        )
        relative = np.eye(4)
        relative[:3, :3], relative[:3, 3] = pose.R, pose.t
        norm = float(np.linalg.norm(pose.t))
        inliers = np.asarray(report["inliers"], dtype=np.bool_)
        if not math.isfinite(norm) or norm < 1e-9 or not np.isfinite(relative).all() or not inliers.any():
            return None
        relative[:3, 3] /= norm
        turned = relative.copy()
        turned[:3, 3] = 0
        rotated = self._reprojector.induced(self._keyframes.intrinsics, turned, np.ones(len(kept)), kept).target_px
        parallax_px = float(np.nanmedian(np.linalg.norm(match.target_px[kept] - rotated, axis=1)[inliers]))
        return Seed(i, j, relative, parallax_px, parallax_px * math.sqrt(int(inliers.sum())))

    def _grow(self, seed: Seed) -> bool:
        """Place the seed, then every other keyframe by the pose that explains most; whether all could be placed."""
        keyframes = self._keyframes
        keyframes.set_pose(seed.second, seed.second_from_first)
        placed = [seed.first, seed.second]
        usable = {k: self._take_depth(k, placed) for k in placed}
        while len(placed) < len(keyframes):
            best: tuple[float, int, Array] | None = None
            for new in sorted(set(range(len(keyframes))) - set(placed)):
                near = [k for k in placed if (k, new) in self._graph]
                if not near:
                    continue
                views = [(k, self._graph[k, new]) for k in near]
                found = consensus_pose(self._reprojector, keyframes, views, [usable[k] for k in near], self._grow_px)
                if found is not None and (best is None or found[1] * len(near) > best[0]):
                    best = (found[1] * len(near), new, found[0])
            if best is None:
                return False
            keyframes.set_pose(best[1], best[2])
            placed.append(best[1])
            usable = {k: self._take_depth(k, placed) for k in placed}
        return True

    def _take_depth(self, k: int, placed: Sequence[int]) -> NDArray[np.bool_]:
        """Give keyframe `k` the depths that the placed ones agree on, the median elsewhere; which cells have one."""
        found = self._masks.agreement(k, placed)
        if found is None:
            return np.zeros(self._keyframes.grid.num_cells, dtype=np.bool_)
        good = 2 * found.support(self._grow_px) > found.votes
        median = float(np.median(found.inverse_depth[good])) if good.any() else 1.0
        good &= (found.inverse_depth > median / _DEPTH_SPREAD) & (found.inverse_depth < median * _DEPTH_SPREAD)
        self._keyframes.set_depth(k, np.where(good, found.inverse_depth, median))
        return np.asarray(good, dtype=np.bool_)

    def _explained(self) -> float:
        """Share of all measurements that the map explains: by area, and whatever the masks say."""
        explained = measured = 0
        everything = range(len(self._keyframes))
        for k in everything:
            found = self._masks.agreement(k, everything)
            if found is not None:
                explained += int((found.error_px < self._grow_px).sum())
                measured += int(found.measured.sum())
        return explained / measured if measured else 0.0

    def _adjust_masked(self) -> None:
        """Mask what moves, adjust, and once more with the masks of the better poses."""
        everything = range(len(self._keyframes))
        self._masks.update(everything)
        for _ in range(_MAX_ROUNDS):
            self._adjuster.adjust(self._keyframes, self._graph, everything, (0,), REFINE)
            if self._masks.update(everything) < _STABLE:
                return

    def _grow_flat(self) -> bool:
        """Adjust keyframe after keyframe, from a flat scene without motion; whether all could be placed."""
        keyframes = self._keyframes
        placed = [0, 1]
        self._adjuster.adjust(keyframes, self._graph, placed, (0,), FROM_SCRATCH)
        while len(placed) < len(keyframes):
            links = [(i, j) for i, j in self._graph if i in placed and j not in placed]
            if not links:
                return False
            near, new = min(links, key=lambda edge: (abs(edge[0] - edge[1]), edge))
            self.place(near, new, [i for i, j in links if j == new])
            placed = sorted([*placed, new])
            self._adjuster.adjust(keyframes, self._graph, placed, (0,), TRACK)
        return self._adjuster.adjust(keyframes, self._graph, placed, (0,), REFINE) is not None

    def place(self, near: int, new: int, neighbours: Sequence[int]) -> None:
        """Pose keyframe `new` against the depths of placed `neighbours`, and predict its depth from `near`."""
        self._keyframes.set_pose(new, self._keyframes.pose(near))
        edges = [(i, new) for i in sorted(neighbours)]
        frames = sorted({*neighbours, new})
        self._adjuster.adjust(
            self._keyframes, self._graph, frames, tuple(neighbours), POSE_ONLY, edges=edges, free_depth=False
        )
        self._keyframes.set_depth(new, splat_inverse_depth(self._reprojector, self._keyframes, near, new))
