"""Dense depth of every frame from a video depth model, aligned to the map; in order, in bounded memory.

Two decoders run through the video: one ahead, at the size that the model wants, and one behind it at source size, whose
pictures go out with the depth. Between them wait the frames of a window and those that later frames still smooth.
"""

from __future__ import annotations

import logging
from collections import Counter, deque
from collections.abc import Generator, Iterator
from contextlib import closing
from dataclasses import dataclass
from itertools import islice
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vipe_core.ba.problem import Grid
from vipe_core.depth.alignment import AffineTrack, AlignmentSettings, Measurement, apply, measure
from vipe_core.depth.anchors import AnchorFinder, Anchors
from vipe_core.depth.scale import believed_cells, shots_of
from vipe_core.depth.types import FILLED, MEASURED, MOVING, SKY, UNOBSERVED, DepthFrame, SceneMap
from vipe_core.depth.windows import stitched
from vipe_core.errors import ConfigError, EngineError
from vipe_core.priors.protocols import DepthFamily, VideoDepth
from vipe_core.slam.segmentation import segment
from vipe_core.video.source import Frame, FrameSource

Array = NDArray[Any]

logger = logging.getLogger(__name__)

# Depth ends at so many times the farthest that the map knows, which is this quantile of its inverse depth.
_FAR, _FARTHEST = 5.0, 0.01
# Relative errors that halve the confidence: of the video depth around a pixel, and of the alignment as a whole.
_HALF_LOCAL, _HALF_SCALE = 0.05, 0.05
# Cells over which errors are averaged, and what the frame's own counts as, in samples.
_REACH_CELLS, _PRIOR_SAMPLES = 2.0, 0.1
# Confidence of what no sample is near to, as a share of the frame's.
_UNSUPPORTED = 0.5


@dataclass(frozen=True, slots=True)
class _Waiting:
    """A frame whose alignment later frames still smooth."""

    index: int
    video: NDArray[np.float32]
    anchors: Anchors
    measurement: Measurement | None


class AlignedDepth:
    """The depth stage for families with video depth; reusable for any number of videos.

    Args:
        family: With video depth.
        metres: Whether scenes are in metres, so that metric depth can stand in where there is no map.

    Raises:
        ConfigError: The family has no video depth.
    """

    def __init__(self, family: DepthFamily, settings: AlignmentSettings | None = None, *, metres: bool = False) -> None:
        if family.video is None:
            raise ConfigError("depth can only be aligned where the preset has video depth")
        self._video: VideoDepth = family.video
        self._family = family
        self._settings = settings or AlignmentSettings()
        self._metres = metres

    def stream(self, source: FrameSource, scene: SceneMap) -> Generator[DepthFrame, None, None]:
        """Depth of every frame of the video, in order; closing the iterator stops the decoders.

        Raises:
            InputError, DecodeError: From the source.
            EngineError: The video has fewer frames than there are poses, or the model does not keep to its protocol.
        """
        info = source.info
        size = self._video.input_size(info.width, info.height)
        finder = AnchorFinder(scene, self._family, self._video.depth_kind, size, self._metres)
        count = len(scene.world_from_cam)
        with closing(source.frames(size=size)) as ahead, closing(source.frames()) as behind:
            for shot in shots_of(scene):
                numbers, cells = believed_cells(scene, shot)
                values = scene.inverse_depth[numbers][cells]
                farthest, median = np.quantile(values, (_FARTHEST, 0.5)) if len(values) else (1.0, 1.0)
                least = float(farthest) / _FAR
                part = islice(_counted(ahead, count), shot[1] - shot[0])
                for waiting, affine, sigma in self._aligned(part, finder, float(median)):
                    picture = next(behind, None)
                    if picture is None:
                        raise _too_short(waiting.index, count)
                    yield self._finish(picture, waiting, affine, sigma, finder, scene, least)

    def _aligned(
        self, frames: Iterator[Frame], finder: AnchorFinder, median: float
    ) -> Iterator[tuple[_Waiting, tuple[float, float], float]]:
        """The frames of one shot with their (alpha, beta) and the relative standard deviation of the scale."""
        track = AffineTrack(self._settings.drift_ratio)
        queue: deque[_Waiting] = deque()
        regimes: Counter[str] = Counter()
        for frame, video in stitched(self._video, frames):
            anchors = finder.of(frame, video)
            start = track.predicted(video, median)
            measurement = measure(anchors.samples, start)
            track.add(start, measurement, median)
            regimes["nothing" if measurement is None else measurement.regime] += 1
            queue.append(_Waiting(frame.index, video, anchors, measurement))
            if len(queue) > self._settings.lag_frames:
                yield queue.popleft(), *track.smoothed_first()
                track.drop_first()
        while queue:
            yield queue.popleft(), *track.smoothed_first()
            track.drop_first()
        logger.info("frames that tell of scale and shift, of one number, of nothing: %s", dict(regimes))

    def _finish(
        self,
        picture: Frame,
        waiting: _Waiting,
        affine: tuple[float, float],
        sigma: float,
        finder: AnchorFinder,
        scene: SceneMap,
        least: float,
    ) -> DepthFrame:
        """Depth at source size, and how far it is to be believed."""
        height, width = picture.rgb.shape[:2]
        nothing = np.isnan(waiting.video) | (finder.along <= 0)
        aligned = apply(waiting.video, affine, least)
        far = (aligned <= least) & ~nothing
        # Of the model's kind; the stage's is along the rays.
        along = np.where(finder.along > 0, finder.along, 1.0).astype(np.float32)
        # A hole is taken for as far as the rest typically is: there is nothing to fill it with.
        typical = np.float32(1.0) if nothing.all() else np.median(aligned[~nothing])
        aligned = np.where(nothing, typical, aligned / along)
        confidence = self._confidence(waiting, affine, sigma, scene)
        # In inverse depth, so that an edge against the sky keeps to what is in front of it.
        large = cv2.resize(aligned, (width, height), interpolation=cv2.INTER_LINEAR)
        sure = np.clip(cv2.resize(confidence, (width, height), interpolation=cv2.INTER_LINEAR), 0, 1)
        moving = self._moving(picture, scene)
        sky, blind = (
            cv2.resize(mask.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0
            for mask in (far, nothing)
        )
        sure[sky | blind] = 0
        kind = np.where(sure > 0, MEASURED, FILLED).astype(np.uint8)
        kind[moving], kind[sky], kind[blind] = MOVING, SKY, UNOBSERVED
        return DepthFrame(picture.index, picture.rgb, (1 / large).astype(np.float32), sure, kind, moving)

    def _confidence(
        self, waiting: _Waiting, affine: tuple[float, float], sigma: float, scene: SceneMap
    ) -> NDArray[np.float32]:
        """(h8, w8) from how well the aligned depth fits the map around a pixel, and the sureness of the scale."""
        shape: tuple[int, int] = scene.inverse_depth.shape[1:]
        if waiting.measurement is None:
            return np.zeros(shape, np.float32)
        n = waiting.anchors.measured
        samples = waiting.anchors.samples
        known = np.isfinite(samples.video[:n])
        expected = affine[0] * samples.video[:n][known] + affine[1]
        error = np.minimum(np.abs(expected / samples.scene[:n][known] - 1), 1.0)
        weight, total = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
        cell = waiting.anchors.cell[:n][known]
        weight.ravel()[cell] = 1
        total.ravel()[cell] = error
        near = cv2.GaussianBlur(weight, (0, 0), _REACH_CELLS)
        local = cv2.GaussianBlur(total, (0, 0), _REACH_CELLS)
        mean = (local + _PRIOR_SAMPLES * waiting.measurement.sigma) / (near + _PRIOR_SAMPLES)
        support = _UNSUPPORTED + (1 - _UNSUPPORTED) * near / (near + _PRIOR_SAMPLES)
        whole = 1 / (1 + (sigma / _HALF_SCALE) ** 2)
        return np.asarray(whole * support / (1 + np.square(mean / _HALF_LOCAL)), np.float32)

    def _moving(self, picture: Frame, scene: SceneMap) -> NDArray[np.bool_]:
        moving = np.zeros(picture.rgb.shape[:2], np.bool_)
        if scene.labels is not None:
            grid = Grid(scene.camera.height // 8, scene.camera.width // 8)
            moving |= segment(picture.rgb, scene.labels[picture.index], grid) > 0
        if picture.masked is not None:
            moving |= picture.masked
        return moving


def _counted(frames: Iterator[Frame], count: int) -> Iterator[Frame]:
    """The frames; an error where there are fewer than `count`."""
    seen = 0
    for frame in frames:
        seen = frame.index + 1
        yield frame
    if seen < count:
        raise _too_short(seen, count)


def _too_short(index: int, count: int) -> EngineError:
    return EngineError(f"the video gave {index} frames to the depth stage, but {count} poses were found in it")
