"""Dense depth of every frame, in order, in memory that does not grow with the clip.

Two decoders run through the video: one ahead at the working size, whose gray pictures fill a sliding window, and one
behind it at source size, whose pictures go out with the depth. Between them, a few depth maps wait for the later frames
that confirm them.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vipe_core.ba.problem import Grid
from vipe_core.depth.completion import complete
from vipe_core.depth.geometry import KeyframePrior, Prior, choose_sources, relative
from vipe_core.depth.kernels import check, upsample
from vipe_core.depth.sweep import PlaneSweep, RawDepth
from vipe_core.depth.types import FILLED, MEASURED, MOVING, UNOBSERVED, DepthFrame, DepthSettings, SceneMap
from vipe_core.errors import EngineError
from vipe_core.slam.segmentation import segment
from vipe_core.video.source import Frame, FrameSource

Array = NDArray[Any]

# A correlation of the first says nothing, of the second as much as it can.
_MIN_SCORE, _SURE_SCORE = 0.2, 0.7
# Belief in a value of high correlation when there is no other frame to ask, and the least belief that counts.
_LONE_BELIEF, _MIN_BELIEF = 0.4, 0.2
_LEAST_WEIGHT = 0.2
# Without parallax, the keyframes' values go out with this share of their own confidence.
_PRIOR_SHARE = 0.3
# Enlarging: grey levels that lower a weight by e, and the relative difference that is still the same surface.
_EDGE, _SAME = 6.0, 0.05


@dataclass(frozen=True, slots=True)
class _Picture:
    """A frame at half of the working size.

    Attributes:
        gray: (h, w) uint8.
        moving: (h, w) bool, what moves by itself or must not be used.
    """

    gray: NDArray[np.uint8]
    moving: NDArray[np.bool_]


class DenseDepth:
    """The depth stage; reusable for any number of videos."""

    def __init__(self, settings: DepthSettings | None = None) -> None:
        self._settings = settings or DepthSettings()

    def stream(self, source: FrameSource, scene: SceneMap) -> Generator[DepthFrame, None, None]:
        """Depth of every frame of the video, in order; closing the iterator stops the decoders.

        Frames without parallax (a static camera, pure rotation) get the keyframes' inverse depth carried into them and
        filled up, with confidence 0 where nothing was measured.

        Raises:
            InputError, DecodeError: From the source.
            EngineError: The video has fewer frames than there are poses.
        """
        settings = self._settings
        num_frames = len(scene.world_from_cam)
        size = (scene.camera.width, scene.camera.height)
        reach = max(settings.check_frames, default=0)
        sweep, keyframes = PlaneSweep(scene, settings), KeyframePrior(scene)
        pictures: dict[int, _Picture] = {}
        raws: dict[int, RawDepth] = {}
        priors: dict[int, Prior] = {}
        with closing(source.frames(size=size)) as ahead, closing(source.frames()) as behind:
            decoded = 0
            for t in range(num_frames + reach):
                if t < num_frames:
                    while decoded < min(num_frames, t + settings.window_frames + 1):
                        pictures[decoded] = _half(_next(ahead, decoded, num_frames), scene)
                        decoded += 1
                    priors[t] = keyframes.of(t)
                    chosen = choose_sources(scene, sweep.coarse, priors[t], t, settings)
                    raws[t] = sweep.depth(t, pictures[t].gray, {j: pictures[j].gray for j in chosen}, priors[t])
                done = t - reach
                if done >= 0:
                    frame = _next(behind, done, num_frames)
                    yield self._finish(done, frame, pictures[done], raws, priors.pop(done), scene, sweep)
                    raws.pop(done - reach, None)
                pictures.pop(min(t, done) - settings.window_frames, None)

    def _finish(
        self,
        index: int,
        frame: Frame,
        picture: _Picture,
        raws: dict[int, RawDepth],
        prior: Prior,
        scene: SceneMap,
        sweep: PlaneSweep,
    ) -> DepthFrame:
        """Confirms, fuses, fills and enlarges the depth of one frame."""
        settings, view, raw = self._settings, sweep.fine, raws[index]
        gray = picture.gray.astype(np.float32)
        height, width = gray.shape
        prior_value = cv2.resize(prior.inverse_depth, (width, height), interpolation=cv2.INTER_LINEAR)
        prior_trust = cv2.resize(prior.confidence, (width, height), interpolation=cv2.INTER_LINEAR)
        if raw.measured:
            value = raw.inverse_depth
            votes, ratios = np.zeros_like(gray), np.zeros_like(gray)
            asked = 0
            start, stop = scene.shot_of(index)
            for j in (index + s * d for d in settings.check_frames for s in (-1, 1)):
                other = raws.get(j) if start <= j < stop else None
                if other is None or not other.measured:
                    continue
                asked += 1
                motion = relative(scene.world_from_cam, index, j)
                check(
                    value,
                    view.rays,
                    other.inverse_depth,
                    motion[:3, :3].astype(np.float32),
                    motion[:3, 3].astype(np.float32),
                    view.model,
                    view.params,
                    settings.check_tolerance,
                    votes,
                    ratios,
                )
            agrees = prior_trust * (np.abs(value / prior_value - 1) < settings.check_tolerance)
            # Without neighbours to ask, a high correlation has to do.
            share = votes / asked if asked else (raw.score > _SURE_SCORE) * np.float32(_LONE_BELIEF)
            believed = np.maximum(share, 0.5 * agrees)
            confidence = believed * np.clip((raw.score - _MIN_SCORE) / (_SURE_SCORE - _MIN_SCORE), 0.05, 1)
            confidence[believed < _MIN_BELIEF] = 0
            value = value * (1 + ratios) / (1 + votes)
            confidence = confidence.astype(np.float32)
            weight = np.where(confidence > 0, np.maximum(confidence, _LEAST_WEIGHT), 0).astype(np.float32)
            value = complete(value, weight, gray, prior_value)
        else:
            value, confidence = prior_value, (_PRIOR_SHARE * prior_trust).astype(np.float32)
        filled = FILLED if raw.measured or prior_trust.any() else UNOBSERVED
        value = np.clip(value, 0.2 * prior.low, 4 * prior.high).astype(np.float32)
        full_gray = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY)
        depth, sure = upsample(value, confidence, gray, full_gray, _EDGE, _SAME)
        moving = _enlarged(picture.moving, full_gray.shape)
        if frame.masked is not None:
            moving |= frame.masked
        kind = np.where(moving, MOVING, np.where(sure > 0, MEASURED, filled)).astype(np.uint8)
        return DepthFrame(index, frame.rgb, depth, np.clip(sure, 0, 1), kind, moving)


def _half(frame: Frame, scene: SceneMap) -> _Picture:
    height, width = frame.rgb.shape[0] // 2, frame.rgb.shape[1] // 2
    rgb = np.asarray(cv2.resize(frame.rgb, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
    moving = np.zeros((height, width), np.bool_)
    if scene.labels is not None:
        grid = Grid(scene.camera.height // 8, scene.camera.width // 8)
        moving |= segment(rgb, scene.labels[frame.index], grid) > 0
    if frame.masked is not None:
        moving |= cv2.resize(frame.masked.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0
    return _Picture(np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), np.uint8), moving)


def _enlarged(mask: NDArray[np.bool_], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    share = cv2.resize(mask.astype(np.float32), (shape[1], shape[0]), interpolation=cv2.INTER_LINEAR)
    return np.asarray(share > 0.5)


def _next(frames: Iterator[Frame], index: int, num_frames: int) -> Frame:
    frame = next(frames, None)
    if frame is None:
        raise EngineError(f"the video gave {index} frames to the depth stage, but {num_frames} poses were found in it")
    return frame
