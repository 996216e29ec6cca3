"""The SLAM stage as a whole: from a frame source to a pose for every frame (paper section 3.1, steps 1 to 5)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray

from vipe_core.ba.problem import Grid
from vipe_core.cameras import Camera
from vipe_core.cameras.calibration import Calibration
from vipe_core.errors import ConfigError
from vipe_core.geometry.arrays import inverse
from vipe_core.priors.protocols import IntrinsicsEstimate, PriorFamily
from vipe_core.slam.adjustment import FocalPrior
from vipe_core.slam.diagnostics import LoopReport, MapReport, combine
from vipe_core.slam.frames import EncodedFrames
from vipe_core.slam.infill import Trajectory, fill_in
from vipe_core.slam.mapping import Motion, ShotMap, ShotMapper
from vipe_core.slam.recurrent.tracks import follow_keyframes
from vipe_core.slam.selection import Report, Selection, Shot, select_keyframes
from vipe_core.slam.settings import SlamSettings
from vipe_core.slam.timing import StageClock
from vipe_core.slam.working import WorkingSize, working_size
from vipe_core.slam.zoom import NO_ZOOM, Zoom
from vipe_core.video.source import FrameSource, VideoInfo

Lean = Callable[[str, Grid, int], bool]

# How closely the later shots hold the focal length that the main one found: they share a camera.
_SAME_FOCAL_SIGMA = 1e-4
# How far from a calibration that is only a starting point the focal length may be: another copy of the lens, another
# setting of its focus.
_CALIBRATED_SIGMA = 0.02


@dataclass(frozen=True, slots=True)
class ViewOfRig:
    """What a rig says of one of its views.

    Attributes:
        blind: The view shows nothing, or stands still while the others move: its poses are those of the rig alone.
        rotation_sigma_deg: 1-sigma of its rotation in the rig, in the worst direction; 0 where that is not adjusted.
        place_sigma: Of its place, in the units that the rig was given in.
    """

    blind: bool = False
    rotation_sigma_deg: float = 0.0
    place_sigma: float = 0.0


@dataclass(frozen=True, slots=True)
class SlamResult:
    """What the SLAM stage hands on.

    Attributes:
        world_from_cam: (N, 4, 4) float64; the world is the first camera. Nothing measures the step over a cut: the
            camera stands still there.
        trajectory: How well each frame's pose is supported.
        timestamps_s: (N,) float64.
        cuts: First frames of the shots but the first.
        keyframes: (K,) int64 frame indices.
        inverse_depth: (K, P) float32 of each keyframe's cells, along the rays of the camera model.
        static: (K, P) bool, False on cells that appear to move by themselves.
        working: Size of the images that the cells belong to.
        camera: At the working size.
        motion: What kind of camera motion was found in the main shot, the one with most keyframes.
        focal_sigma_ratio: 1-sigma of the focal length as a share of it, from the main shot.
        map: Diagnostics, with the confidence of every inverse depth.
        loops: What the loop edges of the main shot did.
        timings_s: Wall seconds per stage.
        peak_bytes: Most memory of the GPU per stage; empty on a CPU.
        lean: Whether measurements were refined in the low-memory profile.
        zoom: Of the shot whose focal length changes most.
        rig: Of a view of a rig, else None.
    """

    world_from_cam: NDArray[np.float64]
    trajectory: Trajectory
    timestamps_s: NDArray[np.float64]
    cuts: tuple[int, ...]
    keyframes: NDArray[np.int64]
    inverse_depth: NDArray[np.float32]
    static: NDArray[np.bool_]
    working: WorkingSize
    camera: Camera
    motion: Motion
    focal_sigma_ratio: float
    map: MapReport
    loops: LoopReport
    timings_s: dict[str, float]
    zoom: Zoom = NO_ZOOM
    rig: ViewOfRig | None = None
    peak_bytes: dict[str, int] = field(default_factory=dict)
    lean: bool = False

    @property
    def grid(self) -> Grid:
        return self.working.grid


class Slam:
    """The stage with its components; reusable for any number of videos, one at a time.

    Args:
        lean: Told the name of a video, its grid and the number of its keyframes so far: whether it is to be refined in
            the low-memory profile. What it raises ends the run.

    Raises:
        ConfigError: The settings turn off the only measurements that the priors give.
    """

    def __init__(
        self, priors: PriorFamily, settings: SlamSettings, device: torch.device, lean: Lean | None = None
    ) -> None:
        if not settings.terms.dense_flow and priors.tracker is None:
            raise ConfigError("the term dense_flow can only be off where the preset has sparse tracks")
        self._priors = priors
        self._settings = settings
        self._device = device
        self._lean = lean

    def run(self, source: FrameSource, report: Report, known: Calibration | None = None) -> SlamResult:
        """Pose every frame of the video.

        Args:
            known: The camera at the size of the source, `pinhole` or `mei`; estimated from the video if None.
            report: Told the stage and how far it is; what it raises ends the run.

        Raises:
            InputError, DecodeError: From the source; EmptyMedia when it holds no frame.
        """
        clock = StageClock(self._device)
        settings = self._settings
        refiner = self._priors.refiner
        offset_px = None if refiner is None else refiner.offset_px
        info = source.info
        aspect = info.pixel_aspect if known is None else known.camera.pixel_aspect
        size = working_size(info.width, info.height, settings.working_area_px, offset_px=offset_px, pixel_aspect=aspect)
        frames = EncodedFrames(source, size, self._priors.matcher, settings.frame_cache_bytes)
        decide = self._lean
        counted = None if decide is None else partial(decide, info.name, size.grid)
        with clock("scan"):
            selection = select_keyframes(frames, size, settings, report, counted)
        if counted is not None and counted(sum(len(shot.keyframes) for shot in selection.shots)):
            settings = replace(settings, refinement=replace(settings.refinement, lean=True))
        main = max(range(len(selection.shots)), key=lambda number: len(selection.shots[number].keyframes))
        with clock("intrinsics"):
            if known is None:
                estimate = self._initial_camera(source, selection, selection.shots[main], size)
            else:
                sigma = 0.0 if known.use == "fixed" else _CALIBRATED_SIGMA
                estimate = IntrinsicsEstimate(known.camera.resized(*size.size), sigma, 0)
            report("intrinsics", 1, 1)
        follower = self._priors.follower if settings.terms.sparse_tracks else None
        seen = None
        if follower is not None:
            with clock("follow"):
                seen = follow_keyframes(follower, source, selection, size, estimate.camera, report)
        mapper = ShotMapper(
            self._priors, settings, self._device, size, estimate.camera.model, selection.timestamps_s, clock, seen
        )
        held = known is not None and known.use == "fixed"
        maps = self._map(mapper, selection, main, estimate, held, report)
        with clock("infill"):
            tracks_only = None if settings.terms.dense_flow else self._priors.tracker
            aligner = self._priors.aligner if settings.terms.dense_flow else None
            trajectory = fill_in(
                maps,
                frames,
                selection.placed,
                mapper.reprojector,
                settings.infill_batch,
                report,
                aligner,
                tracks_only,
                None if refiner is None else (refiner, settings.refinement),
            )
            frames.release()
        return SlamResult(
            world_from_cam=_joined(maps, trajectory.cam_from_world),
            trajectory=trajectory,
            timestamps_s=selection.timestamps_s,
            cuts=tuple(shot.start for shot in selection.shots[1:]),
            keyframes=np.concatenate([np.array(one.keyframes.frame_index, dtype=np.int64) for one in maps]),
            inverse_depth=np.concatenate([one.keyframes.depths() for one in maps]),
            static=np.concatenate([one.keyframes.statics() for one in maps]),
            working=size,
            camera=maps[main].keyframes.camera,
            motion=maps[main].motion,
            focal_sigma_ratio=maps[main].focal_sigma_ratio,
            map=combine([one.found for one in maps]),
            loops=maps[main].loops,
            timings_s=clock.seconds,
            peak_bytes=clock.peak_bytes,
            lean=refiner is not None and settings.refinement.lean,
            zoom=max((one.zoom for one in maps), key=lambda zoom: (zoom.changes, zoom.ratio)),
        )

    def _map(
        self,
        mapper: ShotMapper,
        selection: Selection,
        main: int,
        estimate: IntrinsicsEstimate,
        held: bool,
        report: Report,
    ) -> list[ShotMap]:
        """The maps of all shots, in order. The main one finds the focal length, the others take it over."""
        intrinsics = estimate.camera.index_params()
        rivals = tuple(math.log(rival_px) for rival_px in estimate.rivals_px)
        prior = FocalPrior(math.log(estimate.camera.focal_px), estimate.log_focal_sigma, rivals, held=held)
        maps: dict[int, ShotMap] = {}
        done = 0
        for number in [main, *(k for k in range(len(selection.shots)) if k != main)]:
            shot, before = selection.shots[number], done

            def tracked(index: int, shot: Shot = shot, before: int = before) -> None:
                report("track", before + index - shot.start, selection.num_frames)

            def adjusting(last: bool = len(maps) == len(selection.shots) - 1, before: int = before) -> None:
                # The stages come one after the other, though every shot has both.
                if last:
                    report("backend", 0, 1)
                else:
                    report("track", before, selection.num_frames)

            maps[number] = mapper.run(shot, intrinsics, prior, tracked, adjusting)
            done += shot.stop - shot.start
            if number == main and not held:
                intrinsics = maps[main].keyframes.intrinsics
                prior = FocalPrior(math.log(float(intrinsics[0])), _SAME_FOCAL_SIGMA, same_lens=True)
        report("backend", 1, 1)
        return [maps[number] for number in range(len(maps))]

    def _initial_camera(
        self, source: FrameSource, selection: Selection, shot: Shot, size: WorkingSize
    ) -> IntrinsicsEstimate:
        """The initial camera at the working size."""
        sample = [frame for frame in selection.sample if shot.start <= frame.index < shot.stop]
        return with_pixels_of(source.info, self._priors.intrinsics.estimate(sample, size.grid), size)


def with_pixels_of(info: VideoInfo, estimate: IntrinsicsEstimate, size: WorkingSize) -> IntrinsicsEstimate:
    """The camera of square working pixels as that of a video, whose pixels have a shape of their own."""
    # In units of a source pixel's height, that pixel is `aspect` wide.
    aspect = info.pixel_aspect
    scale_x, scale_y = size.width / (info.width * aspect), size.height / info.height
    focal_px = estimate.camera.focal_px / math.sqrt(scale_x * scale_y)
    own = (focal_px / aspect, focal_px, info.width / 2, info.height / 2, *estimate.camera.params[4:])
    camera = Camera(estimate.camera.model, own, info.width, info.height).resized(size.width, size.height)
    scale = camera.focal_px / estimate.camera.focal_px
    rivals_px = tuple(rival_px * scale for rival_px in estimate.rivals_px)
    return IntrinsicsEstimate(camera, estimate.log_focal_sigma, estimate.num_pairs, rivals_px)


def _joined(maps: Sequence[ShotMap], cam_from_world: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 4, 4) world_from_cam in the world of the first camera: each shot goes on where the one before it ended."""
    world_from_cam = np.empty_like(cam_from_world)
    anchor = np.eye(4)
    for one in maps:
        frames = slice(one.shot.start, one.shot.stop)
        world_from_cam[frames] = anchor @ cam_from_world[one.shot.start] @ inverse(cam_from_world[frames])
        anchor = world_from_cam[one.shot.stop - 1]
    return world_from_cam
