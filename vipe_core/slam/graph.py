"""The graph of measurements between keyframes.

It keeps what the matcher measured. Masks are applied when edges are read, and robust kernels inside the adjustment, so
that either can change without matching again.
"""

from __future__ import annotations

import bisect
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from vipe_core.ba.problem import Edges
from vipe_core.priors.protocols import Match
from vipe_core.slam.keyframes import KeyframeMap
from vipe_core.transfer import uploaded

Array = NDArray[Any]
_AGREE_PX = 2.0


def fuse(dense: Match, sparse: Match) -> Match:
    """One measurement per cell out of dense flow and splatted tracks (paper section 3.2, sparse constraint).

    The sum of two quadratic terms in the same reprojection is one term at their weighted mean, up to a constant, so the
    fused edge costs the adjustment no more than the dense one alone. Where the two disagree by more than
    `_AGREE_PX` they measure different surfaces, and the dense one, which has been checked forward and backward, stays.
    """
    apart = np.linalg.norm(sparse.target_px - dense.target_px, axis=1, keepdims=True) > _AGREE_PX
    measured = dense.weight.sum(axis=1, keepdims=True) > 0
    extra = np.where(apart & measured, np.float32(0), sparse.weight)
    weight = dense.weight + extra
    share = np.divide(extra, weight, out=np.zeros_like(weight), where=weight > 0)
    target_px = dense.target_px + share * (sparse.target_px - dense.target_px)
    return Match(target_px.astype(np.float32), weight.astype(np.float32), dense.consistent)


def sharpen(measured: Match, aligned: Match) -> Match:
    """`measured` with the alignments in their place where they are at least as sure.

    An alignment started from the geometry and flow that did not: where the two disagree by more than `_AGREE_PX`,
    something moves or is hidden, and flow stays to say so.
    """
    before, after = (np.maximum(match.weight[:, 0], match.weight[:, 1]) for match in (measured, aligned))
    away = np.square(aligned.target_px - measured.target_px)
    agrees = (away[:, 0] + away[:, 1] <= _AGREE_PX**2) | (before == 0)
    better = agrees & (after > before)
    return Match(
        np.where(better[:, None], aligned.target_px, measured.target_px),
        np.where(better[:, None], aligned.weight, measured.weight),
        measured.consistent,
    )


class Graph:
    """Directed measurements between numbered keyframes."""

    def __init__(self) -> None:
        self._matches: dict[tuple[int, int], Match] = {}
        self._targets: dict[int, list[int]] = {}

    def __len__(self) -> int:
        return len(self._matches)

    def __contains__(self, edge: tuple[int, int]) -> bool:
        return edge in self._matches

    def __getitem__(self, edge: tuple[int, int]) -> Match:
        return self._matches[edge]

    def add(self, source: int, target: int, match: Match) -> None:
        if (source, target) not in self._matches:
            bisect.insort(self._targets.setdefault(source, []), target)
        self._matches[source, target] = match

    def discard(self, source: int, target: int) -> None:
        """Forget an edge."""
        del self._matches[source, target]
        self._targets[source].remove(target)

    def targets(self, source: int) -> list[int]:
        """Where the edges out of `source` lead, in order."""
        return list(self._targets.get(source, ()))

    def __iter__(self) -> Iterator[tuple[int, int]]:
        """Edges in a fixed order: by source, then by target."""
        return ((i, j) for i in sorted(self._targets) for j in self._targets[i])

    def among(self, frames: Iterable[int]) -> list[tuple[int, int]]:
        """The edges with both ends in `frames`, in order."""
        inside = set(frames)
        return [(i, j) for i in sorted(inside) for j in self._targets.get(i, ()) if j in inside]

    def read(
        self, edges: list[tuple[int, int]], number: Mapping[int, int], keyframes: KeyframeMap, device: torch.device
    ) -> Edges:
        """`edges` for the solver, what they measured on a device, with the moving cells of the source masked out.

        Args:
            number: Keyframe number -> frame number of the problem.
        """
        cells = keyframes.grid.num_cells
        target_px = np.empty((len(edges), cells, 2), dtype=np.float32)
        weight = np.empty((len(edges), cells, 2), dtype=np.float32)
        for row, (i, j) in enumerate(edges):
            match = self._matches[i, j]
            target_px[row] = match.target_px
            np.multiply(match.weight, keyframes.static(i)[:, None], out=weight[row])
        return Edges(
            source=torch.tensor([number[i] for i, _ in edges], dtype=torch.int64),
            target=torch.tensor([number[j] for _, j in edges], dtype=torch.int64),
            target_px=uploaded(target_px, device),
            weight=uploaded(weight, device),
        )
