"""The map of one shot: bootstrap, tracking, global adjustment, and what to make of a camera that does not travel."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray

from vipe_core.cameras import CameraModel
from vipe_core.priors.protocols import PriorFamily, TrackedPoints
from vipe_core.slam.adjustment import Adjuster, FocalPrior
from vipe_core.slam.backend import Backend
from vipe_core.slam.bootstrap import Bootstrap
from vipe_core.slam.diagnostics import LoopReport, MapReport, examine, examine_loops
from vipe_core.slam.graph import Graph
from vipe_core.slam.keyframes import KeyframeMap
from vipe_core.slam.masks import MotionMasks
from vipe_core.slam.measuring import MeasuredGraph
from vipe_core.slam.recurrent.backend import RefinedBackend
from vipe_core.slam.recurrent.depth_prior import DepthPrior
from vipe_core.slam.recurrent.tracking import RefinedTracker
from vipe_core.slam.reprojection import Reprojector
from vipe_core.slam.rotation import Link, RotationFitter
from vipe_core.slam.segmentation import UNKNOWN
from vipe_core.slam.selection import Keyframe, Shot
from vipe_core.slam.settings import SlamSettings
from vipe_core.slam.timing import StageClock
from vipe_core.slam.tracking import Tracker
from vipe_core.slam.working import WorkingSize
from vipe_core.slam.zoom import NO_ZOOM, Zoom, find_zoom

logger = logging.getLogger(__name__)

Motion = Literal["general", "rotation", "static"]

# Below this parallax it is worth asking whether the camera only turned.
_MAYBE_ROTATION_DEG = 1.5
# Rotations alone explain a clip when their residual is within this of the full model's.
_ROTATION_RATIO = 1.3
_ROTATION_SLACK_PX = 0.05


@dataclass(frozen=True, slots=True)
class ShotMap:
    """The finished map of one shot, in a world of its own.

    Attributes:
        shot: Which frames it is of.
        motion: What kind of camera motion was found.
        focal_sigma_ratio: 1-sigma of the focal length as a share of it.
        found: Diagnostics.
        loops: What its loop edges did.
        adjuster: Ran its adjustments.
        fitter: Fits rotations, where there is nothing else to fit.
        usable: (K, P) bool, cells of each keyframe that are static and whose depth other views confirm.
        labels: (K, P) int8, what each cell of a keyframe does; see `segmentation.py`.
        zoom: Whether the focal length changes in it; not looked for in a rig, whose cameras are calibrated.
    """

    shot: Shot
    keyframes: KeyframeMap
    graph: Graph
    motion: Motion
    focal_sigma_ratio: float
    found: MapReport
    loops: LoopReport
    adjuster: Adjuster
    fitter: RotationFitter | None
    usable: NDArray[np.bool_]
    labels: NDArray[np.int8]
    zoom: Zoom = NO_ZOOM


@dataclass(frozen=True, slots=True)
class _Bare:
    """A map without a keyframe, and what it is built with."""

    keyframes: KeyframeMap
    graph: Graph
    adjuster: Adjuster
    masks: MotionMasks


class ShotMapper:
    """Maps shots of one video, one after the other.

    Args:
        seen: Points that were followed to the keyframes, by their index in the video, working pixels; None without.
    """

    def __init__(
        self,
        priors: PriorFamily,
        settings: SlamSettings,
        device: torch.device,
        size: WorkingSize,
        camera_model: CameraModel,
        timestamps_s: NDArray[np.float64],
        clock: StageClock,
        seen: Mapping[int, TrackedPoints] | None = None,
    ) -> None:
        self._priors = priors
        self._settings = settings
        self._device = device
        self._size = size
        self._times_s = timestamps_s
        self._clock = clock
        self._seen = seen
        self._model: CameraModel = camera_model
        self.reprojector = Reprojector(camera_model, size.grid)

    def run(
        self,
        shot: Shot,
        intrinsics: NDArray[np.float64],
        prior: FocalPrior,
        tracked: Callable[[int], None],
        adjusting: Callable[[], None],
    ) -> ShotMap:
        """Map a shot.

        Args:
            intrinsics: (K,) index parameters to start from.
            tracked: Told the frame up to which the shot is tracked.
            adjusting: Called again and again while the final global adjustment goes on.
        """
        settings, size, reprojector = self._settings, self._size, self.reprojector
        scale_px = settings.scaled_px(1.0, size.width)
        keyframes, graph = KeyframeMap(size.grid, self._model, intrinsics), Graph()
        adjuster = Adjuster(settings, self._device, prior, scale_px)
        masks = MotionMasks(
            reprojector, keyframes, graph, adjuster.robust_scale_px, enabled=settings.terms.motion_masks
        )
        static = shot.max_motion_px < settings.scaled_px(settings.static_motion_px, size.width)
        chosen = shot.keyframes[:1] if static else shot.keyframes
        times_s = [float(self._times_s[keyframe.index]) for keyframe in chosen]
        build = self._measured if self._priors.refiner is None else self._refined
        focal_sigma_ratio, loops = build(_Bare(keyframes, graph, adjuster, masks), chosen, times_s, tracked, adjusting)
        found = examine(reprojector, keyframes, graph, adjuster.robust_scale_px)
        motion: Motion = "static" if static else "general"
        fitter = None
        if not static and found.parallax_deg < _MAYBE_ROTATION_DEG:
            candidate = RotationFitter(self._model, size.grid, adjuster.robust_scale_px)
            with self._clock("rotation"):
                turned = self._rotation_only(candidate, keyframes, graph, prior, found)
            if turned is not None:
                motion, focal_sigma_ratio, fitter = "rotation", turned, candidate
                found = examine(reprojector, keyframes, graph, adjuster.robust_scale_px)
        usable = keyframes.statics()
        labels = np.full(usable.shape, UNKNOWN, dtype=np.int8)
        if motion == "general":
            usable = np.stack([masks.reliable(k) for k in range(len(keyframes))])
            labels = np.stack([masks.labels(k) for k in range(len(keyframes))])
        with self._clock("zoom"):
            zoom = find_zoom(keyframes, graph, adjuster, scale_px)
        return ShotMap(
            shot, keyframes, graph, motion, focal_sigma_ratio, found, loops, adjuster, fitter, usable, labels, zoom
        )

    def _measured(
        self,
        bare: _Bare,
        chosen: Sequence[Keyframe],
        times_s: Sequence[float],
        tracked: Callable[[int], None],
        adjusting: Callable[[], None],
    ) -> tuple[float, LoopReport]:
        """Build a map of pairs that are measured once each; the 1-sigma of its focal length, and what its loops did."""
        settings, reprojector = self._settings, self.reprojector
        keyframes, graph, adjuster, masks = bare.keyframes, bare.graph, bare.adjuster, bare.masks
        measured = MeasuredGraph(
            keyframes,
            graph,
            self._priors.matcher,
            self._priors.tracker if settings.terms.sparse_tracks else None,
            self._priors.points,
            reprojector,
            dense_flow=settings.terms.dense_flow,
            aligner=self._priors.aligner,
        )
        backend = Backend(measured, adjuster, reprojector, masks, settings, self._size.width)
        tracker = Tracker(measured, adjuster, reprojector, masks, settings, settings.scaled_px(1.0, self._size.width))
        with self._clock("track"):
            first = min(len(chosen), settings.min_keyframes)
            bootstrap = Bootstrap(measured, adjuster, reprojector, masks, settings.neighbours)
            bootstrap.run(chosen[:first], times_s[:first])
            for done in range(first, len(chosen) + 1):
                if done > first:
                    tracker.add(chosen[done - 1], times_s[done - 1])
                adjuster.alive = partial(tracked, chosen[done - 1].index + 1)
                if settings.backend_due(done) and done < len(chosen):
                    backend.run()
                adjuster.alive()
        before = keyframes.snapshot()
        with self._clock("backend"):
            adjuster.alive = adjusting
            adjusting()
            backend.run()
            loops = examine_loops(reprojector, keyframes, graph, before, settings.neighbours)
            backend.recentre()
            backend.sharpen()
            adjuster.alive = _nothing
        return backend.focal_sigma_ratio, loops

    def _refined(
        self,
        bare: _Bare,
        chosen: Sequence[Keyframe],
        times_s: Sequence[float],
        tracked: Callable[[int], None],
        adjusting: Callable[[], None],
    ) -> tuple[float, LoopReport]:
        """Build a map whose measurements are refined in turns with it; like `_measured` otherwise.

        Masks are not part of the refinement, whose weights know what moves; they are found from what it measured.
        """
        assert self._priors.refiner is not None
        settings, reprojector, refiner = self._settings, self.reprojector, self._priors.refiner
        keyframes, graph, adjuster = bare.keyframes, bare.graph, bare.adjuster
        schedule, scale_px = settings.refinement, settings.scaled_px(1.0, self._size.width)
        metric = self._priors.metric if settings.terms.depth_prior else None
        prior = None if metric is None else DepthPrior(metric, refiner, keyframes)
        tracker = RefinedTracker(refiner, keyframes, adjuster, reprojector, schedule, scale_px, prior, self._seen)
        backend = RefinedBackend(
            refiner, keyframes, graph, adjuster, reprojector, schedule, scale_px, prior, self._seen
        )
        on_the_way, again, finally_ = schedule.global_updates
        with self._clock("track"):
            first = min(len(chosen), settings.min_keyframes)
            tracker.start(chosen[:first], times_s[:first])
            counted = first
            for done in range(first, len(chosen) + 1):
                if done > first:
                    tracker.add(chosen[done - 1], times_s[done - 1])
                # A redundant keyframe takes its number back: the same count must not run twice.
                grown = done == first or len(keyframes) > counted
                counted = max(counted, len(keyframes))
                if grown and settings.backend_due(counted) and done < len(chosen):
                    backend.run(on_the_way)
                tracked(chosen[done - 1].index + 1)
        with self._clock("backend"):
            adjuster.alive = adjusting
            adjusting()
            backend.run(again)
            before = keyframes.snapshot()
            backend.run(finally_, settle=True)
            adjuster.alive = _nothing
            loops = examine_loops(reprojector, keyframes, graph, before, schedule.neighbours)
            bare.masks.update(range(len(keyframes)))
        return backend.focal_sigma_ratio, loops

    def _rotation_only(
        self, fitter: RotationFitter, keyframes: KeyframeMap, graph: Graph, prior: FocalPrior, found: MapReport
    ) -> float | None:
        """Replace the map by rotations when they explain the measurements as well as poses and depths do.

        Returns:
            The 1-sigma of the focal length as a share of it, or None where the map stays.
        """
        links = [Link(i, j, graph[i, j], np.ones(keyframes.grid.num_cells, dtype=np.bool_)) for i, j in graph]
        if not links:
            return None
        inflation = self._settings.focal_sigma_inflation
        start = fitter.chain(len(keyframes), links, keyframes.intrinsics)
        scaled = FocalPrior(prior.log_focal, prior.sigma / inflation)
        fit = fitter.fit(start, (0,), links, keyframes.intrinsics, None if prior.held else scaled)
        logger.debug("rotation only: %.3f px, with positions: %.3f px", fit.residual_px, found.residual_px)
        if not fit.residual_px <= _ROTATION_RATIO * found.residual_px + _ROTATION_SLACK_PX:
            return None
        keyframes.intrinsics = fit.intrinsics
        for k, rotation in enumerate(fit.rotations):
            pose = np.eye(4)
            pose[:3, :3] = rotation
            keyframes.set_pose(k, pose)
            keyframes.set_depth(k, np.ones(keyframes.grid.num_cells))
            keyframes.set_static(k, np.ones(keyframes.grid.num_cells, dtype=np.bool_))
        if prior.held:
            return prior.sigma
        return math.hypot(inflation * fit.log_focal_sigma, self._settings.lens_sigma)


def _nothing() -> None:
    pass
