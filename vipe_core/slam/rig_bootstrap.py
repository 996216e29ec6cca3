"""The first keyframes of a rig: the start of its best view, in the scale that the extrinsics give it.

A single view starts up to scale (`bootstrap.py`). The rig then turns and shifts the other views by lever arms of known
length, and views that overlap see the same points from known places: of all scales, the one at which the measurements
of all views agree best is taken, and the whole is adjusted.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vipe_core.geometry.arrays import inverse
from vipe_core.slam.adjustment import REFINE, Adjuster
from vipe_core.slam.bootstrap import Bootstrap
from vipe_core.slam.crossviews import CrossViews
from vipe_core.slam.graph import Graph
from vipe_core.slam.keyframes import KeyframeMap
from vipe_core.slam.masks import MotionMasks
from vipe_core.slam.measuring import MeasuredGraph
from vipe_core.slam.reprojection import Reprojector
from vipe_core.slam.selection import Keyframe

logger = logging.getLogger(__name__)

Array = NDArray[Any]

# Lever arms are between this share of the typical depth and this many times it; steps of the search, and of its end.
_ARM_RANGE = (0.001, 1.0)
_COARSE_STEP = 1.25
_FINE_STEP = 1.04
# Views whose starts are tried, the best first.
_MAX_BASES = 2
# At infinity, views that share less than this have nothing to match at one instant.
_MIN_SHARED = 0.2
_MIN_CONSISTENT = 0.3
_SUBSAMPLE = 3
_DEPTH_SPREAD = 20.0


@dataclass(frozen=True, slots=True)
class _ViewStart:
    """The start of one view by itself: its map, and the mean robust cost of its measurements, 0..1."""

    view: int
    keyframes: KeyframeMap
    cost: float


class RigBootstrap:
    """Builds the map of the first instants.

    Args:
        neighbours: Previous instants that each one is matched with.
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
        self._scale_px = 0.5 * masks.robust_scale_px

    def run(self, first: Sequence[Keyframe], times_s: Sequence[float]) -> None:
        """Fill the empty map with the instants `first`."""
        seeing = [view for view in range(self._keyframes.num_views) if view not in self._measured.blind]
        starts = [self._alone(view, first, times_s) for view in seeing]
        flat = np.ones(self._keyframes.grid.num_cells)
        for keyframe, time_s in zip(first, times_s, strict=True):
            instant = len(self._keyframes) // self._keyframes.num_views
            for features in keyframe.features:
                self._keyframes.append(Keyframe(keyframe.index, features), time_s, np.eye(4), flat)
            self._keyframes.set_rig_pose(instant, np.eye(4))
        self._take_cameras(starts)
        self._connect_at_infinity()
        free = self._adjuster.extrinsic_prior is not None
        # The scale that wrong extrinsics seem to tell is looked for again with the refined ones.
        for last in (False, True) if free else (True,):
            self._place_best(starts)
            self._take_depths()
            self._keyframes.normalise_scale()
            everything = range(len(self._keyframes))
            self._masks.update(everything)
            self._adjust(free_extrinsics=free)
            CrossViews(self._measured, self._reprojector).connect(everything)
            self._masks.update(everything)
            self._adjust(free_extrinsics=free)
            self._keyframes.normalise_scale()
            if not last:
                self._keyframes.rescale(self._keyframes.rig_units)

    def _adjust(self, *, free_extrinsics: bool) -> None:
        everything = range(len(self._keyframes))
        self._adjuster.adjust(
            self._keyframes,
            self._graph,
            everything,
            (0,),
            REFINE,
            free_extrinsics=free_extrinsics,
            free_scale=self._keyframes.has_size,
        )

    def _place_best(self, starts: Sequence[_ViewStart]) -> None:
        """Place all by the view and the scale that make the measurements of all views agree best."""
        best: tuple[float, _ViewStart, float] | None = None
        for start in sorted(starts, key=lambda one: one.cost)[:_MAX_BASES]:
            cost, unit = self._search(start)
            logger.debug("view %d: cost %.4f; the rig at %.4g to a unit: %.4f", start.view, start.cost, unit, cost)
            if best is None or cost < best[0]:
                best = cost, start, unit
        assert best is not None
        self._place(best[1], best[2])

    def _alone(self, view: int, first: Sequence[Keyframe], times_s: Sequence[float]) -> _ViewStart:
        """Start one view by itself, and file what it measured."""
        whole, views = self._keyframes, self._keyframes.num_views
        keyframes, graph = KeyframeMap(whole.grid, whole.camera_model, whole.intrinsics_of(view)), Graph()
        measured = self._measured.of(keyframes, graph)
        masks = MotionMasks(self._reprojector, keyframes, graph, self._masks.robust_scale_px)
        bootstrap = Bootstrap(measured, self._adjuster, self._reprojector, masks, self._neighbours)
        alone = [Keyframe(keyframe.index, keyframe.features[view]) for keyframe in first]
        bootstrap.run(alone, times_s)
        for i, j in graph:
            self._graph.add(i * views + view, j * views + view, graph[i, j])
        return _ViewStart(view, keyframes, _cost(masks, range(len(keyframes)), self._scale_px))

    def _take_cameras(self, starts: Sequence[_ViewStart]) -> None:
        """The cameras that the views started with: of several estimates of one focal length, that of the best start."""
        if self._keyframes.intrinsics.ndim == 1:
            self._keyframes.intrinsics = min(starts, key=lambda one: one.cost).keyframes.intrinsics.copy()
        else:
            for start in starts:
                self._keyframes.intrinsics[start.view] = start.keyframes.intrinsics

    def _connect_at_infinity(self) -> None:
        """Match views of one instant that overlap for what is far away."""
        keyframes, views = self._keyframes, self._keyframes.num_views
        tiny = np.full(keyframes.grid.num_cells, 1e-6)
        for k in range(views):
            keyframes.set_depth(k, tiny)
        pairs = [(i, j) for i in range(views) for j in range(i + 1, views)]
        if not pairs:
            return
        there = self._reprojector.fan(keyframes, [i for i, _ in pairs], [j for _, j in pairs], _SUBSAMPLE)
        back = self._reprojector.fan(keyframes, [j for _, j in pairs], [i for i, _ in pairs], _SUBSAMPLE)
        shared = np.minimum(there.overlap, back.overlap)
        for start in range(0, len(keyframes), views):
            for k in range(start, start + views):
                keyframes.set_depth(k, tiny)
            for (i, j), overlap in zip(pairs, shared, strict=True):
                if overlap >= _MIN_SHARED:
                    self._measured.connect(start + i, start + j, guided=True, min_consistent=_MIN_CONSISTENT)

    def _search(self, start: _ViewStart) -> tuple[float, float]:
        """The length of a unit of a view's map, in that of the extrinsics, at which all measurements agree best.

        Returns:
            The mean robust cost there, 0..1, and the length; 1 without lever arms.
        """
        assert self._keyframes.cam_from_rig is not None
        centres = inverse(self._keyframes.cam_from_rig)[:, :3, 3]
        arm = float(np.linalg.norm(centres - centres[start.view], axis=1).max())
        depth = 1 / float(np.median(start.keyframes.depths()))
        if arm <= 0 or len(start.keyframes) < 1:
            return self._cost_at(start, 1.0), 1.0
        # At the largest unit the arm is the smallest share of the depth.
        smallest, largest = arm / (_ARM_RANGE[1] * depth), arm / (_ARM_RANGE[0] * depth)
        count = int(np.ceil(np.log(largest / smallest) / np.log(_COARSE_STEP)))
        best = min((self._cost_at(start, unit), unit) for unit in np.geomspace(smallest, largest, count).tolist())
        around = [best[1] * _FINE_STEP**step for step in (-4, -3, -2, -1, 1, 2, 3, 4)]
        return min([best, *((self._cost_at(start, unit), unit) for unit in around)])

    def _cost_at(self, start: _ViewStart, unit: float) -> float:
        self._place(start, unit)
        return _cost(self._masks, range(len(self._keyframes)), self._scale_px)

    def _place(self, start: _ViewStart, unit: float) -> None:
        """Poses as the start of one view has them, in the unit of the extrinsics."""
        assert self._keyframes.cam_from_rig is not None
        rig_from_cam = inverse(self._keyframes.cam_from_rig[start.view])
        first = np.eye(4)
        for instant in range(len(start.keyframes)):
            pose = start.keyframes.pose(instant).copy()
            pose[:3, 3] *= unit
            rig_from_world = rig_from_cam @ pose
            if instant == 0:
                # The world is the first pose of the rig.
                first = inverse(rig_from_world)
            self._keyframes.set_rig_pose(instant, rig_from_world @ first)
        flat = np.full(self._keyframes.grid.num_cells, np.median(start.keyframes.depths()) / unit)
        for k in range(len(self._keyframes)):
            self._keyframes.set_depth(k, flat)
        for instant in range(len(start.keyframes)):
            k = instant * self._keyframes.num_views + start.view
            self._keyframes.set_depth(k, start.keyframes.depth(instant) / unit)

    def _take_depths(self) -> None:
        """Give every keyframe the depths that its measurements agree on, their median elsewhere."""
        for k in range(len(self._keyframes)):
            found = self._masks.agreement(k, self._graph.targets(k))
            if found is None:
                continue
            good = 2 * found.support(self._masks.robust_scale_px) > found.votes
            if not good.any():
                continue
            median = float(np.median(found.inverse_depth[good]))
            good &= (found.inverse_depth > median / _DEPTH_SPREAD) & (found.inverse_depth < median * _DEPTH_SPREAD)
            self._keyframes.set_depth(k, np.where(good, found.inverse_depth, median))


def _cost(masks: MotionMasks, keyframes: Sequence[int], scale_px: float) -> float:
    """Mean robust cost of all measurements, 0..1, each cell at the depth that its views agree on."""
    good, measured = 0.0, 0
    for k in keyframes:
        found = masks.agreement(k, masks.targets(k))
        if found is not None:
            good += float((1 / (1 + np.square(found.error_px[found.measured] / scale_px))).sum())
            measured += int(found.measured.sum())
    return 1 - good / measured if measured else 1.0
