"""Motion masks from geometry alone: cells for which no depth makes the views of them agree.

The paper masks by semantics; without a segmenter this is what several views can say. It finds what moves against
static surroundings that are the larger part of the picture. A thing that moves so that it looks like a static one at
another depth (steadily along with the camera) is no contradiction, and does no harm to the poses either.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vipe_core.geometry.arrays import relative
from vipe_core.slam.consensus import Agreement, agree
from vipe_core.slam.graph import Graph
from vipe_core.slam.keyframes import KeyframeMap
from vipe_core.slam.reprojection import Reprojector
from vipe_core.slam.segmentation import MOVING, STATIC, UNKNOWN

Array = NDArray[Any]

_MAX_MOVING = 0.6
_SURE_VOTES = 2
# What is further off than so many standard deviations of the measurements contradicts, but for a floor: a share of the
# robust scale below which errors of matching are no longer independent of one another.
_CONTRADICTION_SIGMA = 4.0
_MIN_CONTRADICTION = 1 / 3


class MotionMasks:
    """Keeps the `static` masks of a map.

    Args:
        robust_scale_px: A measurement further from the reprojection than this contradicts it in any case.
        enabled: Whether anything is masked at all.
    """

    def __init__(
        self,
        reprojector: Reprojector,
        keyframes: KeyframeMap,
        graph: Graph,
        robust_scale_px: float,
        *,
        enabled: bool = True,
    ) -> None:
        self._reprojector = reprojector
        self._keyframes = keyframes
        self._graph = graph
        self.robust_scale_px = robust_scale_px
        self._enabled = enabled

    def update(self, frames: Iterable[int]) -> float:
        """Refresh the masks of keyframes at the current poses; the largest share of cells that changed in one."""
        if not self._enabled:
            return 0.0
        found = {k: self.agreement(k, self._graph.targets(k)) for k in frames}
        threshold_px = self.contradiction_px([agreement for agreement in found.values() if agreement is not None])
        changed = 0.0
        for k, agreement in found.items():
            if agreement is None:
                continue
            static = ~self.moving(agreement, threshold_px)
            changed = max(changed, float(np.mean(static != self._keyframes.static(k))))
            self._keyframes.set_static(k, static)
        return changed

    def contradiction_px(self, agreements: Sequence[Agreement]) -> float:
        """The distance from which a measurement contradicts, from the scatter of those that agree."""
        errors = np.concatenate(
            [np.zeros(0, np.float32), *(a.error_px[a.error_px < self.robust_scale_px] for a in agreements)]
        )
        if not len(errors):
            return self.robust_scale_px
        sigma = float(np.median(errors)) / math.sqrt(2 * math.log(2))
        return float(
            np.clip(_CONTRADICTION_SIGMA * sigma, _MIN_CONTRADICTION * self.robust_scale_px, self.robust_scale_px)
        )

    def moving(self, found: Agreement, threshold_px: float) -> NDArray[np.bool_]:
        """(P,) bool, True on cells that move by themselves.

        A cell moves when not even its best depth explains more than half of the views that measure it.
        Specks are dropped, gaps filled, and the rest grows by a cell, because flow bleeds over borders. Should most of
        the measured picture disagree, the poses are wrong rather than the picture, and nothing is masked.
        """
        grid = self._keyframes.grid
        known = found.votes > 0
        moving = known & (2 * found.support(threshold_px) <= found.votes)
        if moving.sum() > _MAX_MOVING * max(1, int(known.sum())):
            return np.zeros(grid.num_cells, dtype=np.bool_)
        image = moving.reshape(grid.height, grid.width).astype(np.uint8)
        image = cv2.medianBlur(image, 3)
        image = cv2.dilate(image, np.ones((3, 3), np.uint8))
        return np.asarray(image, dtype=np.bool_).reshape(-1)

    def labels(self, k: int) -> NDArray[np.int8]:
        """(P,) what each cell of keyframe `k` does: `MOVING`, `STATIC`, or `UNKNOWN` with less than two views.

        Surer than the masks of the adjustment, which rather leave out too much: only a contradiction by the whole
        robust scale is motion.
        """
        grid = self._keyframes.grid
        found = self.agreement(k, self._graph.targets(k)) if self._enabled else None
        if found is None:
            return np.full(grid.num_cells, UNKNOWN, dtype=np.int8)
        support = found.support(self.robust_scale_px)
        moving = (found.votes >= _SURE_VOTES) & (2 * support <= found.votes)
        static = (support >= _SURE_VOTES) & ~moving
        if moving.sum() > _MAX_MOVING * max(1, int((moving | static).sum())):
            moving[:] = False
        labels = np.where(moving, MOVING, np.where(static, STATIC, UNKNOWN))
        return np.asarray(labels, dtype=np.int8)

    def reliable(self, k: int, new: int | None = None) -> NDArray[np.bool_]:
        """(P,) bool, static cells of keyframe `k` whose depth most of its views explain, leaving out the view `new`.

        A cell that no other view has seen carries a guess for a depth, and may move for all we know.
        """
        found = self.agreement(k, [j for j in self._graph.targets(k) if j != new]) if self._enabled else None
        static = self._keyframes.static(k)
        if found is None:
            return static
        return np.asarray(static & (2 * found.support(self.robust_scale_px) > found.votes))

    def targets(self, k: int) -> list[int]:
        """Where keyframe `k` has edges to."""
        return self._graph.targets(k)

    def agreement(self, k: int, targets: Iterable[int]) -> Agreement | None:
        """What the edges from keyframe `k` to placed keyframes `targets` agree on; None without an edge."""
        keyframes = self._keyframes
        measured = [j for j in targets if (k, j) in self._graph]
        if not measured:
            return None
        targets_from_source = relative(np.stack([keyframes.pose(j) for j in measured]), keyframes.pose(k))
        matches = [self._graph[k, j] for j in measured]
        return agree(
            self._reprojector,
            keyframes.intrinsics_at(k),
            targets_from_source,
            matches,
            self.robust_scale_px,
            keyframes.depth(k),
            [keyframes.intrinsics_at(j) for j in measured],
        )
