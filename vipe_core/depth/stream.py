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
from scipy.ndimage import distance_transform_edt

from vipe_core.ba.problem import Grid
from vipe_core.depth.completion import complete
from vipe_core.depth.consistency import Confirmed, confirm
from vipe_core.depth.geometry import KeyframePrior, Prior, choose_sources
from vipe_core.depth.moving import stand
from vipe_core.depth.seam import Seam
from vipe_core.depth.sky import find_sky
from vipe_core.depth.sweep import PlaneSweep, RawDepth
from vipe_core.depth.types import FILLED, MEASURED, MOVING, SKY, UNOBSERVED, DepthFrame, DepthSettings, SceneMap
from vipe_core.depth.upsampling import upsample
from vipe_core.errors import EngineError
from vipe_core.geometry.arrays import inverse
from vipe_core.slam.segmentation import segment
from vipe_core.video.source import Frame, FrameSource

Array = NDArray[Any]

# Weight of what bundle adjustment is sure of, beside 1 of a sure measurement; less sure is worth far less.
_HINT, _HINT_POWER = 0.003, 8
# Confidence of what is filled in right beside a measurement. It falls by a factor e over the first share of the width
# of the picture, and nothing is known after so many times that.
_FILL_CONFIDENCE = 0.05
_FILL_REACH, _LOST_REACH = 0.06, 4.0
# The sky is so much further than the far end of what is measured.
_SKY_QUANTILE, _SKY_SHARE = 0.01, 0.3
# No inverse depth is below the first or above the second, in units of the ends of its range.
_FAR_LIMIT, _NEAR_LIMIT = 0.05, 8.0
# Without parallax, the keyframes' values go out with this share of their own confidence.
_PRIOR_SHARE = 0.3
# Enlarging: grey levels that lower a weight by e, and the relative difference that is still the same surface.
_EDGE, _SAME = 6.0, 0.05


@dataclass(frozen=True, slots=True)
class _Picture:
    """A frame at half of the working size.

    Attributes:
        rgb: (h, w, 3) uint8.
        gray: (h, w) uint8.
        moving: (h, w) bool, what seems to move by itself or must not be used.
        unusable: (h, w) bool, the latter alone.
    """

    rgb: NDArray[np.uint8]
    gray: NDArray[np.uint8]
    moving: NDArray[np.bool_]
    unusable: NDArray[np.bool_]

    def around(self, seam: Seam) -> _Picture:
        moving, unusable = seam.around(self.moving), seam.around(self.unusable)
        return _Picture(seam.around(self.rgb), seam.around(self.gray), moving, unusable)


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
                    raws[t] = sweep.depth(
                        t, pictures[t].gray, {j: (pictures[j].gray, pictures[j].unusable) for j in chosen}, priors[t]
                    )
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
        settings, seam = self._settings, sweep.seam
        raw, picture = raws[index].around(seam), picture.around(seam)
        size = picture.gray.shape[::-1]
        prior_value = cv2.resize(seam.around(prior.inverse_depth), size, interpolation=cv2.INTER_LINEAR)
        prior_trust = cv2.resize(seam.around(prior.confidence), size, interpolation=cv2.INTER_LINEAR)
        if raw.measured:
            start, stop = scene.shot_of(index)
            others = [
                (inverse(scene.world_from_cam[j]) @ scene.world_from_cam[index], raws[j])
                for j in (index + sign * distance for distance in settings.check_frames for sign in (-1, 1))
                if start <= j < stop and raws[j].measured
            ]
            found = confirm(raw, others, sweep.fine, prior, picture.moving, settings)
            moving = found.moving | picture.unusable
            value, confidence, kind = self._completed(found, moving, picture, prior_value, prior_trust)
        else:
            moving = picture.moving
            value, confidence = prior_value, _PRIOR_SHARE * prior_trust
            kind = np.where(prior_trust > 0, FILLED, UNOBSERVED)
        kind = np.where(moving, MOVING, kind).astype(np.uint8)
        confidence = np.where(moving, 0, confidence).astype(np.float32)
        value = np.clip(value, _FAR_LIMIT * prior.low, _NEAR_LIMIT * prior.high).astype(np.float32)
        value, confidence, kind = seam.joined(value), seam.joined(confidence), seam.inside(kind)
        gray = seam.inside(picture.gray).astype(np.float32)
        full_gray = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY)
        depth, sure = upsample(value, confidence, gray, full_gray, _EDGE, _SAME, seam.closed)
        kind = np.asarray(cv2.resize(kind, full_gray.shape[::-1], interpolation=cv2.INTER_NEAREST), np.uint8)
        masked = kind == MOVING
        if frame.masked is not None:
            masked |= frame.masked
            kind[masked] = MOVING
        return DepthFrame(index, frame.rgb, depth, np.clip(sure, 0, 1), kind, masked)

    def _completed(
        self,
        found: Confirmed,
        moving: NDArray[np.bool_],
        picture: _Picture,
        prior_value: Array,
        prior_trust: Array,
    ) -> tuple[Array, NDArray[np.float32], NDArray[np.uint8]]:
        """Inverse depth of every pixel, how sure it is, and where it comes from."""
        settings = self._settings
        sky = find_sky(picture.rgb, found.inverse_depth, found.belief, moving)
        measured = (found.belief > 0) & ~sky
        # Where nothing is measured, what bundle adjustment found is a hint.
        unknown = found.weight == 0
        weight = np.where(unknown, np.where(moving, 0, _HINT * prior_trust**_HINT_POWER), found.weight)
        if not (weight[~sky] > 0).any():
            return prior_value, np.zeros_like(found.belief), np.full(sky.shape, UNOBSERVED, np.uint8)
        value = complete(
            np.where(unknown, prior_value, found.inverse_depth),
            weight,
            picture.rgb,
            sky,
            settings.fill_smoothness,
            settings.fill_edge,
            settings.fill_tolerance,
        )
        value = stand(value, moving, measured)
        # OpenCV's differs in the last bit with the number of its threads.
        away_px = distance_transform_edt(~measured)
        reach_px = _FILL_REACH * sky.shape[1]
        confidence = np.where(measured, found.belief, _FILL_CONFIDENCE * np.exp(-away_px / reach_px))
        kind = np.where(measured, MEASURED, np.where(away_px < _LOST_REACH * reach_px, FILLED, UNOBSERVED))
        if sky.any():
            value[sky] = _SKY_SHARE * np.quantile(found.inverse_depth[measured], _SKY_QUANTILE)
            confidence[sky], kind[sky] = _FILL_CONFIDENCE, SKY
        return value, confidence.astype(np.float32), kind.astype(np.uint8)


def _half(frame: Frame, scene: SceneMap) -> _Picture:
    height, width = frame.rgb.shape[0] // 2, frame.rgb.shape[1] // 2
    rgb = np.asarray(cv2.resize(frame.rgb, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
    unusable = np.zeros((height, width), np.bool_)
    if frame.masked is not None:
        unusable |= cv2.resize(frame.masked.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0
    moving = unusable.copy()
    if scene.labels is not None:
        grid = Grid(scene.camera.height // 8, scene.camera.width // 8)
        moving |= segment(rgb, scene.labels[frame.index], grid) > 0
    return _Picture(rgb, np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), np.uint8), moving, unusable)


def _next(frames: Iterator[Frame], index: int, num_frames: int) -> Frame:
    frame = next(frames, None)
    if frame is None:
        raise EngineError(f"the video gave {index} frames to the depth stage, but {num_frames} poses were found in it")
    return frame
