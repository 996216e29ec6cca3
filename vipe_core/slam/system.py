"""The SLAM stage as a whole: from a frame source to a pose for every frame (paper section 3.1, steps 1 to 5)."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray

from vipe_core.ba.problem import Grid
from vipe_core.cameras import Camera
from vipe_core.errors import ConfigError
from vipe_core.geometry.arrays import inverse
from vipe_core.priors.protocols import IntrinsicsEstimate, PriorFamily
from vipe_core.slam.adjustment import Adjuster, FocalPrior
from vipe_core.slam.backend import Backend, FocalReport
from vipe_core.slam.bootstrap import Bootstrap
from vipe_core.slam.diagnostics import MapReport, examine
from vipe_core.slam.graph import Graph
from vipe_core.slam.infill import Infill
from vipe_core.slam.keyframes import KeyframeMap
from vipe_core.slam.measuring import MeasuredGraph
from vipe_core.slam.reprojection import Reprojector
from vipe_core.slam.rotation import Link, RotationFitter
from vipe_core.slam.selection import Report, Selection, select_keyframes
from vipe_core.slam.settings import SlamSettings
from vipe_core.slam.tracking import Tracker
from vipe_core.slam.working import WorkingSize, working_size
from vipe_core.video.source import FrameSource

logger = logging.getLogger(__name__)

Motion = Literal["general", "rotation", "static"]

# Below this parallax it is worth asking whether the camera only turned.
_MAYBE_ROTATION_DEG = 1.5
# Rotations alone explain a clip when their residual is within this of the full model's.
_ROTATION_RATIO = 1.3
_ROTATION_SLACK_PX = 0.05


@dataclass(frozen=True, slots=True)
class SlamResult:
    """What the SLAM stage hands on.

    Attributes:
        world_from_cam: (N, 4, 4) float64; the world is the first camera.
        frame_inlier_ratio: (N,) float32 share of each frame's measurements that its pose explains.
        timestamps_s: (N,) float64.
        keyframes: (K,) int64 frame indices.
        inverse_depth: (K, P) float32 of each keyframe's cells, along the rays of the camera model.
        static: (K, P) bool, False on cells that appear to move by themselves.
        working: Size of the images that the cells belong to.
        camera: At the working size.
        motion: What kind of camera motion was found.
        focal: What is known of the focal length.
        map: Diagnostics, with the confidence of every inverse depth.
        timings_s: Wall seconds per stage.
    """

    world_from_cam: NDArray[np.float64]
    frame_inlier_ratio: NDArray[np.float32]
    timestamps_s: NDArray[np.float64]
    keyframes: NDArray[np.int64]
    inverse_depth: NDArray[np.float32]
    static: NDArray[np.bool_]
    working: WorkingSize
    camera: Camera
    motion: Motion
    focal: FocalReport
    map: MapReport
    timings_s: dict[str, float]

    @property
    def grid(self) -> Grid:
        return self.working.grid


class Slam:
    """The stage with its components; reusable for any number of videos, one at a time.

    Raises:
        ConfigError: The settings turn off the only measurements that the priors give.
    """

    def __init__(self, priors: PriorFamily, settings: SlamSettings, device: torch.device) -> None:
        if not settings.terms.dense_flow and priors.tracker is None:
            raise ConfigError("the term dense_flow can only be off where the preset has sparse tracks")
        self._priors = priors
        self._settings = settings
        self._device = device

    def run(self, source: FrameSource, report: Report) -> SlamResult:
        """Pose every frame of the video.

        Args:
            report: Told the stage and how far it is; what it raises ends the run.

        Raises:
            InputError, DecodeError: From the source; EmptyMedia when it holds no frame.
        """
        timings: dict[str, float] = {}
        size = working_size(source.info.width, source.info.height, self._settings.working_area_px)
        with _timed(timings, "scan"):
            selection = select_keyframes(source, size, self._priors.matcher, self._settings, report)
        with _timed(timings, "intrinsics"):
            estimate = self._initial_camera(source, selection, size)
            report("intrinsics", 1, 1)
        reprojector = Reprojector("pinhole", size.grid)
        keyframes = KeyframeMap(size.grid, estimate.camera.index_params())
        graph = Graph()
        prior = FocalPrior(math.log(estimate.camera.focal_px), estimate.log_focal_sigma)
        adjuster = Adjuster(self._settings, self._device, prior, self._settings.scaled_px(1.0, size.width))
        terms = self._settings.terms
        measured = MeasuredGraph(
            keyframes,
            graph,
            self._priors.matcher,
            self._priors.tracker if terms.sparse_tracks else None,
            self._priors.points,
            reprojector,
            dense_flow=terms.dense_flow,
        )
        backend = Backend(measured, adjuster, reprojector, self._settings, size.width)
        static = selection.max_motion_px < self._settings.scaled_px(self._settings.static_motion_px, size.width)
        chosen = selection.keyframes[:1] if static else selection.keyframes
        tracker = Tracker(measured, adjuster, reprojector, self._settings, self._settings.scaled_px(1.0, size.width))
        with _timed(timings, "track"):
            times_s = [float(selection.timestamps_s[keyframe.index]) for keyframe in chosen]
            first = min(len(chosen), self._settings.min_keyframes)
            Bootstrap(measured, adjuster, reprojector, self._settings.neighbours).run(chosen[:first], times_s[:first])
            for done, keyframe in enumerate(chosen, start=1):
                if done > first:
                    tracker.add(keyframe, times_s[done - 1])
                if done < first:
                    continue
                if done in self._settings.backend_at and done < len(chosen):
                    backend.run()
                report("track", keyframe.index + 1, selection.num_frames)
        with _timed(timings, "backend"):
            backend.run()
            report("backend", 1, 1)
        found = examine(reprojector, keyframes, graph, adjuster.robust_scale_px)
        motion: Motion = "static" if static else "general"
        focal = backend.focal
        fitter = RotationFitter("pinhole", size.grid, adjuster.robust_scale_px)
        if not static and found.parallax_deg < _MAYBE_ROTATION_DEG:
            with _timed(timings, "rotation"):
                turned = self._rotation_only(fitter, keyframes, graph, adjuster.focal_prior, found)
            if turned is not None:
                motion, focal = "rotation", turned
                found = examine(reprojector, keyframes, graph, adjuster.robust_scale_px)
        with _timed(timings, "infill"):
            if static:
                cam_from_world = np.tile(np.eye(4), (selection.num_frames, 1, 1))
                frame_inliers = np.ones(selection.num_frames, dtype=np.float32)
                report("infill", selection.num_frames, selection.num_frames)
            else:
                infill = Infill(
                    keyframes,
                    graph,
                    self._priors.matcher,
                    adjuster,
                    reprojector,
                    self._settings.infill_batch,
                    fitter if motion == "rotation" else None,
                    tracks_only=None if terms.dense_flow else self._priors.tracker,
                )
                trajectory = infill.run(source, size, selection.timestamps_s, report)
                cam_from_world, frame_inliers = trajectory.cam_from_world, trajectory.inlier_ratio
        world_from_cam = inverse(cam_from_world)
        return SlamResult(
            world_from_cam=cam_from_world[0] @ world_from_cam,
            frame_inlier_ratio=frame_inliers,
            timestamps_s=selection.timestamps_s,
            keyframes=np.array(keyframes.frame_index, dtype=np.int64),
            inverse_depth=keyframes.depths(),
            static=keyframes.statics(),
            working=size,
            camera=Camera.from_index_params("pinhole", keyframes.intrinsics, size.width, size.height),
            motion=motion,
            focal=focal,
            map=found,
            timings_s=timings,
        )

    def _rotation_only(
        self, fitter: RotationFitter, keyframes: KeyframeMap, graph: Graph, prior: FocalPrior, found: MapReport
    ) -> FocalReport | None:
        """Replace the map by rotations when they explain the measurements as well as poses and depths do."""
        links = [Link(i, j, graph[i, j], np.ones(keyframes.grid.num_cells, dtype=np.bool_)) for i, j in graph]
        if not links:
            return None
        inflation = self._settings.focal_sigma_inflation
        start = fitter.chain(len(keyframes), links, keyframes.intrinsics)
        scaled = FocalPrior(prior.log_focal, prior.sigma / inflation)
        fit = fitter.fit(start, (0,), links, keyframes.intrinsics, scaled)
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
        sigma = inflation * fit.log_focal_sigma
        return FocalReport(sigma, observed=sigma < prior.sigma)

    def _initial_camera(self, source: FrameSource, selection: Selection, size: WorkingSize) -> IntrinsicsEstimate:
        """The initial camera at the working size, with pixels that are square in the source video."""
        estimate = self._priors.intrinsics.estimate(selection.sample, size.grid)
        scale_x, scale_y = size.width / source.info.width, size.height / source.info.height
        focal_px = estimate.camera.focal_px / math.sqrt(scale_x * scale_y)
        width, height = source.info.width, source.info.height
        square = Camera("pinhole", (focal_px, focal_px, width / 2, height / 2), width, height)
        return IntrinsicsEstimate(square.resized(size.width, size.height), estimate.log_focal_sigma, estimate.num_pairs)


@contextmanager
def _timed(timings: dict[str, float], stage: str) -> Iterator[None]:
    start = time.perf_counter()
    try:
        yield
    finally:
        timings[stage] = time.perf_counter() - start
