"""The frontend of a refined map: a window of edges, updated and adjusted in turns as keyframes come in."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from vipe_core.geometry.arrays import interpolate_trajectory
from vipe_core.priors.protocols import Refiner, TrackedPoints
from vipe_core.slam.adjustment import Adjuster
from vipe_core.slam.keyframes import KeyframeMap
from vipe_core.slam.recurrent.depth_prior import DepthPrior
from vipe_core.slam.recurrent.edges import RefinedEdges
from vipe_core.slam.recurrent.linking import Reach, distances, links
from vipe_core.slam.recurrent.settings import RefinementSettings
from vipe_core.slam.reprojection import Reprojector
from vipe_core.slam.selection import Keyframe

# A new keyframe is expected half a step further on, and as far away on average as the last so many.
_VELOCITY_SHARE = 0.5
_DEPTH_MEMORY = 4


class RefinedTracker:
    """Grows a map by refining edges.

    Args:
        scale_px: Working pixels per pixel of an image that is 640 wide.
        prior: Of inverse depths; None where nothing is known of them.
        seen: Points that were followed to the frames of the video; see `RefinedEdges`.
    """

    def __init__(
        self,
        refiner: Refiner,
        keyframes: KeyframeMap,
        adjuster: Adjuster,
        reprojector: Reprojector,
        settings: RefinementSettings,
        scale_px: float,
        prior: DepthPrior | None = None,
        seen: Mapping[int, TrackedPoints] | None = None,
    ) -> None:
        self._keyframes = keyframes
        self._reprojector = reprojector
        self._settings = settings
        self._redundant_px = scale_px * settings.redundant_px
        self._reach = Reach(
            settings.neighbours, scale_px * settings.window_px, settings.window_gap, settings.window_edges
        )
        self._prior = prior
        self._edges = RefinedEdges(
            refiner,
            keyframes,
            adjuster,
            lean=settings.lean,
            prior=prior,
            prior_information=settings.metric_information,
            seen=seen,
        )

    def start(self, first: Sequence[Keyframe], times_s: Sequence[float]) -> None:
        """Fill the empty map with the first keyframes, which stand still; the scene is flat unless a prior knows it."""
        for keyframe, time_s in zip(first, times_s, strict=True):
            self._keyframes.append(keyframe, time_s, np.eye(4), np.ones(self._keyframes.grid.num_cells))
        if self._prior is not None:
            for k, depth in enumerate(self._prior.expected(range(len(first)))):
                self._keyframes.set_depth(k, depth)
            self._keyframes.normalise_scale()
        if len(first) < 2:
            return
        settings = self._settings
        everyone = range(len(first))
        near = settings.first_neighbours
        self._edges.add([(i, j) for i in everyone for j in everyone if 0 < abs(i - j) <= near])
        self._refine(settings.first_updates)
        self._link(everyone, everyone)
        self._refine(settings.first_updates)
        self._keyframes.normalise_scale()
        # The first half has seen enough.
        self._edges.retire(settings.oldest, len(first) // 2)

    def add(self, keyframe: Keyframe, time_s: float) -> None:
        """Append a keyframe and refine the window; the keyframe before it goes if it was one too many."""
        settings, keyframes = self._settings, self._keyframes
        before = keyframes.times_s[-2:]
        poses = np.stack([keyframes.pose(k) for k in range(len(keyframes) - len(before), len(keyframes))])
        step_s = before[-1] - before[0]
        expected = poses[-1]
        if len(before) > 1 and step_s > 0:
            at_s = before[-1] + _VELOCITY_SHARE * step_s
            expected = interpolate_trajectory(before, poses, [at_s], extrapolate=True)[0]
        last = range(max(0, len(keyframes) - _DEPTH_MEMORY), len(keyframes))
        mean = float(np.mean([keyframes.depth(k) for k in last]))
        keyframes.append(keyframe, time_s, expected, np.full(keyframes.grid.num_cells, mean))
        count = len(keyframes)
        if self._prior is not None:
            keyframes.set_depth(count - 1, self._prior.expected([count - 1])[0])
        self._edges.retire(settings.oldest)
        self._link(range(max(count - settings.recent, 0), count), range(max(count - settings.window, 0), count))
        # A map of any length is grown in the memory of its window: from here on, links start in the window, and what is
        # not refined takes part up to `reused` keyframes before the edges that are.
        oldest = min((min(edge) for edge in self._edges.active), default=count)
        self._edges.forget(min(oldest, count - settings.window) - settings.reused - settings.window_gap - 1)
        self._refine(settings.updates)
        if count > 3:
            apart = distances(self._reprojector, keyframes, [(count - 3, count - 2)], settings)[0]
            if apart < self._redundant_px:
                self._edges.remove_keyframe(count - 2)
                keyframes.remove(count - 2)
                return
        self._refine(settings.more_updates)

    def _link(self, sources: range, targets: range) -> None:
        known = [*self._edges.active, *self._edges.stored]
        found = links(self._reprojector, self._keyframes, sources, targets, known, self._reach, self._settings)
        self._edges.add(found, most=max(self._settings.window_edges, len(found)))

    def _refine(self, updates: int) -> None:
        for _ in range(updates):
            if not self._edges.active:
                return
            self._edges.update()
            first_free = max(1, min(i for i, _ in self._edges.active) + 1)
            self._edges.adjust(
                first_free, self._settings.iterations, stored_from=max(0, first_free - self._settings.reused)
            )
