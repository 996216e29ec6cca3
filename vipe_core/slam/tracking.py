"""The frontend: adds keyframes one by one inside a sliding window (paper section 3.1, step 3)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vipe_core.geometry.arrays import interpolate_trajectory
from vipe_core.slam.adjustment import TRACK, Adjuster
from vipe_core.slam.bootstrap import POSE_ONLY
from vipe_core.slam.consensus import MAJORITY, consensus_pose
from vipe_core.slam.masks import MotionMasks
from vipe_core.slam.measuring import MeasuredGraph
from vipe_core.slam.proximity import close_pairs
from vipe_core.slam.reprojection import Reprojector, splat_inverse_depth
from vipe_core.slam.selection import Keyframe
from vipe_core.slam.settings import SlamSettings

MAX_VELOCITY_RATIO = 1.5
"""A prediction goes on for at most this many times the last step."""

# Robust cost as a share of the largest possible below which a pose needs no second start.
_GOOD_FIT = 0.1


class Tracker:
    """Grows a map that `Bootstrap` has started by one keyframe per call of `add`."""

    def __init__(
        self,
        measured: MeasuredGraph,
        adjuster: Adjuster,
        reprojector: Reprojector,
        masks: MotionMasks,
        settings: SlamSettings,
        scale: float,
    ) -> None:
        self._measured = measured
        self._keyframes = measured.keyframes
        self._adjuster = adjuster
        self._reprojector = reprojector
        self._masks = masks
        self._settings = settings
        self._near_px = 2 * settings.keyframe_motion_px * scale

    def add(self, keyframe: Keyframe, time_s: float) -> None:
        """Append a keyframe, measure it against its predecessors and adjust the window."""
        k = len(self._keyframes)
        start = self._predict(time_s)
        self._keyframes.append(keyframe, time_s, start, self._keyframes.depth(k - 1))
        # The step to the previous keyframe is within the matcher's own reach, and the prediction may be wrong.
        consistent = self._measured.connect(k - 1, k, guided=False)
        if not self._pose_by_consensus(k):
            self._pose_from_previous(k)
        self._keyframes.set_depth(k, splat_inverse_depth(self._reprojector, self._keyframes, k - 1, k))
        reach = self._measured.reach(consistent, self._settings.neighbours)
        for i in range(max(0, k - reach), k - 1):
            self._measured.connect(i, k, guided=True)
        self._connect_returning(k, reach)
        # What looks right from the step before may not from further away.
        self._pose_by_consensus(k)
        oldest = max(0, k - self._settings.window + 1)
        self._masks.update(range(max(oldest, k - self._settings.neighbours), k + 1))
        fixed = (oldest, oldest + 1) if oldest > 0 else (0,)
        self._adjuster.adjust(self._keyframes, self._measured.graph, range(oldest, k + 1), fixed, TRACK)

    def _predict(self, time_s: float) -> NDArray[np.float64]:
        """Constant velocity over time."""
        last = len(self._keyframes) - 1
        if last == 0:
            return self._keyframes.pose(0)
        before_s, now_s = self._keyframes.times_s[last - 1 : last + 1]
        reach_s = min(time_s, now_s + MAX_VELOCITY_RATIO * (now_s - before_s))
        poses = np.stack([self._keyframes.pose(last - 1), self._keyframes.pose(last)])
        predicted: NDArray[np.float64] = interpolate_trajectory([before_s, now_s], poses, [reach_s], extrapolate=True)[
            0
        ]
        return predicted

    def _pose_by_consensus(self, k: int) -> bool:
        """Give keyframe `k` the pose that most of the picture agrees on; False where no majority agrees on one."""
        older = [i for i in self._measured.graph.targets(k) if i < k]
        found = consensus_pose(
            self._reprojector,
            self._keyframes,
            [(i, self._measured.graph[i, k]) for i in older],
            [self._masks.reliable(i, k) for i in older],
            self._masks.robust_scale_px,
        )
        if found is None or found[1] < MAJORITY:
            return False
        self._keyframes.set_pose(k, found[0])
        return True

    def _pose_from_previous(self, k: int) -> None:
        """Motion-only pose of the new keyframe against the depth of the one before.

        Starts at the predicted pose, and at the previous one too when the fit from there is poor.
        """
        starts = (self._keyframes.pose(k), self._keyframes.pose(k - 1))
        best: tuple[float, NDArray[np.float64]] | None = None
        for start in starts:
            self._keyframes.set_pose(k, start)
            result = self._adjuster.adjust(
                self._keyframes,
                self._measured.graph,
                (k - 1, k),
                (k - 1,),
                POSE_ONLY,
                edges=[(k - 1, k)],
                free_depth=False,
            )
            if result is None:
                continue
            if best is None or result.cost < best[0]:
                best = (result.cost, self._keyframes.pose(k))
            if result.cost < _GOOD_FIT * self._adjuster.robust_scale_px**2 * result.weight_sum:
                break
        self._keyframes.set_pose(k, starts[0] if best is None else best[1])

    def _connect_returning(self, k: int, reach: int) -> None:
        """One more edge to the window's nearest older view, when the camera has come back to it."""
        oldest = max(0, k - self._settings.window + 1)
        older = range(oldest, k - reach)
        pairs = close_pairs(
            self._reprojector, self._keyframes, [k], older, self._near_px, self._settings.proximity_overlap
        )
        for pair in pairs[:1]:
            self._measured.connect(pair.target, k, guided=True, min_consistent=self._settings.min_consistent)
