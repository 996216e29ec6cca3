"""Annotating the synchronised videos of a rig: every view is an annotation, and all are in one world."""

from __future__ import annotations

import dataclasses
import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from vipe_core.annotation import Annotation, ProgressCallback, depth_kind_of
from vipe_core.cameras.calibration import Calibration
from vipe_core.cameras.rig import ExtrinsicSigma, Rig, read_rig
from vipe_core.depth.known import KnownLength
from vipe_core.depth.scene import scene_of
from vipe_core.errors import ConfigError
from vipe_core.geometry.arrays import inverse
from vipe_core.pipeline.annotator import (
    Annotator,
    Reporter,
    camera_of_pictures,
    camera_to_solve,
    known_camera,
    typed_errors,
    undistorted,
)
from vipe_core.pipeline.scaling import RigSize, ScaledScene, set_rig_scale
from vipe_core.quality import assess
from vipe_core.slam.rig_system import RigCameras, RigSlam, RigSlamResult
from vipe_core.slam.system import SlamResult
from vipe_core.video import open_source
from vipe_core.video.source import FrameSource
from vipe_core.video.synchronised import SynchronisedSource

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class RigAnnotation:
    """The views of a rig.

    Attributes:
        views: One annotation per view, in one world, the first camera of the first view, and in one scale.
        rig: As it was given, with the extrinsics in units of the trajectories and the cameras of the views; refined
            where that was asked for.
        world_from_rig: (N, 4, 4) float64.
    """

    views: tuple[Annotation, ...]
    rig: Rig
    world_from_rig: NDArray[np.float64]


class RigAnnotator(Annotator):
    """An engine that is ready to annotate recordings of rigs, one after the other; arguments as `Annotator`."""

    def annotate_rig(
        self,
        rig: Rig | str | Path,
        videos: Sequence[str | Path | FrameSource] | None = None,
        *,
        names: Sequence[str] | None = None,
        scale_from: str | None = None,
        memory_bytes: int | None = None,
        progress: ProgressCallback | None = None,
    ) -> RigAnnotation:
        """Poses, cameras and quality of every view; dense depth when it is asked for.

        Args:
            rig: What is known of the rig, or its file.
            videos: One per view, in their order; those that the rig file names, which lie beside it, if None.
            names: Of the sequences that come out; those of the views if None.
            scale_from: As in `Annotator.annotate`, for the first view; it takes the place of the size of the rig.
            memory_bytes: As there.
            progress: Told how far the annotation is; an exception out of it ends the annotation.

        Raises:
            InputError, DecodeError: A video cannot be read, or the videos do not belong together.
            ConfigError: The rig file is not understood, or names no videos; the preset does not annotate rigs.
            ScaleUnobservable: The video does not show the known length.
            EngineError: A stage failed, a defect of ours.
        """
        priors = self._priors()
        if priors.refiner is not None or self.preset.camera == "equirect":
            raise ConfigError(f"the preset {self.preset.name} does not annotate rigs; classical and wide_angle do")
        if self._masks is not None:
            raise ConfigError(
                "rigs are annotated without masks of what phrases name; choose a preset or options without"
            )
        known_length = None if scale_from is None else KnownLength.parse(scale_from)
        beside = Path(rig).parent if isinstance(rig, (str, Path)) else None
        known = rig if isinstance(rig, Rig) else read_rig(rig)
        titles = [view.name for view in known.views]
        opened = [
            open_source(video, name=name) if isinstance(video, (str, Path)) else video
            for video, name in zip(_videos(known, beside, videos), names or titles, strict=True)
        ]
        given = [known_camera(one, video) for one, video in zip(_calibrations(known), opened, strict=True)]
        solved = [undistorted(one, camera) for one, camera in zip(opened, given, strict=True)]
        source = SynchronisedSource(solved, titles)
        report = Reporter(progress)
        self._budget(memory_bytes, low_memory=False)
        with typed_errors(opened[0], report), torch.inference_mode():
            slam = RigSlam(priors, self.preset.slam, self.device)
            cameras = [camera_to_solve(camera, one) for camera, one in zip(given, solved, strict=True)]
            result = slam.run(source, _cameras(known, cameras), report)
            size = RigSize(known.metric, result.rig_units, result.scale_sigma_ratio)
            scenes = [scene_of(view) for view in result.views]
            scaled, factor = set_rig_scale(scenes, solved[0], known_length, self._depth.metric, size, report)
        views = []
        for number, one in enumerate(solved):
            views.append(self._annotation(one, result.views[number], scaled[number], given[number], report))
        logger.info("%s: %d views, scale %s", opened[0].info.name, len(views), views[0].scale)
        refined = _refined(known, result, factor, views)
        world_from_rig = views[0].world_from_cam @ inverse(refined.views[0].rig_from_cam)
        return RigAnnotation(tuple(views), refined, world_from_rig)

    def _annotation(
        self,
        source: FrameSource,
        found: SlamResult,
        scaled: ScaledScene,
        given: Calibration | None,
        report: Reporter,
    ) -> Annotation:
        """One view by itself."""
        clock = self._clock(found)
        quality = assess(found, self.preset.slam, source.info.width)
        return Annotation(
            name=source.info.name,
            world_from_cam=scaled.scene.world_from_cam,
            camera=camera_of_pictures(found.camera, given, source),
            timestamps_s=found.timestamps_s,
            fps=source.info.fps,
            keyframes=found.keyframes,
            scale=scaled.scale,
            depth_kind=depth_kind_of(found.camera),
            quality=dataclasses.replace(quality, scale_sigma_ratio=scaled.sigma_ratio),
            provenance=self._provenance(source, scaled, given),
            dense=lambda: self._dense(source, scaled, None, clock, report),
            timings_s=clock.seconds,
            peak_bytes=clock.peak_bytes,
        )


def _videos(
    rig: Rig, beside: Path | None, videos: Sequence[str | Path | FrameSource] | None
) -> Sequence[str | Path | FrameSource]:
    """Given ones, or those of the rig file."""
    if videos is not None:
        if len(videos) != len(rig.views):
            raise ConfigError(f"the rig has {len(rig.views)} views, but {len(videos)} videos were given")
        return videos
    missing = [view.name for view in rig.views if view.video is None]
    if missing:
        raise ConfigError(f"the rig names no video for {', '.join(missing)}; give one video per view")
    return [(beside or Path()) / view.video for view in rig.views if view.video is not None]


def _calibrations(rig: Rig) -> list[Calibration | None]:
    """Of the views; one that they share is that of all."""
    own = [view.calibration for view in rig.views]
    return [next((one for one in own if one is not None), None)] * len(own) if rig.shared else own


def _cameras(rig: Rig, given: Sequence[Calibration | None]) -> RigCameras:
    known = [calibration for calibration in given if calibration is not None]
    sigmas = [None if view.sigma is None else (view.sigma.place, view.sigma.rotation_deg) for view in rig.views]
    return RigCameras(
        rig.cam_from_rig,
        tuple(None if calibration is None else calibration.camera for calibration in given),
        held=all(calibration.use == "fixed" for calibration in known),
        shared=rig.shared,
        refine=rig.refine,
        extrinsic_sigma=np.array([(math.nan, math.nan) if one is None else one for one in sigmas]),
    )


def _refined(rig: Rig, result: RigSlamResult, factor: float, views: Sequence[Annotation]) -> Rig:
    """The rig in units of the trajectories, with the cameras of the views."""
    mounts = inverse(result.cam_from_rig)
    mounts[:, :3, 3] *= factor
    refined = []
    for number, (view, mount, found) in enumerate(zip(rig.views, mounts, views, strict=True)):
        sigma = view.sigma
        if rig.refine and number > 0 and (one := result.views[number].rig) is not None:
            sigma = ExtrinsicSigma(one.rotation_sigma_deg, one.place_sigma / result.rig_units * factor)
        known = Calibration(found.camera)
        refined.append(replace(view, rig_from_cam=mount, calibration=known, video=None, sigma=sigma))
    return replace(rig, views=tuple(refined), metric=views[0].scale == "metric")
