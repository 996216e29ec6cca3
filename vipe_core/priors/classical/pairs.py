"""Pairs of frames between which the camera has moved enough, and where cells of one are seen in the other."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vipe_core.priors.classical.features import FlowFeatures, cell_centres_px
from vipe_core.priors.classical.flow import DisFlowMatcher
from vipe_core.priors.protocols import WorkingFrame

# Where motion stops growing before it reaches the wanted amount, a pair is still taken from this share on.
_ENOUGH_MOTION = 0.5
_STILL_GROWING = 1.15
_MIN_POINTS = 40


@dataclass(frozen=True, slots=True)
class FramePair:
    """Correspondences of two frames.

    Attributes:
        source, target: Positions in the sequence of frames.
        source_px, target_px: (n, 2) float64 index coordinates.
        consistent: Share of the cells that are matched consistently.
        motion_px: Median displacement between the frames.
    """

    source: int
    target: int
    source_px: NDArray[np.float64]
    target_px: NDArray[np.float64]
    consistent: float
    motion_px: float


class PairPicker:
    """Picks anchors and their partners itself and looks at no pair that the motion between them does not call for.

    Args:
        matcher: Dense matcher; one of fine flow if None.
        num_anchors: Frames that look for a partner.
        motion_ratio: Wanted median displacement to the partner, share of the image width.
        max_points: Upper bound of correspondences per pair.
    """

    def __init__(
        self,
        matcher: DisFlowMatcher | None = None,
        num_anchors: int = 10,
        motion_ratio: float = 30 / 640,
        max_points: int = 1500,
    ) -> None:
        self._matcher = matcher or DisFlowMatcher(fine=True)
        self._num_anchors = num_anchors
        self._motion_ratio = motion_ratio
        self._max_points = max_points

    def pairs(self, frames: Sequence[WorkingFrame]) -> list[FramePair]:
        """One pair for each anchor that found a partner with enough correspondences, in the order of their frames."""
        last = len(frames) - 1
        if last < 1:
            return []
        features: dict[int, FlowFeatures] = {}

        def at(position: int) -> FlowFeatures:
            if position not in features:
                features[position] = self._matcher.encode(frames[position])
            return features[position]

        anchors = np.unique(np.rint(np.linspace(0, last, self._num_anchors)).astype(int)).tolist()
        motions: dict[tuple[int, int], float] = {}
        for anchor in anchors:
            for direction in (1, -1):
                found = self._partner(at, anchor, direction, last)
                if found is not None:
                    motions.setdefault((min(anchor, found[0]), max(anchor, found[0])), found[1])
                    break
        matched = [self._matched(at(a), at(b), a, b, motion) for (a, b), motion in sorted(motions.items())]
        return [pair for pair in matched if pair is not None]

    def _partner(
        self, at: Callable[[int], FlowFeatures], anchor: int, direction: int, last: int
    ) -> tuple[int, float] | None:
        """The nearest frame in `direction` that has moved enough: doubling steps, then bisection."""
        source = at(anchor)
        wanted = self._motion_ratio * source.gray.shape[1]

        def motion(position: int) -> float:
            return self._matcher.motion_px(source, at(position))

        end = last if direction > 0 else 0
        low, moved_low, step = anchor, 0.0, 1
        while True:
            high = low + direction * step
            high = min(high, end) if direction > 0 else max(high, end)
            if high == low:
                return None
            reached = motion(high)
            if reached >= wanted:
                break
            if moved_low >= _ENOUGH_MOTION * wanted and reached < _STILL_GROWING * moved_low:
                # Motion no longer grows with time: the flow has lost the scene (or the camera turns back).
                return low, moved_low
            low, moved_low, step = high, reached, step * 2
        while abs(high - low) > 1:
            middle = (low + high) // 2
            moved = motion(middle)
            if moved >= wanted:
                high, reached = middle, moved
            else:
                low = middle
        return high, reached

    def _matched(
        self, source: FlowFeatures, target: FlowFeatures, source_at: int, target_at: int, motion_px: float
    ) -> FramePair | None:
        """Consistent, corner-like cells, spread evenly over the frame; None when too few."""
        forward, _ = self._matcher.match(source, target)
        structure = source.structure
        # Weight = agreement x structure; agreement of 0.3 is a forward-backward error of about 0.7 px.
        agreement = (forward.weight * (structure + source.structure_floor) / np.maximum(structure, 1e-9)).max(axis=1)
        corner = structure.min(axis=1)
        usable = source.usable_cells
        if not usable.any():
            return None
        bar = min(4.0, float(np.quantile(corner[usable], 0.6)))
        kept = np.flatnonzero((agreement > 0.3) & (corner >= bar))
        if len(kept) < _MIN_POINTS:
            return None
        if len(kept) > self._max_points:
            kept = kept[np.linspace(0, len(kept) - 1, self._max_points).astype(int)]
        centres = cell_centres_px(source.grid)[kept].astype(np.float64)
        seen = forward.target_px[kept].astype(np.float64)
        return FramePair(source_at, target_at, centres, seen, forward.consistent, motion_px)
