"""Matching pairs of keyframes, dense and sparse, into the graph."""

from __future__ import annotations

from typing import Any

from vipe_core.priors.protocols import DenseMatcher, Match, SparseTracker
from vipe_core.slam.graph import Graph, fuse
from vipe_core.slam.keyframes import KeyframeMap
from vipe_core.slam.reprojection import Reprojector


class MeasuredGraph:
    """Matches pairs of keyframes, dense and sparse, and files both directions in the graph.

    Args:
        sparse: Gives the sparse term; None leaves it out.
        dense_flow: Whether the dense term is filed, or only guides the sparse one.
    """

    def __init__(
        self,
        keyframes: KeyframeMap,
        graph: Graph,
        matcher: DenseMatcher,
        sparse: SparseTracker | None,
        reprojector: Reprojector,
        *,
        dense_flow: bool = True,
    ) -> None:
        self.keyframes = keyframes
        self.graph = graph
        self._matcher = matcher
        self._sparse = sparse
        self._reprojector = reprojector
        self._dense_flow = dense_flow

    def connect(self, i: int, j: int, *, guided: bool, min_consistent: float = 0.0) -> float:
        """Measure i -> j and j -> i.

        Args:
            guided: Start the search where the current poses and depths of the map put it.
            min_consistent: A match with less forward-backward consistency is not filed.

        Returns:
            The smaller consistency of the two directions.
        """
        source, target = self.keyframes.features[i], self.keyframes.features[j]
        guess_px = None
        if guided:
            guess_px = self._reprojector.edge(self.keyframes, i, j).target_px
        there, back = self._matcher.match(source, target, guess_px)
        consistent = min(there.consistent, back.consistent)
        if consistent < min_consistent:
            return consistent
        self.graph.add(i, j, self._with_tracks(source, target, there))
        self.graph.add(j, i, self._with_tracks(target, source, back))
        return consistent

    def _with_tracks(self, source: Any, target: Any, dense: Match) -> Match:
        if self._sparse is None:
            return dense
        sparse = self._sparse.match(source, target, dense)
        return fuse(dense, sparse) if self._dense_flow else sparse
