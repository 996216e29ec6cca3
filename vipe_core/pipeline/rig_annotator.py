"""Annotating the synchronised videos of a rig: every view is an annotation, and all are in one world."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from vipe_core.annotation import Annotation, ProgressCallback, depth_kind_of
from vipe_core.cameras import Camera
from vipe_core.cameras.calibration import Calibration
from vipe_core.cameras.rig import Rig, RigView, read_rig
from vipe_core.depth.known import KnownLength
from vipe_core.depth.scene import scene_of
from vipe_core.errors import ConfigError
from vipe_core.geometry.arrays import inverse
from vipe_core.pipeline.annotator import Annotator, Reporter, typed_errors
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
        progress: ProgressCallback | None = None,
    ) -> RigAnnotation:
        """Poses, cameras and quality of every view; dense depth when it is asked for.

        Args:
            rig: What is known of the rig, or its file.
            videos: One per view, in their order; those that the rig file names, which lie beside it, if None.
            names: Of the sequences that come out; those of the views if None.
            scale_from: As in `Annotator.annotate`, for the first view; it takes the place of the size of the rig.
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
        source = SynchronisedSource(opened, titles)
        report = Reporter(progress)
        given = [_given(view, one) for view, one in zip(known.views, opened, strict=True)]
        with typed_errors(opened[0], report), torch.inference_mode():
            slam = RigSlam(priors, self.preset.slam, self.device)
            result = slam.run(source, _cameras(known, given), report)
            size = RigSize(known.metric, result.rig_units, result.scale_sigma_ratio)
            scenes = [scene_of(view) for view in result.views]
            scaled, factor = set_rig_scale(scenes, opened[0], known_length, self._depth.metric, size, report)
        views = []
        for number, one in enumerate(opened):
            found, calibration = result.views[number], given[number]
            camera = found.camera.resized(one.info.width, one.info.height)
            if calibration is not None and calibration.use == "fixed":
                camera = calibration.camera
            views.append(self._annotation(one, found, scaled[number], camera, report))
        logger.info("%s: %d views, scale %s", opened[0].info.name, len(views), views[0].scale)
        refined = _refined(known, result, factor, views)
        world_from_rig = views[0].world_from_cam @ inverse(refined.views[0].rig_from_cam)
        return RigAnnotation(tuple(views), refined, world_from_rig)

    def _annotation(
        self, source: FrameSource, found: SlamResult, scaled: ScaledScene, camera: Camera, report: Reporter
    ) -> Annotation:
        """One view by itself."""
        timings = dict(found.timings_s)
        quality = assess(found, self.preset.slam, source.info.width)
        return Annotation(
            name=source.info.name,
            world_from_cam=scaled.scene.world_from_cam,
            camera=camera,
            timestamps_s=found.timestamps_s,
            fps=source.info.fps,
            keyframes=found.keyframes,
            scale=scaled.scale,
            depth_kind=depth_kind_of(camera),
            quality=dataclasses.replace(quality, scale_sigma_ratio=scaled.sigma_ratio),
            provenance=self._provenance(source, scaled),
            dense=lambda: self._dense(source, scaled, None, timings, report),
            timings_s=timings,
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


def _given(view: RigView, source: FrameSource) -> Calibration | None:
    """The calibration of a view at the size of its video."""
    if view.calibration is None:
        return None
    model = view.calibration.camera.model
    if model not in ("pinhole", "mei"):
        raise ConfigError(f"view {view.name}: a rig takes pinhole and mei cameras, not {model}; undistort its video")
    info = source.info
    return view.calibration.for_size(info.width, info.height, info.name)


def _cameras(rig: Rig, given: Sequence[Calibration | None]) -> RigCameras:
    known = [calibration for calibration in given if calibration is not None]
    return RigCameras(
        rig.cam_from_rig,
        tuple(None if calibration is None else calibration.camera for calibration in given),
        held=all(calibration.use == "fixed" for calibration in known),
        shared=rig.shared,
        refine=rig.refine,
    )


def _refined(rig: Rig, result: RigSlamResult, factor: float, views: Sequence[Annotation]) -> Rig:
    """The rig in units of the trajectories, with the cameras of the views."""
    mounts = inverse(result.cam_from_rig)
    mounts[:, :3, 3] *= factor
    refined = [
        replace(view, rig_from_cam=mount, calibration=Calibration(found.camera), video=None)
        for view, mount, found in zip(rig.views, mounts, views, strict=True)
    ]
    return replace(rig, views=tuple(refined), metric=views[0].scale == "metric")
