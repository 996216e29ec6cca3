"""Keyframe selection: one pass over the video that decides by motion (paper section 3.1, step 2), shot by shot.

The pass holds the keyframes' features and a bounded, evenly thinned sample of frames for the intrinsics
initialisation; everything else about a frame is forgotten but its time, unless the clip is short enough to be kept.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from vipe_core.priors.protocols import DenseMatcher, WorkingFrame
from vipe_core.slam.frames import EncodedFrames
from vipe_core.slam.settings import SlamSettings
from vipe_core.slam.shots import Picture, Placed, ShotSplitter
from vipe_core.slam.working import WorkingSize

logger = logging.getLogger(__name__)

Report = Callable[[str, int, int | None], None]
"""(stage, frames done, frames in total if known)"""

MAX_LOWERINGS = 3


@dataclass(frozen=True, slots=True)
class Keyframe:
    """A selected frame: its index in the video and the matcher's features of it."""

    index: int
    features: Any


@dataclass(frozen=True, slots=True)
class Shot:
    """Frames [start, stop) between two cuts.

    Attributes:
        keyframes: At least one, in time order. The first frame that is not blank is one; blank ones are none, unless
            there is nothing else.
        max_motion_px: Largest displacement of any frame against its keyframe, working pixels.
    """

    start: int
    stop: int
    keyframes: list[Keyframe]
    max_motion_px: float


@dataclass(frozen=True, slots=True)
class Selection:
    """What the selection pass found.

    Attributes:
        timestamps_s: (N,) float64 presentation time of every frame.
        shots: At least one, in time order; together they are the whole video.
        placed: (N,) bool, False on frames that belong to no shot: blank ones, flashes, torn ones.
        sample: Evenly thinned frames, at most `SlamSettings.sample_frames`.
    """

    timestamps_s: NDArray[np.float64]
    shots: list[Shot]
    placed: NDArray[np.bool_]
    sample: list[WorkingFrame]

    @property
    def num_frames(self) -> int:
        return len(self.timestamps_s)


class Thinned:
    """At most `capacity` frames at even spacing of a stream of unknown length: the spacing doubles when it is full."""

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self.spacing = 1
        self.frames: list[WorkingFrame] = []

    def add(self, frame: WorkingFrame) -> None:
        if frame.index % self.spacing:
            return
        if len(self.frames) == self.capacity:
            self.spacing *= 2
            self.frames = self.frames[::2]
            if frame.index % self.spacing:
                return
        self.frames.append(frame)


class Motion(Protocol):
    """How far the picture moved; part of `DenseMatcher`."""

    def motion_px(self, source: Any, target: Any) -> float:
        """Median displacement, pixels."""


class MotionFilter:
    """Makes a frame a keyframe when the picture has moved by `threshold_px` since the last one.

    Attributes:
        max_motion_px: Largest displacement of a frame against the keyframe before it.
        path_px: All that the displacement went up and down.
    """

    def __init__(self, matcher: Motion, threshold_px: float) -> None:
        self.matcher = matcher
        self.threshold_px = threshold_px
        self.num_frames = 0
        self.keyframes: list[Keyframe] = []
        self.max_motion_px = 0.0
        self.path_px = 0.0
        self._previous: Keyframe | None = None
        self._previous_motion_px = 0.0

    def add(self, current: Keyframe) -> None:
        self.num_frames += 1
        if not self.keyframes:
            self.keyframes.append(current)
            return
        motion_px = self._motion_px(current)
        if motion_px > 2 * self.threshold_px and self._previous is not None:
            # A jump: the frame before it is a nearer stepping stone than the last keyframe.
            self._take(self._previous)
            motion_px = self._motion_px(current)
        self.max_motion_px = max(self.max_motion_px, motion_px)
        self.path_px += abs(motion_px - self._previous_motion_px)
        if motion_px > self.threshold_px:
            self._take(current)
        else:
            self._previous, self._previous_motion_px = current, motion_px

    def finish(self) -> None:
        """Consider the last frame: a keyframe when it adds a visible part of a step, so that nothing hangs over."""
        if self._previous is not None and self._previous_motion_px > 0.25 * self.threshold_px:
            self._take(self._previous)

    def lowered(self, min_keyframes: int, static_px: float) -> MotionFilter | None:
        """A filter with a lower threshold for the same shot; None when this one has found enough or nothing moves.

        The path counts all motion, towards the last keyframe too: what returns would look slow by its net motion, and
        get a keyframe at every frame.
        """
        if len(self.keyframes) >= min(min_keyframes, self.num_frames) or self.max_motion_px < static_px:
            return None
        largest_px = min(self.threshold_px, self.max_motion_px)
        lower_px = max(0.5 * static_px, min(0.6 * largest_px, self.path_px / (min_keyframes + 2)))
        logger.debug("%d keyframes are few: threshold lowered to %.2f px", len(self.keyframes), lower_px)
        return MotionFilter(self.matcher, lower_px)

    def _take(self, keyframe: Keyframe) -> None:
        self.keyframes.append(keyframe)
        self._previous, self._previous_motion_px = None, 0.0

    def _motion_px(self, current: Keyframe) -> float:
        motion_px = self.matcher.motion_px(self.keyframes[-1].features, current.features)
        return motion_px if math.isfinite(motion_px) else 0.0


class _Pass:
    """One motion filter per shot, and which frame goes to which."""

    def __init__(self, matcher: DenseMatcher, threshold_px: float) -> None:
        self._matcher = matcher
        self._threshold_px = threshold_px
        self.filters: list[MotionFilter] = []
        self.cuts: list[int] = []
        self.shot_of: dict[int, int] = {}

    @property
    def num_keyframes(self) -> int:
        return sum(len(motion.keyframes) for motion in self.filters)

    def place(self, placed: list[Placed]) -> None:
        for one in placed:
            picture = one.picture
            if one.cut:
                self.cuts.append(picture.index)
            if one.cut or not self.filters:
                self.filters.append(MotionFilter(self._matcher, self._threshold_px))
            self.shot_of[picture.index] = len(self.filters) - 1
            self.filters[-1].add(Keyframe(picture.index, picture.features))


def select_keyframes(
    frames: EncodedFrames,
    size: WorkingSize,
    settings: SlamSettings,
    report: Report,
    counted: Callable[[int], object] | None = None,
) -> Selection:
    """Read the video once (again for each lowering of the threshold of slow shots), find its cuts, choose keyframes.

    Blank frames (a fade from black) and single ones that belong to nothing (a flash) are passed over: any picture
    seems to stand still against them.

    Args:
        frames: Before their first pass.
        counted: Told the number of keyframes while it grows; what it raises ends the selection.

    Raises:
        EmptyMedia: The video holds no frame.
        InputError, DecodeError: From the source.
    """
    matcher = frames.matcher
    thinned = Thinned(settings.sample_frames)
    static_px = settings.scaled_px(settings.static_motion_px, size.width)
    splitter = ShotSplitter(matcher)
    found = _Pass(matcher, settings.scaled_px(settings.keyframe_motion_px, size.width))
    first_blank: Keyframe | None = None
    # Closed here and not whenever an exception's traceback lets go of it: a decoder process is behind it.
    with closing(frames.first_pass()) as first_pass:
        for frame, features in first_pass:
            thinned.add(frame)
            if matcher.is_blank(features):
                first_blank = first_blank or Keyframe(frame.index, features)
            else:
                found.place(splitter.add(Picture.of(frame, features)))
                if counted is not None:
                    counted(found.num_keyframes)
            report("scan", frame.index + 1, frames.total_hint)
    found.place(splitter.finish())
    for motion in found.filters:
        motion.finish()
    for _ in range(MAX_LOWERINGS):
        lowered = [motion.lowered(settings.min_keyframes, static_px) for motion in found.filters]
        if not any(lowered):
            break
        with closing(frames.again()) as again:
            for index, features in again:
                lower = lowered[found.shot_of[index]] if index in found.shot_of else None
                if lower is not None:
                    lower.add(Keyframe(index, features))
                # No progress, but the chance to cancel and the sign of life that a supervisor waits for.
                report("scan", len(frames), len(frames))
        for number, lower in enumerate(lowered):
            if lower is not None:
                lower.finish()
                found.filters[number] = lower
    count = len(frames)
    if not found.filters:
        assert first_blank is not None
        shots = [Shot(0, count, [first_blank], 0.0)]
    else:
        starts = [0, *found.cuts]
        shots = [
            Shot(start, stop, motion.keyframes, motion.max_motion_px)
            for start, stop, motion in zip(starts, [*found.cuts, count], found.filters, strict=True)
        ]
    placed = np.zeros(count, dtype=np.bool_)
    placed[list(found.shot_of)] = True
    return Selection(np.array(frames.times_s, dtype=np.float64), shots, placed, thinned.frames)
