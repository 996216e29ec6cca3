"""Loop closure by appearance: a place seen again is recognised, measured, and pulled together whatever the drift.

Dense adjustment with a redescending kernel ignores a measurement that the map contradicts by many pixels, and drift
does just that. So a loop that the map contradicts is first closed on a pose graph, scale included; the adjustment then
starts within reach. A closure that the measurements do not bear out is taken back.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import poselib
from numpy.typing import NDArray

from vipe_core.cameras.ideal import ideal_camera, ideal_px
from vipe_core.geometry.arrays import relative
from vipe_core.geometry.sim3 import Sim3
from vipe_core.slam.adjustment import REFINE, Adjuster
from vipe_core.slam.measuring import MeasuredGraph
from vipe_core.slam.places import similarity
from vipe_core.slam.posegraph import SimLink, relax
from vipe_core.slam.reprojection import Reprojector

logger = logging.getLogger(__name__)

Array = NDArray[Any]

# Keyframes that so few links connect know each other's place already.
_NEAR_HOPS = 4
_CANDIDATES_PER_KEYFRAME = 0.25
_MIN_CANDIDATES = 4
_MAX_CLOSURES = 4
# Least forward-backward consistency of a loop edge: a false one has about 0.02.
_MIN_CONSISTENT = 0.12
_MIN_WEIGHT = 0.1
_MIN_CELLS = 60
# Share of a loop's measurements that one rigid motion of the old depths must explain, and how far the logarithms of
# the two depths of a point may typically differ.
_MIN_RIGID = 0.5
_MAX_LOG_SPREAD = 0.35
# Share of a loop's measurements that the map must explain: roughly, to need no closure; and exactly, to keep one.
_EXPLAINED = 0.6
_ROUGHLY = 4.0
# What a closure may do to the other measurements: multiply their mean robust cost and add the noise of matching,
# px^2. Drift is within what they leave open, a false loop bends them.
_MAX_COST_RATIO = 1.2
_NOISE_PX2 = 0.01
# A loop's place is certain beside the many links that its error is to be spread over.
_LOOP_WEIGHT = 10.0
# Link between successive keyframes that share no measurement.
_BROKEN_LINK = 1e-4
_RESECTION = {"max_iterations": 500, "min_iterations": 50, "max_reproj_error": 6.0, "seed": 0}


@dataclass(frozen=True, slots=True)
class _Loop:
    """A measured return: keyframe `new` sees what `old` has seen."""

    old: int
    new: int


class LoopCloser:
    """Finds and closes loops of the map that `MeasuredGraph` holds."""

    def __init__(self, measured: MeasuredGraph, adjuster: Adjuster, reprojector: Reprojector) -> None:
        self._measured = measured
        self._keyframes = measured.keyframes
        self._graph = measured.graph
        self._adjuster = adjuster
        self._reprojector = reprojector

    def run(self) -> int:
        """Look for loops, measure them and close those that the map contradicts.

        Returns:
            Number of closures that moved the map.
        """
        closed = tried = 0
        for old, new in self._candidates():
            if tried == _MAX_CLOSURES:
                break
            self._adjuster.alive()
            if self._hops(self._keyframes.instant(old), _NEAR_HOPS)[self._keyframes.instant(new)] <= _NEAR_HOPS:
                continue
            if self._measured.connect_by_points(old, new, _MIN_CONSISTENT) < _MIN_CONSISTENT:
                continue
            reach = _ROUGHLY * self._adjuster.robust_scale_px
            if min(self._explained([(old, new), (new, old)], reach)) >= _EXPLAINED:
                logger.debug("loop %d-%d fits the map", old, new)
                continue
            tried += 1
            if self._close(_Loop(old, new)):
                closed += 1
            else:
                self._graph.discard(old, new)
                self._graph.discard(new, old)
        return closed

    def _candidates(self) -> list[tuple[int, int]]:
        """Each keyframe's most similar far one before it, the most similar pairs first."""
        count = len(self._keyframes)
        alike = similarity(count, self._measured.overview)
        found = []
        instant = [self._keyframes.instant(k) for k in range(count)]
        for new in range(count):
            hops = self._hops(instant[new], _NEAR_HOPS)
            far = [old for old in range(new) if hops[instant[old]] > _NEAR_HOPS]
            if far:
                old = max(far, key=lambda k: (float(alike[new, k]), -k))
                found.append((-float(alike[new, old]), old, new))
        limit = max(_MIN_CANDIDATES, round(_CANDIDATES_PER_KEYFRAME * count))
        return [(old, new) for _, old, new in sorted(found)[:limit]]

    def _hops(self, start: int, limit: int) -> NDArray[np.int64]:
        """(K / V,) number of edges between two instants, `limit` + 1 where it is more than `limit`."""
        views = self._keyframes.num_views
        hops = np.full(len(self._keyframes) // views, limit + 1, dtype=np.int64)
        hops[start] = 0
        queue = deque([start])
        while queue:
            instant = queue.popleft()
            if hops[instant] == limit:
                continue
            for k in range(instant * views, (instant + 1) * views):
                for j in self._graph.targets(k):
                    there = j // views
                    if hops[there] > hops[instant] + 1 and self._holds(k, j):
                        hops[there] = hops[instant] + 1
                        queue.append(there)
        return hops

    def _holds(self, i: int, j: int) -> bool:
        return self._graph[i, j].consistent >= _MIN_CONSISTENT

    def _explained(self, edges: Sequence[tuple[int, int]], reach_px: float) -> list[float]:
        """Per edge, the share of its measurements' weight that the map explains to `reach_px`."""
        shares = []
        for i, j in edges:
            match = self._graph[i, j]
            weight = match.weight.mean(axis=1) * self._keyframes.static(i)
            induced = self._reprojector.edge(self._keyframes, i, j)
            error = np.linalg.norm(induced.target_px - match.target_px, axis=1)
            # Behind the camera the error is NaN, and no measurement is explained.
            shares.append(float(weight[error < reach_px].sum() / max(float(weight.sum()), 1e-9)))
        return shares

    def _cost(self, edges: Sequence[tuple[int, int]]) -> float:
        """Weighted mean Geman-McClure cost of measurements, px^2; what is behind a camera costs the most."""
        scale = self._adjuster.robust_scale_px**2
        cost = total = 0.0
        for i, j in edges:
            match = self._graph[i, j]
            weight = match.weight.mean(axis=1) * self._keyframes.static(i)
            induced = self._reprojector.edge(self._keyframes, i, j)
            squared = np.nan_to_num(np.square(induced.target_px - match.target_px).sum(axis=1), nan=np.inf)
            cost += float(np.dot(weight, scale - scale * scale / (scale + squared)))
            total += float(weight.sum())
        return cost / max(total, 1e-9)

    def _close(self, loop: _Loop) -> bool:
        """Close one loop; the map is as it was if that fails."""
        measured = self._similarity_of(loop)
        if measured is None:
            logger.debug("loop %d-%d: no rigid motion explains it", loop.old, loop.new)
            return False
        loop_edges = [(loop.old, loop.new), (loop.new, loop.old)]
        others = [edge for edge in self._graph if edge not in loop_edges]
        scale_px = self._adjuster.robust_scale_px
        before = self._cost(others)
        snapshot = self._keyframes.snapshot()
        self._apply(relax(self._nodes(), [*self._links(others), measured]))
        frames = range(len(self._keyframes))
        self._adjuster.adjust(self._keyframes, self._graph, frames, (0,), REFINE)
        after = self._cost(others)
        fit = min(self._explained(loop_edges, scale_px))
        kept = fit >= _EXPLAINED and after <= _MAX_COST_RATIO * before + _NOISE_PX2
        logger.info(
            "loop %d-%d %s: the map explains %.2f of it; the other measurements cost %.4f px^2, before %.4f",
            loop.old,
            loop.new,
            "closed" if kept else "refused",
            fit,
            after,
            before,
        )
        if not kept:
            self._keyframes.restore(snapshot)
        return kept

    def _similarity_of(self, loop: _Loop) -> SimLink | None:
        """The similarity between the two cameras, each with the scale of its own depths."""
        there = self._resect(loop.old, loop.new)
        if there is None:
            return None
        match = self._graph[loop.old, loop.new]
        pose, inlier = there
        induced = self._reprojector.induced(
            self._keyframes.intrinsics_at(loop.old),
            pose,
            self._keyframes.depth(loop.old),
            into=self._keyframes.intrinsics_at(loop.new),
        )
        cells = np.flatnonzero(inlier & (induced.inverse_depth > 0))
        grid = self._keyframes.grid
        at = np.rint((match.target_px[cells] - grid.offset) / grid.stride).astype(np.int64)
        at = np.clip(at, 0, (grid.width - 1, grid.height - 1))
        own = self._keyframes.depth(loop.new)[at[:, 1] * grid.width + at[:, 0]]
        ratio = np.log(induced.inverse_depth[cells] / np.maximum(own, 1e-9))
        log_scale = float(np.median(ratio))
        spread = float(np.median(np.abs(ratio - log_scale)))
        if spread > _MAX_LOG_SPREAD:
            logger.debug("loop %d-%d: depths differ by a factor of %.2f", loop.old, loop.new, np.exp(spread))
            return None
        scale = float(np.exp(log_scale))
        between = Sim3(scale, pose[:3, :3], scale * pose[:3, 3])
        return SimLink(
            self._keyframes.instant(loop.old),
            self._keyframes.instant(loop.new),
            self._mount(loop.new).inverse() @ between @ self._mount(loop.old),
            _LOOP_WEIGHT,
        )

    def _mount(self, k: int) -> Sim3:
        """Camera from rig of a keyframe."""
        keyframes = self._keyframes
        if keyframes.cam_from_rig is None:
            return Sim3(1.0, np.eye(3), np.zeros(3))
        mount = keyframes.cam_from_rig[k % keyframes.num_views]
        return Sim3(1.0, mount[:3, :3], mount[:3, 3])

    def _resect(self, i: int, j: int) -> tuple[NDArray[np.float64], NDArray[np.bool_]] | None:
        """(4, 4) camera j from camera i in the scale of i's depths, and (P,) the cells that agree."""
        match = self._graph[i, j]
        cells = np.flatnonzero((match.weight.max(axis=1) > _MIN_WEIGHT) & self._keyframes.static(i))
        if len(cells) < _MIN_CELLS:
            return None
        camera = self._keyframes.camera_of(j % self._keyframes.num_views)
        seen, ahead = ideal_px(camera, match.target_px[cells])
        cells, seen = cells[ahead], seen[ahead]
        if len(cells) < _MIN_CELLS:
            return None
        rays = self._reprojector.rays(self._keyframes.intrinsics_at(i))[cells]
        points = rays / np.maximum(self._keyframes.depth(i)[cells, None].astype(np.float64), 1e-6)
        found, report = poselib.estimate_absolute_pose(seen, points, ideal_camera(camera), dict(_RESECTION), {})
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = found.R, found.t
        if not np.isfinite(pose).all() or float(report["inlier_ratio"]) < _MIN_RIGID:
            return None
        inlier = np.zeros(self._keyframes.grid.num_cells, dtype=np.bool_)
        inlier[cells[np.asarray(report["inliers"], dtype=np.bool_)]] = True
        return pose, inlier

    def _poses(self) -> NDArray[np.float64]:
        """(K / V, 4, 4) of the instants."""
        keyframes = self._keyframes
        return np.stack([keyframes.rig_pose(instant) for instant in range(len(keyframes) // keyframes.num_views)])

    def _nodes(self) -> list[Sim3]:
        return [Sim3(1.0, pose[:3, :3], pose[:3, 3]) for pose in self._poses()]

    def _links(self, edges: Sequence[tuple[int, int]]) -> list[SimLink]:
        """What the map says between linked instants, as sure as the measurements that bear it out."""
        poses, instant = self._poses(), self._keyframes.instant
        share = dict(zip(edges, self._explained(edges, self._adjuster.robust_scale_px), strict=True))
        weight = {(k, k + 1): _BROKEN_LINK for k in range(len(poses) - 1)}
        for (i, j), explained in share.items():
            if self._holds(i, j) and instant(i) != instant(j):
                pair = (min(instant(i), instant(j)), max(instant(i), instant(j)))
                mass = float(self._graph[i, j].weight.mean()) * explained
                weight[pair] = weight.get(pair, 0.0) + mass
        links = []
        for (i, j), mass in sorted(weight.items()):
            j_from_i = relative(poses[j], poses[i])
            links.append(SimLink(i, j, Sim3(1.0, j_from_i[:3, :3], j_from_i[:3, 3]), mass))
        return links

    def _apply(self, nodes: Sequence[Sim3]) -> None:
        """Move the instants; a node's scale goes into its depths and position."""
        keyframes = self._keyframes
        for instant, node in enumerate(nodes):
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = node.rotation, node.translation / node.scale
            keyframes.set_rig_pose(instant, pose)
            for k in range(instant * keyframes.num_views, (instant + 1) * keyframes.num_views):
                keyframes.set_depth(k, node.scale * keyframes.depth(k))
