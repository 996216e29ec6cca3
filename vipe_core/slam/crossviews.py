"""Edges between the views of a rig, by what they see of one another (paper section 3.2.6).

Views of a stereo pair overlap at the same instant; those of a ring of cameras hardly do, but what one of them saw
another one sees later, when the rig has turned or gone on. So every keyframe is linked with the keyframe of another
view, of any instant, that sees most of its depth map, and with the one of its own instant that does.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from vipe_core.slam.measuring import MeasuredGraph
from vipe_core.slam.reprojection import Reprojector

_SUBSAMPLE = 3
# Least share of cells that both ends see, and least forward-backward consistency of those.
_MIN_OVERLAP = 0.25
_MIN_CONSISTENT = 0.3
# Of a long map, so many instants are looked at for every keyframe: the nearest in time, and a thinned choice of others.
_NEAR_INSTANTS = 8
_FAR_INSTANTS = 24


class CrossViews:
    """Adds cross-view edges to the graph of a rig; there is nothing to add to that of a single camera."""

    def __init__(self, measured: MeasuredGraph, reprojector: Reprojector) -> None:
        self._measured = measured
        self._keyframes = measured.keyframes
        self._reprojector = reprojector
        self._refused: set[tuple[int, int]] = set()

    def connect(self, keyframes: Iterable[int], oldest: int = 0) -> None:
        """Link keyframes with those of other views that overlap most with them.

        Args:
            oldest: First instant that is looked at.
        """
        views = self._keyframes.num_views
        if views < 2:
            return
        for k in keyframes:
            instant = self._keyframes.instant(k)
            others = [
                there * views + view
                for there in self._instants(instant, oldest)
                for view in range(views)
                if view != k % views
            ]
            if not others:
                continue
            there = self._reprojector.fan(self._keyframes, [k] * len(others), others, _SUBSAMPLE)
            back = self._reprojector.fan(self._keyframes, others, [k] * len(others), _SUBSAMPLE)
            overlap = np.minimum(there.overlap, back.overlap)
            now = np.array([self._keyframes.instant(other) == instant for other in others])
            for chosen in (now, ~now):
                seen = np.where(chosen, overlap, 0)
                best = int(np.argmax(seen))
                if seen[best] >= _MIN_OVERLAP:
                    self._link(*sorted((k, others[best])))

    def _instants(self, instant: int, oldest: int) -> list[int]:
        """The nearest ones, and others evenly over the rest."""
        count = len(self._keyframes) // self._keyframes.num_views
        near = range(max(oldest, instant - _NEAR_INSTANTS), min(count, instant + _NEAR_INSTANTS + 1))
        far = np.linspace(oldest, count - 1, min(count - oldest, _FAR_INSTANTS)).round().astype(int)
        return sorted({*near, *far.tolist()})

    def _link(self, i: int, j: int) -> None:
        """Measure a pair once; what cannot be matched is not tried again."""
        if (i, j) in self._measured.graph or (i, j) in self._refused:
            return
        if self._measured.connect(i, j, guided=True, min_consistent=_MIN_CONSISTENT) < _MIN_CONSISTENT:
            self._refused.add((i, j))
