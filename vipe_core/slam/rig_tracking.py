"""The frontend of a rig: adds instants one by one inside a sliding window; `tracking.py` for a single camera."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vipe_core.geometry.arrays import interpolate_trajectory
from vipe_core.slam.adjustment import TRACK, Adjuster
from vipe_core.slam.bootstrap import POSE_ONLY
from vipe_core.slam.consensus import MAJORITY
from vipe_core.slam.crossviews import CrossViews
from vipe_core.slam.masks import MotionMasks
from vipe_core.slam.measuring import MeasuredGraph
from vipe_core.slam.reprojection import Reprojector, splat_inverse_depth
from vipe_core.slam.rig_consensus import Sighting, consensus_rig_pose
from vipe_core.slam.selection import Keyframe
from vipe_core.slam.settings import SlamSettings
from vipe_core.slam.tracking import MAX_VELOCITY_RATIO


class RigTracker:
    """Grows a map that `RigBootstrap` has started by one instant per call of `add`."""

    def __init__(
        self,
        measured: MeasuredGraph,
        adjuster: Adjuster,
        reprojector: Reprojector,
        masks: MotionMasks,
        settings: SlamSettings,
    ) -> None:
        self._measured = measured
        self._keyframes = measured.keyframes
        self._adjuster = adjuster
        self._reprojector = reprojector
        self._masks = masks
        self._settings = settings
        self._cross = CrossViews(measured, reprojector)

    def add(self, keyframe: Keyframe, time_s: float) -> None:
        """Append an instant, measure every view against its predecessors and adjust the window."""
        views = self._keyframes.num_views
        instant = len(self._keyframes) // views
        start = self._predict(time_s)
        for view, features in enumerate(keyframe.features):
            before = self._keyframes.depth((instant - 1) * views + view)
            self._keyframes.append(Keyframe(keyframe.index, features), time_s, np.eye(4), before)
        self._keyframes.set_rig_pose(instant, start)
        new = range(instant * views, (instant + 1) * views)
        reach = self._settings.neighbours
        for k in new:
            if k % views in self._measured.blind:
                continue
            # The step from the previous instant is within the matcher's own reach, and the prediction may be wrong.
            consistent = self._measured.connect(k - views, k, guided=False)
            reach = max(reach, self._measured.reach(consistent, self._settings.neighbours))
        if not self._pose_by_consensus(instant):
            self._pose_from_previous(instant)
        for k in new:
            self._keyframes.set_depth(k, splat_inverse_depth(self._reprojector, self._keyframes, k - views, k))
        for k in new:
            for before_k in range(k - min(reach, instant) * views, k - views, views):
                self._measured.connect(before_k, k, guided=True)
        oldest = max(0, instant - self._settings.window + 1)
        # What looks right from the step before may not from further away.
        self._pose_by_consensus(instant)
        self._cross.connect(new, oldest)
        first_masked = max(oldest, instant - self._settings.neighbours)
        self._masks.update(range(first_masked * views, (instant + 1) * views))
        held = (oldest, oldest + 1) if oldest > 0 else (0,)
        self._adjuster.adjust(
            self._keyframes,
            self._measured.graph,
            range(oldest * views, (instant + 1) * views),
            [k * views for k in held],
            TRACK,
        )

    def _predict(self, time_s: float) -> NDArray[np.float64]:
        """Constant velocity over time."""
        views = self._keyframes.num_views
        last = len(self._keyframes) // views - 1
        if last == 0:
            return self._keyframes.rig_pose(0)
        before_s, now_s = (self._keyframes.times_s[instant * views] for instant in (last - 1, last))
        reach_s = min(time_s, now_s + MAX_VELOCITY_RATIO * (now_s - before_s))
        poses = np.stack([self._keyframes.rig_pose(last - 1), self._keyframes.rig_pose(last)])
        predicted: NDArray[np.float64] = interpolate_trajectory([before_s, now_s], poses, [reach_s], extrapolate=True)[
            0
        ]
        return predicted

    def _pose_by_consensus(self, instant: int) -> bool:
        """Give an instant the pose that most of its views agree on; False where no majority agrees on one."""
        views, graph = self._keyframes.num_views, self._measured.graph
        sightings = [
            Sighting(i, k % views, graph[i, k], self._masks.reliable(i, k))
            for k in range(instant * views, (instant + 1) * views)
            for i in graph.targets(k)
            if self._keyframes.instant(i) < instant and (i, k) in graph
        ]
        found = consensus_rig_pose(self._reprojector, self._keyframes, sightings, self._masks.robust_scale_px)
        if found is None or found[1] < MAJORITY:
            return False
        self._keyframes.set_rig_pose(instant, found[0])
        return True

    def _pose_from_previous(self, instant: int) -> None:
        """Motion-only pose of the new instant against the depths of the one before, from two starts."""
        views = self._keyframes.num_views
        frames = range((instant - 1) * views, (instant + 1) * views)
        edges = [(k - views, k) for k in range(instant * views, (instant + 1) * views)]
        starts = (self._keyframes.rig_pose(instant), self._keyframes.rig_pose(instant - 1))
        best: tuple[float, NDArray[np.float64]] | None = None
        for start in starts:
            self._keyframes.set_rig_pose(instant, start)
            result = self._adjuster.adjust(
                self._keyframes, self._measured.graph, frames, frames[:1], POSE_ONLY, edges=edges, free_depth=False
            )
            if result is not None and (best is None or result.cost < best[0]):
                best = (result.cost, self._keyframes.rig_pose(instant))
        self._keyframes.set_rig_pose(instant, starts[0] if best is None else best[1])
