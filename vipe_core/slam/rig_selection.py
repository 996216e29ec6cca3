"""Keyframes of a rig: instants at which some view has moved far enough; all views of a chosen instant are keyframes."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vipe_core.priors.protocols import DenseMatcher, WorkingFrame
from vipe_core.slam.rig_frames import EncodedRig
from vipe_core.slam.selection import MAX_LOWERINGS, Keyframe, MotionFilter, Report, Thinned
from vipe_core.slam.settings import SlamSettings
from vipe_core.slam.working import WorkingSize


@dataclass(frozen=True, slots=True)
class RigSelection:
    """What the selection pass found.

    Attributes:
        timestamps_s: (N,) float64 presentation time of every instant.
        keyframes: At least one, in time order; the features are a tuple of the views'.
        max_motion_px: Largest displacement of any view against its keyframe, working pixels.
        blind: Views that show nothing, or stand still while others move: black, covered, frozen.
        placed: (N,) bool, False on instants at which no view shows anything.
        samples: For every view, evenly thinned frames.
    """

    timestamps_s: NDArray[np.float64]
    keyframes: list[Keyframe]
    max_motion_px: float
    blind: frozenset[int]
    placed: NDArray[np.bool_]
    samples: list[list[WorkingFrame]]


class _AnyView:
    """The motion of a rig is that of the view in which it is seen best.

    Attributes:
        largest_px: Of each view.
    """

    def __init__(self, matcher: DenseMatcher, num_views: int) -> None:
        self._matcher = matcher
        self.largest_px = [0.0] * num_views

    def motion_px(self, source: Sequence[Any], target: Sequence[Any]) -> float:
        moved = [self._matcher.motion_px(a, b) for a, b in zip(source, target, strict=True)]
        finite = [motion if np.isfinite(motion) else 0.0 for motion in moved]
        self.largest_px = [max(pair) for pair in zip(self.largest_px, finite, strict=True)]
        return max(finite)


def select_rig_keyframes(frames: EncodedRig, size: WorkingSize, settings: SlamSettings, report: Report) -> RigSelection:
    """Read the videos once, and again for each lowering of the threshold of a slow rig.

    A rig films without cuts; instants at which every view is blank are passed over.

    Args:
        frames: Before their first pass.

    Raises:
        EmptyMedia: The videos hold no frame.
        InputError, DecodeError: From the source.
    """
    matcher = frames.matcher
    thinned = [Thinned(settings.sample_frames) for _ in range(frames.num_views)]
    static_px = settings.scaled_px(settings.static_motion_px, size.width)
    keyframe_px = settings.scaled_px(settings.keyframe_motion_px, size.width)
    motion = _AnyView(matcher, frames.num_views)
    found = MotionFilter(motion, keyframe_px)
    first: Keyframe | None = None
    blank: set[int] = set()
    with closing(frames.first_pass()) as first_pass:
        for works, features in first_pass:
            index = works[0].index
            for sample, work in zip(thinned, works, strict=True):
                sample.add(work)
            first = first or Keyframe(index, features)
            if all(matcher.is_blank(one) for one in features):
                blank.add(index)
            else:
                found.add(Keyframe(index, features))
            report("scan", index + 1, frames.total_hint)
    found.finish()
    for _ in range(MAX_LOWERINGS):
        lower = found.lowered(settings.min_keyframes, static_px)
        if lower is None:
            break
        with closing(frames.again()) as again:
            for index, features in again:
                if index not in blank:
                    lower.add(Keyframe(index, features))
                report("scan", len(frames), len(frames))
        lower.finish()
        found = lower
    placed = np.ones(len(frames), dtype=np.bool_)
    placed[list(blank)] = False
    assert first is not None
    moves = max(motion.largest_px) >= keyframe_px
    still = (view for view, largest_px in enumerate(motion.largest_px) if largest_px < static_px)
    return RigSelection(
        np.array(frames.times_s, dtype=np.float64),
        found.keyframes or [first],
        found.max_motion_px,
        frozenset(still) if moves else frozenset(),
        placed,
        [sample.frames for sample in thinned],
    )
