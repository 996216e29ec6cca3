"""The SLAM stage of a rig: from synchronised frames to a pose for every instant (paper section 3.2.6).

Every view of every chosen instant is a keyframe with depths, features and masks of its own; what makes it a rig is that
the adjustment has one pose per instant.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from vipe_core.cameras import Camera
from vipe_core.errors import ConfigError
from vipe_core.geometry.arrays import inverse
from vipe_core.priors.protocols import IntrinsicsEstimate, PriorFamily
from vipe_core.slam.adjustment import Adjuster, ExtrinsicPrior, FocalPrior
from vipe_core.slam.backend import Backend
from vipe_core.slam.diagnostics import LoopReport, MapReport, examine, examine_loops
from vipe_core.slam.graph import Graph
from vipe_core.slam.infill import Trajectory
from vipe_core.slam.keyframes import KeyframeMap
from vipe_core.slam.mapping import ShotMap
from vipe_core.slam.masks import MotionMasks
from vipe_core.slam.measuring import MeasuredGraph
from vipe_core.slam.reprojection import Reprojector
from vipe_core.slam.rig_bootstrap import RigBootstrap
from vipe_core.slam.rig_frames import EncodedRig, RigSource
from vipe_core.slam.rig_infill import fill_in_rig
from vipe_core.slam.rig_selection import RigSelection, select_rig_keyframes
from vipe_core.slam.rig_tracking import RigTracker
from vipe_core.slam.selection import Report, Shot
from vipe_core.slam.settings import SlamSettings
from vipe_core.slam.system import SlamResult, ViewOfRig, with_pixels_of
from vipe_core.slam.timing import StageClock
from vipe_core.slam.working import WorkingSize, working_size
from vipe_core.video.source import VideoInfo

# How closely the focal length of a calibration that is a starting point holds.
_CALIBRATED_SIGMA = 0.02
# How far off extrinsics that are to be refined are thought to be: of the size of the rig, and degrees.
_PLACE_SIGMA_RATIO = 0.02
_ROTATION_SIGMA_DEG = 2.0
_LEAST_SIGMA_RATIO = 1e-6


@dataclass(frozen=True, slots=True)
class RigCameras:
    """What is known of a rig before.

    Attributes:
        cam_from_rig: (V, 4, 4) float64.
        cameras: Of the views, at the sizes of their videos, `pinhole` or `mei`; None is estimated.
        held: Known cameras are not adjusted.
        shared: All views have one camera: it is estimated or adjusted as one.
        refine: Adjust the extrinsics but for view 0.
        extrinsic_sigma: (V, 2) how far off they may then be, 1-sigma: a camera's place, in the units of the extrinsics,
            and its rotation in degrees; NaN for 2 % of the size of the rig, and for 2 degrees.
    """

    cam_from_rig: NDArray[np.float64]
    cameras: tuple[Camera | None, ...]
    held: bool = True
    shared: bool = False
    refine: bool = False
    extrinsic_sigma: NDArray[np.float64] | None = None

    def prior(self) -> ExtrinsicPrior | None:
        """What holds the extrinsics while they are adjusted; None where they are not."""
        if not self.refine:
            return None
        extent = _extent(self.cam_from_rig)
        usual = np.array([_PLACE_SIGMA_RATIO * extent, _ROTATION_SIGMA_DEG])
        sigma = np.tile(usual, (len(self.cameras), 1))
        if self.extrinsic_sigma is not None:
            sigma = np.where(np.isfinite(self.extrinsic_sigma), self.extrinsic_sigma, usual)
        # Cameras in one place stay there.
        place = np.maximum(sigma[:, 0], _LEAST_SIGMA_RATIO * extent if extent > 0 else 1e-6)
        return ExtrinsicPrior(np.array(self.cam_from_rig), place, np.radians(sigma[:, 1]))


@dataclass(frozen=True, slots=True)
class RigSlamResult:
    """What the SLAM stage of a rig hands on.

    Attributes:
        views: The result of every view, all in one world: that of the first camera of view 0.
        map: Diagnostics of all keyframes of all views.
        cam_from_rig: (V, 4, 4) float64 extrinsics in the units of the map, refined if that was asked for.
        rig_units: Length of the map's unit in that of the extrinsics as they were given.
        scale_sigma_ratio: 1-sigma of the logarithm of `rig_units`: how well the size of the rig tells the scale;
            infinite where all cameras are in one place or nothing moved.
    """

    views: tuple[SlamResult, ...]
    map: MapReport
    cam_from_rig: NDArray[np.float64]
    rig_units: float
    scale_sigma_ratio: float


class RigSlam:
    """The stage with its components; reusable for any number of recordings, one at a time."""

    def __init__(self, priors: PriorFamily, settings: SlamSettings, device: torch.device) -> None:
        self._priors = priors
        self._settings = settings
        self._device = device

    def run(self, source: RigSource, rig: RigCameras, report: Report) -> RigSlamResult:
        """Pose every instant.

        Args:
            report: Told the stage and how far it is; what it raises ends the run.

        Raises:
            InputError, DecodeError: From the source; EmptyMedia when it holds no frame.
            ConfigError: The rig has another number of views.
        """
        if len(source.infos) != len(rig.cameras):
            raise ConfigError(f"the rig has {len(rig.cameras)} views, but there are {len(source.infos)} videos")
        clock, settings = StageClock(self._device), self._settings
        size = _common_size(source.infos, rig.cameras, settings.working_area_px)
        frames = EncodedRig(source, size, self._priors.matcher, settings.frame_cache_bytes)
        with clock("scan"):
            selection = select_rig_keyframes(frames, size, settings, report)
        with clock("intrinsics"):
            cameras, prior = self._cameras(source.infos, rig, selection, size)
            report("intrinsics", 1, 1)
        reprojector = Reprojector(cameras[0].model, size.grid)
        done, sigma = self._map(rig, cameras, prior, selection, size, reprojector, clock, report)
        with clock("infill"):
            dense = settings.terms.dense_flow
            trajectories = fill_in_rig(
                done,
                frames,
                selection.placed,
                reprojector,
                max(1, settings.infill_batch // frames.num_views),
                report,
                self._priors.aligner if dense else None,
                None if dense else self._priors.tracker,
                selection.blind,
            )
            frames.release()
        keyframes = done.keyframes
        assert keyframes.cam_from_rig is not None
        views = _views(done, trajectories, selection, size, clock)
        return RigSlamResult(
            tuple(_in_its_model(view, camera) for view, camera in zip(views, rig.cameras, strict=True)),
            done.found,
            keyframes.cam_from_rig,
            keyframes.rig_units,
            sigma,
        )

    # -- cameras ---------------------------------------------------------------------------------------------------

    def _cameras(
        self, infos: Sequence[VideoInfo], rig: RigCameras, selection: RigSelection, size: WorkingSize
    ) -> tuple[list[Camera], FocalPrior]:
        """The initial cameras at the working size, one where all share it, and what holds their focal length."""
        sigmas = []
        cameras = []
        rivals: tuple[float, ...] = ()
        for view, info in enumerate(infos):
            known = rig.cameras[view]
            if known is not None:
                cameras.append(known.resized(*size.size))
                sigmas.append(_CALIBRATED_SIGMA)
                continue
            estimate = self._estimate(info, selection, view, size)
            cameras.append(estimate.camera)
            sigmas.append(estimate.log_focal_sigma)
            rivals = tuple(math.log(rival_px) for rival_px in estimate.rivals_px) if rig.shared else ()
        if len({camera.model for camera in cameras}) > 1:
            cameras = [_unified(camera) for camera in cameras]
        held = rig.held and all(camera is not None for camera in rig.cameras)
        if rig.shared:
            best = int(np.argmin(sigmas))
            cameras, sigmas = [cameras[best]], [sigmas[best]]
        elif all(camera.params == cameras[0].params for camera in cameras) and held:
            cameras = cameras[:1]
        logs = tuple(math.log(camera.focal_px) for camera in cameras)
        return cameras, FocalPrior(logs[0], max(sigmas), rivals, held=held, of_views=logs if len(logs) > 1 else ())

    def _estimate(self, info: VideoInfo, selection: RigSelection, view: int, size: WorkingSize) -> IntrinsicsEstimate:
        estimate = self._priors.intrinsics.estimate(selection.samples[view], size.grid)
        return with_pixels_of(info, estimate, size)

    # -- the map ---------------------------------------------------------------------------------------------------

    def _map(
        self,
        rig: RigCameras,
        cameras: Sequence[Camera],
        prior: FocalPrior,
        selection: RigSelection,
        size: WorkingSize,
        reprojector: Reprojector,
        clock: StageClock,
        report: Report,
    ) -> tuple[ShotMap, float]:
        settings, views = self._settings, len(rig.cameras)
        scale_px = settings.scaled_px(1.0, size.width)
        intrinsics = np.stack([camera.index_params() for camera in cameras])
        keyframes = KeyframeMap(
            size.grid, cameras[0].model, intrinsics[0] if len(intrinsics) == 1 else intrinsics, rig.cam_from_rig
        )
        graph = Graph()
        extent, extrinsics = _extent(rig.cam_from_rig), rig.prior()
        adjuster = Adjuster(settings, self._device, prior, scale_px, extrinsics)
        measured = MeasuredGraph(
            keyframes,
            graph,
            self._priors.matcher,
            self._priors.tracker if settings.terms.sparse_tracks else None,
            self._priors.points,
            reprojector,
            dense_flow=settings.terms.dense_flow,
            aligner=self._priors.aligner,
            blind=selection.blind,
        )
        masks = MotionMasks(
            reprojector, keyframes, graph, adjuster.robust_scale_px, enabled=settings.terms.motion_masks
        )
        backend = Backend(measured, adjuster, reprojector, masks, settings, size.width)
        static = selection.max_motion_px < settings.scaled_px(settings.static_motion_px, size.width)
        chosen = selection.keyframes[:1] if static else selection.keyframes
        times_s = [float(selection.timestamps_s[keyframe.index]) for keyframe in chosen]
        total = len(selection.timestamps_s)
        with clock("track"):
            tracker = RigTracker(measured, adjuster, reprojector, masks, settings)
            first = min(len(chosen), settings.min_keyframes)
            RigBootstrap(measured, adjuster, reprojector, masks, settings.neighbours).run(
                chosen[:first], times_s[:first]
            )
            for done in range(first, len(chosen) + 1):
                if done > first:
                    tracker.add(chosen[done - 1], times_s[done - 1])
                if settings.backend_due(done) and done < len(chosen):
                    backend.run()
                report("track", chosen[done - 1].index + 1, total)
        before = keyframes.snapshot()
        with clock("backend"):
            adjuster.alive = _reporting(report)
            backend.run()
            loops = examine_loops(reprojector, keyframes, graph, before, settings.neighbours)
            backend.sharpen()
            sigma = math.inf if static else adjuster.scale_sigma(keyframes, graph)
            # More measurements do not average away what is wrong with the cameras, or with the places that they have.
            places = 0.0 if extrinsics is None or extent <= 0 else float(extrinsics.place_sigma.max()) / extent
            sigma = math.hypot(sigma, settings.lens_sigma, places)
            adjuster.alive = _nothing
            report("backend", 1, 1)
        found = examine(reprojector, keyframes, graph, adjuster.robust_scale_px)
        usable = np.stack([masks.reliable(k) for k in range(len(keyframes))])
        labels = np.stack([masks.labels(k) for k in range(len(keyframes))])
        assert len(keyframes) == views * len(chosen)
        shot = Shot(0, total, chosen, selection.max_motion_px)
        return (
            ShotMap(
                shot,
                keyframes,
                graph,
                "static" if static else "general",
                backend.focal_sigma_ratio,
                found,
                loops,
                adjuster,
                None,
                usable,
                labels,
            ),
            sigma,
        )


def _reporting(report: Report) -> Callable[[], None]:
    return lambda: report("backend", 0, 1)


def _nothing() -> None:
    pass


def _extent(cam_from_rig: NDArray[np.float64]) -> float:
    """Largest distance between two cameras."""
    centres = inverse(cam_from_rig)[:, :3, 3]
    return float(np.linalg.norm(centres[:, None] - centres[None], axis=-1).max())


def _views(
    done: ShotMap,
    trajectories: Sequence[Trajectory],
    selection: RigSelection,
    size: WorkingSize,
    clock: StageClock,
) -> tuple[SlamResult, ...]:
    """The results of the views, in the world of the first camera of view 0."""
    keyframes, views = done.keyframes, done.keyframes.num_views
    first_from_world = trajectories[0].cam_from_world[0]
    results = []
    for view, trajectory in enumerate(trajectories):
        rows = slice(view, None, views)
        results.append(
            SlamResult(
                world_from_cam=first_from_world @ inverse(trajectory.cam_from_world),
                trajectory=trajectory,
                timestamps_s=selection.timestamps_s,
                cuts=(),
                keyframes=np.array(keyframes.frame_index[rows], dtype=np.int64),
                inverse_depth=keyframes.depths()[rows],
                static=keyframes.statics()[rows],
                working=size,
                camera=keyframes.camera_of(view),
                motion=done.motion,
                focal_sigma_ratio=done.focal_sigma_ratio,
                map=_of_view(done.found, rows),
                rig=_of_rig(done.adjuster, selection, view),
                loops=LoopReport(
                    done.loops.edges,
                    done.loops.residual_before_px,
                    done.loops.residual_after_px,
                    done.loops.moved_ratio,
                ),
                timings_s=clock.seconds,
                peak_bytes=clock.peak_bytes,
            )
        )
    return tuple(results)


def _of_view(found: MapReport, rows: slice) -> MapReport:
    """The numbers of the keyframes of one view; what holds the map together, and its parallax, are the rig's."""
    coverage = found.keyframe_coverage[rows]
    residual_px = found.keyframe_residual_px[rows]
    measured = np.isfinite(residual_px)
    return MapReport(
        residual_px=float(np.median(residual_px[measured])) if measured.any() else math.nan,
        inlier_ratio=float(found.keyframe_inlier_ratio[rows][measured].mean()) if measured.any() else 0.0,
        coverage=float(coverage.mean()),
        weakest_link=found.weakest_link,
        parallax_deg=found.parallax_deg,
        confidence=found.confidence[rows],
        keyframe_residual_px=found.keyframe_residual_px[rows],
        keyframe_inlier_ratio=found.keyframe_inlier_ratio[rows],
        keyframe_coverage=found.keyframe_coverage[rows],
    )


def _of_rig(adjuster: Adjuster, selection: RigSelection, view: int) -> ViewOfRig:
    blind = view in selection.blind
    if view == 0 or adjuster.extrinsic_sigma is None:
        return ViewOfRig(blind)
    place, rotation = adjuster.extrinsic_sigma[view]
    return ViewOfRig(blind, math.degrees(rotation), float(place))


def _common_size(infos: Sequence[VideoInfo], cameras: Sequence[Camera | None], area_px: int) -> WorkingSize:
    """The working size of all views: the mean shape of their pictures."""
    shapes = []
    for info, camera in zip(infos, cameras, strict=True):
        aspect = info.pixel_aspect if camera is None else camera.params[1] / camera.params[0]
        shapes.append((info.width, info.height, aspect))
    if len(set(shapes)) == 1:
        width, height, aspect = shapes[0]
    else:
        width, height, aspect = np.exp(np.log(shapes).mean(axis=0)).tolist()
    return working_size(round(width), round(height), area_px, pixel_aspect=aspect)


def _unified(camera: Camera) -> Camera:
    """A pinhole as the unified camera that it is a case of."""
    if camera.model == "mei":
        return camera
    return Camera("mei", (*camera.params, 0.0), camera.width, camera.height)


def _in_its_model(result: SlamResult, known: Camera | None) -> SlamResult:
    """A view whose camera is a known pinhole, where it was a unified camera among others, and stayed what it was."""
    camera = result.camera
    if known is None or known.model != "pinhole" or camera.model != "mei" or camera.params[4] != 0:
        return result
    rays = camera.unproject(result.grid.sample_px().numpy())
    pinhole = Camera("pinhole", camera.params[:4], camera.width, camera.height)
    return replace(result, camera=pinhole, inverse_depth=(result.inverse_depth / rays[:, 2]).astype(np.float32))
