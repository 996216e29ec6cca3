"""The frontend: adds keyframes one by one inside a sliding window (paper section 3.1, step 3)."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vipe_core.geometry.arrays import interpolate_trajectory
from vipe_core.priors.protocols import DenseMatcher, SparseTracker
from vipe_core.slam.adjustment import FROM_SCRATCH, TRACK, Adjuster, Step
from vipe_core.slam.graph import Graph, fuse
from vipe_core.slam.keyframes import KeyframeMap
from vipe_core.slam.proximity import close_pairs
from vipe_core.slam.reprojection import Reprojector, splat_inverse_depth
from vipe_core.slam.selection import Keyframe
from vipe_core.slam.settings import SlamSettings

logger = logging.getLogger(__name__)

Array = NDArray[Any]

_POSE_ONLY = (Step("huber", 1.0, 8), Step("geman_mcclure", 2.0, 8), Step("geman_mcclure", 1.0, 4))
_MAX_VELOCITY_RATIO = 1.5


class MeasuredGraph:
    """Matches pairs of keyframes, dense and sparse, and files both directions in the graph."""

    def __init__(
        self,
        keyframes: KeyframeMap,
        graph: Graph,
        matcher: DenseMatcher,
        sparse: SparseTracker | None,
        reprojector: Reprojector,
    ) -> None:
        self.keyframes = keyframes
        self.graph = graph
        self._matcher = matcher
        self._sparse = sparse
        self._reprojector = reprojector

    def connect(self, i: int, j: int, *, guided: bool, min_consistent: float = 0.0) -> float:
        """Measure i -> j and j -> i.

        Args:
            guided: Start the search where the current poses and depths of the map put it.
            min_consistent: A match with less forward-backward consistency is not filed.

        Returns:
            The smaller consistency of the two directions.
        """
        source, target = self.keyframes.features[i], self.keyframes.features[j]
        guess_px = None
        if guided:
            guess_px = self._reprojector.edge(self.keyframes, i, j).target_px
        there, back = self._matcher.match(source, target, guess_px)
        consistent = min(there.consistent, back.consistent)
        if consistent < min_consistent:
            return consistent
        if self._sparse is not None:
            there = fuse(there, self._sparse.match(source, target, there))
            back = fuse(back, self._sparse.match(target, source, back))
        self.graph.add(i, j, there)
        self.graph.add(j, i, back)
        return consistent


class Tracker:
    """Grows the map by one keyframe per call of `add`."""

    def __init__(
        self, measured: MeasuredGraph, adjuster: Adjuster, reprojector: Reprojector, settings: SlamSettings, scale: float
    ) -> None:
        self._measured = measured
        self._keyframes = measured.keyframes
        self._adjuster = adjuster
        self._reprojector = reprojector
        self._settings = settings
        self._near_px = 2 * settings.keyframe_motion_px * scale

    def add(self, keyframe: Keyframe, time_s: float) -> None:
        """Append a keyframe, measure it against its predecessors and adjust the window."""
        k = len(self._keyframes)
        cells = self._keyframes.grid.num_cells
        if k == 0:
            self._keyframes.append(keyframe, time_s, np.eye(4), np.ones(cells))
            return
        start = self._predict(time_s)
        self._keyframes.append(keyframe, time_s, start, np.full(cells, np.median(self._keyframes.depth(k - 1))))
        # The step to the previous keyframe is within the matcher's own reach, and the prediction may be wrong.
        self._measured.connect(k - 1, k, guided=False)
        if k == 1:
            self._adjust(k, FROM_SCRATCH)
            self._keyframes.normalise_scale()
            return
        self._pose_from_previous(k)
        self._keyframes.set_depth(k, splat_inverse_depth(self._reprojector, self._keyframes, k - 1, k))
        for i in range(max(0, k - self._settings.neighbours), k - 1):
            self._measured.connect(i, k, guided=True)
        self._connect_returning(k)
        self._adjust(k, TRACK)
        if k < self._settings.min_keyframes:
            self._keyframes.normalise_scale()

    def _predict(self, time_s: float) -> NDArray[np.float64]:
        """Constant velocity over time."""
        last = len(self._keyframes) - 1
        if last == 0:
            return self._keyframes.pose(0)
        before_s, now_s = self._keyframes.times_s[last - 1 : last + 1]
        reach_s = min(time_s, now_s + _MAX_VELOCITY_RATIO * (now_s - before_s))
        poses = np.stack([self._keyframes.pose(last - 1), self._keyframes.pose(last)])
        return interpolate_trajectory([before_s, now_s], poses, [reach_s], extrapolate=True)[0]

    def _pose_from_previous(self, k: int) -> None:
        """Motion-only pose of the new keyframe against the depth of the one before, from the better of two starts."""
        starts = (self._keyframes.pose(k), self._keyframes.pose(k - 1))
        best: tuple[float, NDArray[np.float64]] | None = None
        for start in starts:
            self._keyframes.set_pose(k, start)
            result = self._adjuster.adjust(
                self._keyframes,
                self._measured.graph,
                (k - 1, k),
                (k - 1,),
                _POSE_ONLY,
                edges=[(k - 1, k)],
                free_depth=False,
            )
            if result is None:
                continue
            if best is None or result.cost < best[0]:
                best = (result.cost, self._keyframes.pose(k))
        self._keyframes.set_pose(k, starts[0] if best is None else best[1])

    def _connect_returning(self, k: int) -> None:
        """One more edge to the window's nearest older view, when the camera has come back to it."""
        oldest = max(0, k - self._settings.window + 1)
        older = range(oldest, k - self._settings.neighbours)
        pairs = close_pairs(
            self._reprojector, self._keyframes, [k], older, self._near_px, self._settings.proximity_overlap
        )
        for pair in pairs[:1]:
            self._measured.connect(pair.target, k, guided=True, min_consistent=self._settings.min_consistent)

    def _adjust(self, k: int, schedule: tuple[Step, ...]) -> None:
        oldest = max(0, k - self._settings.window + 1)
        frames = range(oldest, k + 1)
        fixed = (oldest, oldest + 1) if oldest > 0 else (0,)
        self._adjuster.adjust(self._keyframes, self._measured.graph, frames, fixed, schedule)
