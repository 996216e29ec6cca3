"""Matching pairs of keyframes, dense and sparse, into the graph."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from vipe_core.priors.protocols import Aligner, Correspondences, DenseMatcher, Match, PointMatcher, SparseTracker
from vipe_core.slam.graph import Graph, fuse, sharpen
from vipe_core.slam.guessing import displacement_guess
from vipe_core.slam.keyframes import KeyframeMap
from vipe_core.slam.reprojection import Reprojector

# A pair with less forward-backward consistency than this may have been matched from the wrong start.
_SURE = 0.25
_MIN_POINTS = 20
# A step to the previous keyframe that is matched with less consistency than this is wide.
_WIDE_STEP = 0.7


class MeasuredGraph:
    """Matches pairs of keyframes, dense and sparse, and files both directions in the graph.

    Args:
        sparse: Gives the sparse term; None leaves it out.
        dense_flow: Whether the dense term is filed, or only guides the sparse one.
        aligner: Sharpens the dense term once the geometry is known; None leaves it as it is.
        blind: Views of a rig that are not measured.
    """

    def __init__(
        self,
        keyframes: KeyframeMap,
        graph: Graph,
        matcher: DenseMatcher,
        sparse: SparseTracker | None,
        points: PointMatcher | None,
        reprojector: Reprojector,
        *,
        dense_flow: bool = True,
        aligner: Aligner | None = None,
        blind: frozenset[int] = frozenset(),
    ) -> None:
        self.blind = blind
        self.keyframes = keyframes
        self.graph = graph
        self._matcher = matcher
        self._sparse = sparse
        self._points = points
        self._reprojector = reprojector
        self._dense_flow = dense_flow
        self._aligner = aligner if dense_flow else None

    def of(self, keyframes: KeyframeMap, graph: Graph) -> MeasuredGraph:
        """The same way of measuring for another map, of one view."""
        return MeasuredGraph(
            keyframes,
            graph,
            self._matcher,
            self._sparse,
            self._points,
            self._reprojector,
            dense_flow=self._dense_flow,
            aligner=self._aligner,
        )

    def overview(self, k: int) -> NDArray[np.float32]:
        """(n, D) descriptors by which the place of a keyframe is recognised; none without a matcher of points."""
        if self._points is None:
            return np.zeros((0, 1), np.float32)
        return self._points.overview(self.keyframes.features[k])

    def connect(self, i: int, j: int, *, guided: bool, min_consistent: float = 0.0) -> float:
        """Measure i -> j and j -> i.

        Where the match contradicts itself, the step may be too wide for its start: it is tried once more from sparse
        correspondences, and the one that measures more is taken.

        Args:
            guided: Start the search where the current poses and depths of the map put it.
            min_consistent: A match with less forward-backward consistency is not filed.

        Returns:
            The smaller consistency of the two directions; 0 where one end is blind.
        """
        if self._blind(i, j):
            return 0.0
        source, target = self.keyframes.features[i], self.keyframes.features[j]
        guess_px = None
        if guided:
            guess_px = self._reprojector.edge(self.keyframes, i, j).target_px
        there, back = self._matcher.match(source, target, guess_px)
        if min(there.consistent, back.consistent) < _SURE:
            points = self._correspond(i, j)
            if len(points) >= _MIN_POINTS:
                again = self._matcher.match(source, target, displacement_guess(points, self.keyframes.grid))
                if _measured(*again) > _measured(there, back):
                    there, back = again
        return self._file(i, j, there, back, min_consistent)

    def reach(self, consistent: float, neighbours: int) -> int:
        """How many keyframes back to link one whose step from the previous one was matched with this consistency.

        Across wide steps a point is seen in few keyframes: a link further back helps to hand on the scale.
        """
        return neighbours + (consistent < _WIDE_STEP)

    def connect_by_points(self, i: int, j: int, min_consistent: float) -> float:
        """Measure i -> j and j -> i wherever the cameras are, from sparse correspondences; 0 when there are too few."""
        if self._blind(i, j):
            return 0.0
        points = self._correspond(i, j)
        if len(points) < _MIN_POINTS:
            return 0.0
        source, target = self.keyframes.features[i], self.keyframes.features[j]
        there, back = self._matcher.match(source, target, displacement_guess(points, self.keyframes.grid))
        return self._file(i, j, there, back, min_consistent)

    def _blind(self, i: int, j: int) -> bool:
        views = self.keyframes.num_views
        return i % views in self.blind or j % views in self.blind

    def _correspond(self, i: int, j: int) -> Correspondences:
        if self._points is None:
            return Correspondences.none()
        return self._points.correspond(self.keyframes.features[i], self.keyframes.features[j])

    def _file(self, i: int, j: int, there: Match, back: Match, min_consistent: float) -> float:
        """Add tracks to a dense match and put it into the graph, if it is consistent enough."""
        consistent = min(there.consistent, back.consistent)
        if consistent < min_consistent:
            return consistent
        source, target = self.keyframes.features[i], self.keyframes.features[j]
        self.graph.add(i, j, self._with_tracks(source, target, there))
        self.graph.add(j, i, self._with_tracks(target, source, back))
        return consistent

    @property
    def can_sharpen(self) -> bool:
        return self._aligner is not None

    def sharpen(self, i: int, j: int, min_aligned: float, every: int = 1) -> None:
        """Measure the static cells of i -> j once more, from where the poses and depths of the map put them.

        Args:
            min_aligned: A new edge is filed only if at least this share of its cells is aligned.
            every: Measure each `every`-th cell only, those of the next row shifted by one.
        """
        assert self._aligner is not None
        induced = self._reprojector.edge(self.keyframes, i, j)
        guess_px = np.where(induced.visible[:, None], induced.target_px, np.float32(np.nan))
        row, column = np.divmod(np.arange(self.keyframes.grid.num_cells), self.keyframes.grid.width)
        wanted = self.keyframes.static(i) & ((row + column) % every == 0)
        aligned = self._aligner.align(self.keyframes.features[i], self.keyframes.features[j], guess_px, wanted)
        if (i, j) in self.graph:
            self.graph.add(i, j, sharpen(self.graph[i, j], aligned))
        elif aligned.consistent >= min_aligned:
            self.graph.add(i, j, aligned)

    def _with_tracks(self, source: Any, target: Any, dense: Match) -> Match:
        if self._sparse is None:
            return dense
        sparse = self._sparse.match(source, target, dense)
        return fuse(dense, sparse) if self._dense_flow else sparse


def _measured(there: Match, back: Match) -> float:
    """How much two directions measure together."""
    return float(np.sum(there.weight, dtype=np.float64) + np.sum(back.weight, dtype=np.float64))
