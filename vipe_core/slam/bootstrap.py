"""The first keyframes: from measurements and a focal length to a map that tracking can extend.

Dense adjustment from a flat scene can end in the wrong one of two reliefs that look almost alike (the depth reversal
of a distant object). So several starts are tried on the same measurements, a flat one and the two-view geometry of the
pairs with most parallax, and the lowest robust cost wins.
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

from vipe_core.slam.adjustment import FROM_SCRATCH, REFINE, TRACK, Adjuster, Step
from vipe_core.slam.measuring import MeasuredGraph
from vipe_core.slam.reprojection import Reprojector, splat_inverse_depth
from vipe_core.slam.selection import Keyframe

logger = logging.getLogger(__name__)

Array = NDArray[Any]

POSE_ONLY = (Step("huber", 1.0, 8), Step("geman_mcclure", 2.0, 8), Step("geman_mcclure", 1.0, 4))
"""A motion-only fit whose start may be off by a whole keyframe step."""

_MAX_SEEDS = 3
_MIN_POINTS = 50
_MIN_WEIGHT = 0.1
_MAX_POINTS = 600
_DEPTH_SPREAD = 20.0
# Two starts that end this close have found the same minimum: no need to try more.
_SAME_COST = 0.01
# Share of the largest possible robust cost above which a start is not believed.
_SUSPECT_COST = 0.1


@dataclass(frozen=True, slots=True)
class Seed:
    """Two keyframes to start from.

    Attributes:
        first: Becomes the origin.
        second: Its partner.
        second_from_first: (4, 4), unit translation; None starts flat, without motion.
        parallax: How much better two-view geometry explains the pair than a homography, 0..1.
    """

    first: int
    second: int
    second_from_first: NDArray[np.float64] | None
    parallax: float


@dataclass(frozen=True, slots=True)
class _Start:
    """A finished start: its robust cost as a share of the largest possible, and the map."""

    cost: float
    snapshot: tuple[Array, Array, Array]


class Bootstrap:
    """Builds the map of the first keyframes."""

    def __init__(self, measured: MeasuredGraph, adjuster: Adjuster, reprojector: Reprojector, neighbours: int) -> None:
        self._measured = measured
        self._keyframes = measured.keyframes
        self._graph = measured.graph
        self._adjuster = adjuster
        self._reprojector = reprojector
        self._neighbours = neighbours

    def run(self, first: Sequence[Keyframe], times_s: Sequence[float]) -> None:
        """Fill the empty map with the keyframes `first`. One keyframe becomes the origin of a flat scene."""
        for keyframe, time_s in zip(first, times_s, strict=True):
            self._keyframes.append(keyframe, time_s, np.eye(4), np.ones(self._keyframes.grid.num_cells))
        for k in range(1, len(first)):
            for i in range(max(0, k - self._neighbours), k):
                self._measured.connect(i, k, guided=False)
        if len(first) > 1:
            self._start()
            self._keyframes.normalise_scale()

    def _start(self) -> None:
        """Try starts until two agree; when even the best one contradicts much of the picture, let the area decide."""
        blank = self._keyframes.snapshot()
        seeds = self._seeds()
        best = self._best_of(seeds[:_MAX_SEEDS], blank)
        if best.cost > _SUSPECT_COST and len(seeds) > 0:
            logger.debug("the best start costs %.3f: something large moves, or the geometry is hard", best.cost)
            self._graph.area_votes = True
            best = self._best_of(seeds, blank)
        self._keyframes.restore(best.snapshot)

    def _best_of(self, seeds: Sequence[Seed], blank: tuple[Array, Array, Array]) -> _Start:
        best: _Start | None = None
        for seed in [Seed(0, 1, None, 0.0), *seeds]:
            self._keyframes.restore(blank)
            cost = self._grow(seed)
            logger.debug("start from %d-%d (parallax %.2f): cost %.4f", seed.first, seed.second, seed.parallax, cost)
            same = best is not None and math.isfinite(cost) and abs(cost - best.cost) < _SAME_COST * cost
            if best is None or cost < best.cost:
                best = _Start(cost, self._keyframes.snapshot())
            if same and cost < _SUSPECT_COST:
                break
        assert best is not None
        return best

    def _seeds(self) -> list[Seed]:
        """The pairs with parallax, most first, from essential matrices at the initial focal length."""
        seeds = [self._two_view(i, j) for i, j in self._graph if i < j]
        found = [seed for seed in seeds if seed is not None and seed.parallax > 0]
        return sorted(found, key=lambda seed: (-seed.parallax, seed.first, seed.second))

    def _two_view(self, i: int, j: int) -> Seed | None:
        match = self._graph[i, j]
        kept = np.flatnonzero(match.weight.max(axis=1) > _MIN_WEIGHT)
        if len(kept) < _MIN_POINTS:
            return None
        kept = kept[np.linspace(0, len(kept) - 1, min(len(kept), _MAX_POINTS)).astype(np.int64)]
        source = self._keyframes.grid.sample_px().numpy()[kept]
        target = match.target_px[kept].astype(np.float64)
        fx, fy, cx, cy = (float(value) for value in self._keyframes.intrinsics)
        camera = {
            "model": "PINHOLE",
            "width": int(self._keyframes.grid.width * self._keyframes.grid.stride),
            "height": int(self._keyframes.grid.height * self._keyframes.grid.stride),
            "params": [fx, fy, cx, cy],
        }
        ransac = {"max_iterations": 300, "max_epipolar_error": 1.0, "max_reproj_error": 1.0, "seed": 0}
        pose, report = poselib.estimate_relative_pose(source, target, camera, camera, ransac, {})
        _, flat = poselib.estimate_homography(source, target, ransac, {})
        relative = np.eye(4)
        relative[:3, :3], relative[:3, 3] = pose.R, pose.t
        norm = float(np.linalg.norm(pose.t))
        if not math.isfinite(norm) or norm < 1e-9 or not np.isfinite(relative).all():
            return None
        relative[:3, 3] /= norm
        parallax = float(report["inlier_ratio"]) * (1.0 - float(flat["inlier_ratio"]))
        return Seed(i, j, relative, parallax)

    def _grow(self, seed: Seed) -> float:
        """Place the seed, then every other keyframe next to a placed one.

        Returns:
            The robust cost as a share of what it would be if nothing fitted: 0 is perfect, towards 1 is hopeless.
        """
        keyframes = self._keyframes
        placed = [seed.first, seed.second]
        if seed.second_from_first is not None:
            keyframes.set_pose(seed.second, seed.second_from_first)
            depth = self._triangulate(seed)
            scale = float(np.median(depth))
            keyframes.set_depth(seed.first, depth / scale)
            relative = seed.second_from_first.copy()
            relative[:3, 3] *= scale
            keyframes.set_pose(seed.second, relative)
            keyframes.set_depth(seed.second, splat_inverse_depth(self._reprojector, keyframes, seed.first, seed.second))
        schedule = FROM_SCRATCH if seed.second_from_first is None else REFINE
        self._adjuster.adjust(keyframes, self._graph, placed, (seed.first,), schedule)
        while len(placed) < len(keyframes):
            links = [(i, j) for i, j in self._graph if i in placed and j not in placed]
            if not links:
                return math.inf
            near, new = min(links, key=lambda edge: (abs(edge[0] - edge[1]), edge))
            self.place(near, new, [i for i, j in links if j == new])
            placed.append(new)
            placed.sort()
            self._adjuster.adjust(keyframes, self._graph, placed, (seed.first,), TRACK)
        result = self._adjuster.adjust(keyframes, self._graph, placed, (seed.first,), REFINE)
        if result is None or result.weight_sum <= 0:
            return math.inf
        return result.cost / (result.weight_sum * self._adjuster.robust_scale_px**2)

    def place(self, near: int, new: int, neighbours: Sequence[int]) -> None:
        """Pose keyframe `new` against the depths of placed `neighbours`, and predict its depth from `near`."""
        self._keyframes.set_pose(new, self._keyframes.pose(near))
        edges = [(i, new) for i in sorted(neighbours)]
        frames = sorted({*neighbours, new})
        self._adjuster.adjust(
            self._keyframes, self._graph, frames, tuple(neighbours), POSE_ONLY, edges=edges, free_depth=False
        )
        self._keyframes.set_depth(new, splat_inverse_depth(self._reprojector, self._keyframes, near, new))

    def _triangulate(self, seed: Seed) -> NDArray[np.float64]:
        """(P,) inverse depth of the first keyframe's cells, by least squares in the normalised second image.

        With a = R ray and b = t the point a + b d is seen at (u, v) where a_x + b_x d = u (a_z + b_z d), and so for v:
        two linear equations in d. Cells that come out behind a camera take the median.
        """
        assert seed.second_from_first is not None
        match = self._graph[seed.first, seed.second]
        fx, fy, cx, cy = self._keyframes.intrinsics
        focal, centre = np.array([fx, fy]), np.array([cx, cy])
        m = (self._keyframes.grid.sample_px().numpy() - centre) / focal
        rays = np.concatenate([m, np.ones((len(m), 1))], axis=1) @ seed.second_from_first[:3, :3].T
        t = seed.second_from_first[:3, 3]
        seen = (match.target_px.astype(np.float64) - centre) / focal
        offset = rays[:, :2] - seen * rays[:, 2:]
        slope = t[:2] - seen * t[2]
        depth = -(offset * slope).sum(axis=1) / np.maximum((slope * slope).sum(axis=1), 1e-12)
        good = (depth > 0) & (match.weight.max(axis=1) > _MIN_WEIGHT)
        if not good.any():
            return np.ones(len(depth))
        median = float(np.median(depth[good]))
        inside = good & (depth > median / _DEPTH_SPREAD) & (depth < median * _DEPTH_SPREAD)
        return np.where(inside, depth, median)
