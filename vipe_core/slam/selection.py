"""Keyframe selection: one pass over the video that decides by motion (paper section 3.1, step 2).

The pass holds the keyframes' features and a bounded, evenly thinned sample of frames for the intrinsics
initialisation; everything else about a frame is forgotten but its time.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Generator
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vipe_core.errors import EmptyMedia
from vipe_core.priors.protocols import DenseMatcher, WorkingFrame
from vipe_core.slam.settings import SlamSettings
from vipe_core.slam.working import WorkingSize, working_frame
from vipe_core.video.source import FrameSource

logger = logging.getLogger(__name__)

Report = Callable[[str, int, int | None], None]
"""(stage, frames done, frames in total if known)"""

_MAX_LOWERINGS = 3


@dataclass(frozen=True, slots=True)
class Keyframe:
    """A selected frame: its index in the video and the matcher's features of it."""

    index: int
    features: Any


@dataclass(frozen=True, slots=True)
class Selection:
    """What the selection pass found.

    Attributes:
        timestamps_s: (N,) float64 presentation time of every frame.
        keyframes: At least one, in time order. The first frame that is not blank is one; blank ones are none, unless
            there is nothing else.
        sample: Evenly thinned frames, at most `SlamSettings.sample_frames`.
        max_motion_px: Largest displacement of any frame against its keyframe, working pixels.
    """

    timestamps_s: NDArray[np.float64]
    keyframes: list[Keyframe]
    sample: list[WorkingFrame]
    max_motion_px: float

    @property
    def num_frames(self) -> int:
        return len(self.timestamps_s)


class _Thinned:
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


class _MotionFilter:
    """Makes a frame a keyframe when the picture has moved by `threshold_px` since the last one.

    Blank frames (a fade from black, a flash) are passed over: any picture seems to stand still against them.
    """

    def __init__(self, matcher: DenseMatcher, threshold_px: float) -> None:
        self.matcher = matcher
        self.threshold_px = threshold_px
        self.keyframes: list[Keyframe] = []
        self.max_motion_px = 0.0
        self.total_motion_px = 0.0
        self._first_blank: Keyframe | None = None
        self._previous: Keyframe | None = None
        self._previous_motion_px = 0.0

    def add(self, frame: WorkingFrame) -> None:
        current = Keyframe(frame.index, self.matcher.encode(frame))
        if self.matcher.is_blank(current.features):
            self._first_blank = self._first_blank or current
            return
        if not self.keyframes:
            self.keyframes.append(current)
            return
        motion_px = self._motion_px(current)
        if motion_px > 2 * self.threshold_px and self._previous is not None:
            # A jump: the frame before it is a nearer stepping stone than the last keyframe.
            self._take(self._previous, self._previous_motion_px)
            motion_px = self._motion_px(current)
        self.max_motion_px = max(self.max_motion_px, motion_px)
        if motion_px > self.threshold_px:
            self._take(current, motion_px)
        else:
            self._previous, self._previous_motion_px = current, motion_px

    def finish(self) -> None:
        """Consider the last frame: a keyframe when it adds a visible part of a step, so that nothing hangs over."""
        if not self.keyframes and self._first_blank is not None:
            self.keyframes.append(self._first_blank)
        if self._previous is not None:
            if self._previous_motion_px > 0.25 * self.threshold_px:
                self._take(self._previous, self._previous_motion_px)
            else:
                self.total_motion_px += self._previous_motion_px

    def _take(self, keyframe: Keyframe, motion_px: float) -> None:
        self.keyframes.append(keyframe)
        self.total_motion_px += motion_px
        self._previous, self._previous_motion_px = None, 0.0

    def _motion_px(self, current: Keyframe) -> float:
        motion_px = self.matcher.motion_px(self.keyframes[-1].features, current.features)
        return motion_px if math.isfinite(motion_px) else 0.0


def select_keyframes(
    source: FrameSource, size: WorkingSize, matcher: DenseMatcher, settings: SlamSettings, report: Report
) -> Selection:
    """Decode the video once (again for each lowering of the threshold of a slow clip) and choose keyframes.

    Raises:
        EmptyMedia: The video holds no frame.
        InputError, DecodeError: From the source.
    """
    times: list[float] = []
    thinned = _Thinned(settings.sample_frames)
    threshold_px = settings.scaled_px(settings.keyframe_motion_px, size.width)
    static_px = settings.scaled_px(settings.static_motion_px, size.width)

    def first_pass() -> Generator[WorkingFrame, None, None]:
        with closing(source.frames(size.size)) as frames:
            for frame in frames:
                work = working_frame(frame)
                times.append(frame.timestamp_s)
                thinned.add(work)
                yield work
                report("scan", len(times), source.info.num_frames_hint)

    def again() -> Generator[WorkingFrame, None, None]:
        if thinned.spacing == 1:
            yield from thinned.frames
            return
        with closing(source.frames(size.size, stop=len(times))) as frames:
            for frame in frames:
                yield working_frame(frame)
                # No progress, but the chance to cancel and the sign of life that a supervisor waits for.
                report("scan", len(times), len(times))

    motion = _filter(first_pass(), matcher, threshold_px)
    if not times:
        raise EmptyMedia(f"{source.info.name}: the video holds no frame; check the recording")
    for _ in range(_MAX_LOWERINGS):
        enough = len(motion.keyframes) >= min(settings.min_keyframes, len(times))
        if enough or motion.max_motion_px < static_px:
            break
        threshold_px = max(
            0.5 * static_px, min(0.6 * threshold_px, motion.total_motion_px / (settings.min_keyframes + 2))
        )
        logger.debug("%d keyframes are few: threshold lowered to %.2f px", len(motion.keyframes), threshold_px)
        motion = _filter(again(), matcher, threshold_px)
    return Selection(np.array(times, dtype=np.float64), motion.keyframes, thinned.frames, motion.max_motion_px)


def _filter(stream: Generator[WorkingFrame, None, None], matcher: DenseMatcher, threshold_px: float) -> _MotionFilter:
    motion = _MotionFilter(matcher, threshold_px)
    # Closed here and not whenever an exception's traceback lets go of it: a decoder process is behind it.
    with closing(stream) as frames:
        for frame in frames:
            motion.add(frame)
    motion.finish()
    return motion
