"""The one entry point of the engine: a warm annotator, and the function that uses one once."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Generator, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np
import torch

from vipe_core.annotation import (
    MASK_PHRASES,
    UNOBSERVED,
    Annotation,
    DenseFrame,
    Progress,
    ProgressCallback,
    Provenance,
    depth_kind_of,
)
from vipe_core.cameras import Camera
from vipe_core.cameras.calibration import Calibration
from vipe_core.cameras.calibration_files import read_calibration
from vipe_core.cameras.resampling import Resampling
from vipe_core.depth.aligned import AlignedDepth
from vipe_core.depth.known import KnownLength
from vipe_core.depth.scene import scene_of
from vipe_core.depth.stream import DenseDepth
from vipe_core.depth.types import DepthFrame
from vipe_core.depth.without import NoDepth
from vipe_core.errors import ConfigError, EngineError, OutOfDeviceMemory, UnsupportedMedia, VipeError
from vipe_core.pipeline.device import (
    describe_device,
    device_memory_bytes,
    limit_memory,
    ran_out_of_memory,
    release_memory,
    resolve_device,
    set_threads,
)
from vipe_core.pipeline.masking import find_instances
from vipe_core.pipeline.memory import USABLE_SHARE, MemoryBudget
from vipe_core.pipeline.presets import Preset, PresetOptions, resolve
from vipe_core.pipeline.provenance import engine_version, library_versions
from vipe_core.pipeline.providers import open_depth, open_masks, open_priors, require_libraries
from vipe_core.pipeline.scaling import ScaledScene, set_scale
from vipe_core.priors.classical.panoramic import ends_apart, looks_panoramic
from vipe_core.priors.protocols import PriorFamily
from vipe_core.priors.weights import require_all
from vipe_core.quality import assess
from vipe_core.slam.panorama import PanoramaSlam
from vipe_core.slam.system import Slam, SlamResult
from vipe_core.slam.timing import StageClock
from vipe_core.video import MaskedView, open_source
from vipe_core.video.instances import InstanceMaps, InstanceView
from vipe_core.video.resampled import ResampledView
from vipe_core.video.source import FrameSource

logger = logging.getLogger(__name__)

# First frames of a video that must all look like panoramas for it to be one.
_PICTURES_LOOKED_AT = 3


class Annotator:
    """An engine that is ready to annotate videos one after the other.

    Args:
        preset: Name of a preset, or a `Preset` of one's own.
        camera: Camera model to estimate, `pinhole`, `mei` (wide angle) or `auto`, or `equirect` for panoramas; the
            preset's own if None.
        device: `cpu`, `cuda` or `cuda:N`: where bundle adjustment and networks run.
        threads: CPU threads of torch and OpenCV in this process. The result depends on it in the last digits; one is
            the choice that gives the same bytes everywhere, and the most videos per hour of a machine.
        options: What is changed of the preset.

    Raises:
        ConfigError: Preset, camera, device or options are not on offer.
        LibraryMissing, WeightsMissing, WeightsInvalid: What the preset needs is not on this machine; the message says
            what gets it.
        OutOfDeviceMemory: Its networks do not fit on the GPU.
    """

    def __init__(
        self,
        preset: str | Preset = "classical",
        camera: str | None = None,
        device: str = "cpu",
        *,
        threads: int = 1,
        options: PresetOptions | None = None,
    ) -> None:
        self.preset = resolve(preset, camera, options)
        self.device = resolve_device(device)
        self.threads = threads
        set_threads(threads)
        require_libraries(self.preset.providers.values())
        self._weights = require_all(self.preset.weights)
        try:
            asked = self.preset
            self._priors = open_priors(asked.matcher, asked.sparse, asked.intrinsics, asked.camera, self.device)
            self._depth = open_depth(self.preset.depth, self.preset.metric, self.device)
            self._masks = open_masks(self.preset.masks, self.preset.instances, self.device)
        except RuntimeError as error:
            if ran_out_of_memory(error):
                raise OutOfDeviceMemory(
                    f"the networks of preset {self.preset.name} do not fit in what is free of the GPU's memory: end "
                    "what else runs on it, run fewer videos on it at once, or take a smaller preset"
                ) from error
            raise

    def annotate(
        self,
        video: str | Path | FrameSource,
        *,
        name: str | None = None,
        masks: str | Path | None = None,
        scale_from: str | None = None,
        calibration: Calibration | str | Path | None = None,
        memory_bytes: int | None = None,
        low_memory: bool = False,
        progress: ProgressCallback | None = None,
    ) -> Annotation:
        """Poses, camera and quality of a video file or a directory of images; dense depth when it is asked for.

        Args:
            video: A video file, a directory of images in order of their names, or frames from elsewhere.
            name: Name of the sequence; the sanitised stem if None. Frames from elsewhere have theirs.
            masks: Directory of PNGs, one per frame, named like the pictures or by the number of the frame from 0: what
                is not zero in them is not used to find poses, camera and map, and is part of the masks that come out.
            scale_from: A length that is known, which makes the scale metric: `path=12.3` (metres that the camera goes),
                `height=1.6` (of the camera above the ground, which must be in view) or `depth=2.4@x,y,frame` (from the
                camera to what a pixel of a frame shows). Without one, and without metric depth, scale is relative.
            calibration: The camera where it is known, or its file (`cameras.calibration_files`), in place of the model
                that the preset estimates. A fixed one is returned as it was given. Of a lens with measured
                distortion the pictures are resampled for the work, and all outputs are for the pictures as they are.
            memory_bytes: What the video may take of the GPU, where others share it; nearly all if None. A video that
                would not fit is refined in the low-memory profile. Without meaning on a CPU.
            low_memory: That profile, whatever would fit: on a GPU, slower and the same but for the last digits.
            progress: Told how far the annotation is; an exception out of it ends the annotation.

        Raises:
            OutOfDeviceMemory: The low-memory profile does not fit either, or memory ran out in the work.
            InputError, DecodeError: The input cannot be read, or the masks (MaskMismatch) or the calibration
                (CalibrationMismatch) are not of this video. Code and message are meant for the user.
            ScaleUnobservable: The video does not show the known length.
            ConfigError: `scale_from` or the file of the calibration is not understood, or a panorama has a calibration.
            EngineError: A stage failed, a defect of ours; what went wrong is its `__cause__`. So does the dense stream.
        """
        known = None if scale_from is None else KnownLength.parse(scale_from)
        if calibration is not None and self.preset.camera == "equirect":
            raise ConfigError("a panorama has no calibration: its pixels are angles; leave out one of the two")
        source = open_source(video, name=name) if isinstance(video, (str, Path)) else video
        if masks is not None:
            source = MaskedView(source, masks)
        given = known_camera(calibration, source)
        report = Reporter(progress)
        instances: InstanceMaps | None = None
        clock = StageClock(self.device)
        budget = self._budget(memory_bytes, low_memory=low_memory)
        if self._masks is not None:
            with typed_errors(source, report), clock("masks"):
                instances = find_instances(source, self._masks, report)
            source = InstanceView(source, instances)
        source = undistorted(source, given)

        with typed_errors(source, report), torch.inference_mode():
            if given is None:
                result = self._slam(self._model(source), budget).run(source, report)
            else:
                slam = Slam(self._family(), self.preset.slam, self.device, budget.fit)
                result = slam.run(source, report, camera_to_solve(given, source))
            clock = self._clock(result, clock)
            quality = assess(result, self.preset.slam, source.info.width)
            with clock("scale"):
                scaled = set_scale(scene_of(result), source, known, self._depth.metric, report)
            quality = dataclasses.replace(quality, scale_sigma_ratio=scaled.sigma_ratio)
        logger.info(
            "%s: %d frames, %d keyframes, reliable: %s %s",
            source.info.name,
            len(result.timestamps_s),
            len(result.keyframes),
            quality.reliable,
            ",".join(quality.reasons),
        )
        return Annotation(
            name=source.info.name,
            world_from_cam=scaled.scene.world_from_cam,
            camera=camera_of_pictures(result.camera, given, source),
            timestamps_s=result.timestamps_s,
            fps=source.info.fps,
            keyframes=result.keyframes,
            scale=scaled.scale,
            depth_kind=depth_kind_of(result.camera),
            quality=quality,
            provenance=self._provenance(source, scaled, given, lean=result.lean),
            dense=lambda: self._dense(source, scaled, instances, clock, report),
            timings_s=clock.seconds,
            peak_bytes=clock.peak_bytes,
            mask_phrases=dict(MASK_PHRASES) if instances is None else instances.phrases,
        )

    def _model(self, source: FrameSource) -> str:
        """The camera model to estimate: that of the preset; where it is left open, panoramas are told apart here.

        Raises:
            UnsupportedMedia: A panorama is asked for, and the pictures show that they are none.
        """
        asked = self.preset.camera
        if asked not in ("auto", "equirect"):
            return asked
        if source.info.spherical:
            return "equirect"
        with closing(source.frames(stop=_PICTURES_LOOKED_AT)) as frames:
            pictures = [frame.rgb for frame in frames]
        if asked == "equirect" and ends_apart(pictures):
            raise UnsupportedMedia(
                f"{source.info.name}: not a panorama: its left and right borders do not meet; a panorama is 360 "
                "degrees wide and 180 high, and the cameras pinhole, mei and auto take other videos"
            )
        return "equirect" if asked == "equirect" or looks_panoramic(pictures) else "auto"

    def _family(self) -> PriorFamily:
        """The priors of one video: metric depth is one of the map where measurements are refined with it."""
        priors = self._priors()
        return priors if priors.refiner is None else dataclasses.replace(priors, metric=self._depth.metric)

    def release(self) -> None:
        """Give back what is kept of the GPU for the next video, so that others on it may take it."""
        release_memory(self.device)

    def _budget(self, memory_bytes: int | None, *, low_memory: bool) -> MemoryBudget:
        """What a video may take of the device, bound there from now on."""
        total_bytes = device_memory_bytes(self.device)
        if memory_bytes is None and total_bytes is not None:
            memory_bytes = int(USABLE_SHARE * total_bytes)
        if memory_bytes is not None:
            limit_memory(self.device, memory_bytes)
        return MemoryBudget(self.preset, memory_bytes, lean=low_memory)

    def _clock(self, result: SlamResult, before: StageClock | None = None) -> StageClock:
        """What the stages so far took; those that follow are added."""
        clock = before or StageClock(self.device)
        clock.seconds.update(result.timings_s)
        clock.peak_bytes.update(result.peak_bytes)
        return clock

    def _slam(self, model: str, budget: MemoryBudget) -> Slam | PanoramaSlam:
        priors = self._family()
        if model != "equirect":
            return Slam(priors, self.preset.slam, self.device, budget.fit)
        if priors.refiner is not None:
            raise ConfigError(f"the preset {self.preset.name} does not annotate panoramas; panorama and classical do")
        return PanoramaSlam(self._priors, self.preset.slam, self.device)

    def _provenance(
        self, source: FrameSource, scaled: ScaledScene, given: Calibration | None = None, *, lean: bool = False
    ) -> Provenance:
        calibration: dict[str, object] | None = None
        providers = self.preset.providers
        if given is not None:
            calibration = given.to_json()
            providers = {**providers, "intrinsics_init": "calibration"}
        if isinstance(source, ResampledView) and calibration is not None:
            ideal = source.resampling.ideal
            size = {"width": ideal.width, "height": ideal.height}
            calibration["resampled_to"] = {"model": ideal.model, "params": list(ideal.params), **size}
            source = source.source
        if isinstance(source, InstanceView):
            source = source.source
        info = source.info
        return Provenance(
            engine_version=engine_version(),
            preset=self.preset.name,
            config_hash=self.preset.config_hash,
            device=describe_device(self.device, self.threads),
            libraries=library_versions(providers.values()),
            providers=providers,
            weights=self._weights,
            source={
                "name": info.name,
                "width": info.width,
                "height": info.height,
                "codec": info.codec,
                "pixel_format": info.pixel_format,
                "size_bytes": info.size_bytes,
                "rotation_deg": info.rotation_deg,
                "pixel_aspect": info.pixel_aspect,
                **({"num_masks": source.num_masks} if isinstance(source, MaskedView) else {}),
            },
            scale_source=scaled.source,
            calibration=calibration,
            memory_profile="low" if lean else "full",
        )

    def _dense(
        self,
        source: FrameSource,
        scaled: ScaledScene,
        instances: InstanceMaps | None,
        clock: StageClock,
        report: Reporter,
    ) -> Generator[DenseFrame, None, None]:
        """Depth and mask of every frame in order; the time spent here, not in the consumer, goes to `clock`."""
        total = len(scaled.scene.world_from_cam)
        own = StageClock(self.device)
        with typed_errors(source, report):
            stream = self._depth_stage(scaled).stream(source, scaled.scene)
            if isinstance(source, ResampledView):
                stream = _taken_back(stream, source)
        with closing(stream) as frames:
            while True:
                with typed_errors(source, report), own("depth"):
                    frame = next(frames, None)
                clock.seconds.update(own.seconds)
                clock.peak_bytes.update(own.peak_bytes)
                if frame is None:
                    return
                mask = frame.moving.astype(np.uint8)
                if instances is not None:
                    ids = instances.ids(frame.index, mask.shape[1], mask.shape[0])
                    mask = np.where(ids > 0, ids, mask)
                yield DenseFrame(frame.index, frame.rgb, frame.depth, frame.confidence, mask, frame.kind)
                report("depth", frame.index + 1, total)

    def _depth_stage(self, scaled: ScaledScene) -> AlignedDepth | DenseDepth | NoDepth:
        """Video depth aligned to the map where the preset has it, multi-view stereo elsewhere, or nothing."""
        if not self.preset.makes_depth:
            return NoDepth()
        if self._depth.video is None:
            return DenseDepth(self.preset.dense_depth)
        return AlignedDepth(self._depth, self.preset.alignment, metres=scaled.scale == "metric")


def known_camera(calibration: Calibration | str | Path | None, source: FrameSource) -> Calibration | None:
    """The calibration at the size of the source."""
    if calibration is None:
        return None
    known = calibration if isinstance(calibration, Calibration) else read_calibration(calibration)
    return known.for_size(source.info.width, source.info.height, source.info.name)


def undistorted(source: FrameSource, given: Calibration | None) -> FrameSource:
    """The pictures that are worked with: resampled where they are of a lens with measured distortion."""
    if given is None or not given.camera.distorted:
        return source
    return ResampledView(source, Resampling.of(given.camera))


def camera_to_solve(given: Calibration | None, source: FrameSource) -> Calibration | None:
    """The calibration of the pictures that are worked with."""
    if given is not None and isinstance(source, ResampledView):
        return dataclasses.replace(given, camera=source.resampling.ideal)
    return given


def camera_of_pictures(found: Camera, given: Calibration | None, source: FrameSource) -> Camera:
    """The camera of the pictures as they are."""
    if given is not None and given.use == "fixed":
        return given.camera
    if isinstance(source, ResampledView):
        return source.resampling.refined(found)
    return found.resized(source.info.width, source.info.height)


def _taken_back(stream: Generator[DepthFrame, None, None], view: ResampledView) -> Generator[DepthFrame, None, None]:
    """Frames of resampled pictures as frames of the pictures themselves."""
    back = view.resampling.back
    with closing(stream) as frames, closing(view.source.frames()) as pictures:
        for frame, picture in zip(frames, pictures, strict=False):
            yield DepthFrame(
                frame.index,
                picture.rgb,
                back.depth(frame.depth),
                back.nearest(frame.confidence),
                back.nearest(frame.kind, UNOBSERVED),
                back.nearest(frame.moving.view(np.uint8)).view(np.bool_),
            )


class Reporter:
    """Passes progress on, and remembers what the callback raised: that is the caller's and goes back as it is."""

    def __init__(self, callback: ProgressCallback | None) -> None:
        self._callback = callback
        self.raised: BaseException | None = None

    def __call__(self, stage: str, done: int, total: int | None) -> None:
        if self._callback is None:
            return
        try:
            self._callback(Progress(stage, done, total))
        except BaseException as error:
            self.raised = error
            raise


@contextmanager
def typed_errors(source: FrameSource, report: Reporter) -> Iterator[None]:
    """Turns what a library threw into an EngineError; what memory, disks and the caller raise goes through."""
    try:
        yield
    except (VipeError, MemoryError, OSError):
        raise
    except Exception as error:
        if error is report.raised:
            raise
        if ran_out_of_memory(error):
            raise OutOfDeviceMemory(
                f"{source.info.name}: the GPU's memory ran out: run fewer videos on it at once, or try the low-memory "
                "profile"
            ) from error
        logger.exception("%s: a stage failed", source.info.name)
        first_line = (str(error) or "no message").splitlines()[0][:300]
        raise EngineError(
            f"{source.info.name}: {type(error).__name__}: {first_line}; please report it with the log"
        ) from error


def annotate(
    video: str | Path,
    *,
    preset: str | Preset = "classical",
    camera: str | None = None,
    device: str = "cpu",
    masks: str | Path | None = None,
    scale_from: str | None = None,
    calibration: Calibration | str | Path | None = None,
    progress: ProgressCallback | None = None,
) -> Annotation:
    """Annotate one video; see `Annotator`, which is the better choice for several.

    Example:
        annotation = vipe_core.annotate("clip.mp4")
        annotation.world_from_cam, annotation.camera.fov_x_deg, annotation.quality.reliable
    """
    return Annotator(preset, camera, device).annotate(
        video, masks=masks, scale_from=scale_from, calibration=calibration, progress=progress
    )
