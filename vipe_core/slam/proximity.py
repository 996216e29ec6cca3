"""Which keyframes see the same place: distances by induced displacement (paper section 3.1, co-visibility edges)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from vipe_core.slam.graph import Graph
from vipe_core.slam.keyframes import KeyframeMap
from vipe_core.slam.reprojection import Reprojector

_SUBSAMPLE = 4
# With more candidates than this, the nearest so many by a coarse look are examined: at about three rows and columns,
# in one direction, within so much of the limits.
_EXAMINED = 64
_COARSE_LINES = 3
_COARSE_SLACK = 2.0


@dataclass(frozen=True, slots=True)
class Pair:
    """Two keyframes that overlap: `target` is the older one."""

    source: int
    target: int
    motion_px: float


def close_pairs(
    reprojector: Reprojector,
    keyframes: KeyframeMap,
    sources: Iterable[int],
    targets: Sequence[int],
    max_motion_px: float,
    min_overlap: float,
) -> list[Pair]:
    """Pairs whose mean induced displacement, averaged over both directions, is at most `max_motion_px`.

    Args:
        min_overlap: Least share of cells that must land inside the other image, in both directions.

    Returns:
        Nearest first; ties in the order of the keyframes.
    """
    candidates = list(targets)
    pairs: list[Pair] = []
    if not candidates:
        return pairs
    for source in sources:
        older = [target for target in candidates if target < source]
        if not older:
            continue
        older = screened(reprojector, keyframes, source, older, max_motion_px, min_overlap)
        if not older:
            continue
        there = reprojector.fan(keyframes, [source] * len(older), older, _SUBSAMPLE)
        back = reprojector.fan(keyframes, older, [source] * len(older), _SUBSAMPLE)
        overlap = np.minimum(there.overlap, back.overlap)
        motion = 0.5 * (there.motion_px + back.motion_px)
        pairs += [
            Pair(source, target, float(motion[row]))
            for row, target in enumerate(older)
            if overlap[row] >= min_overlap and motion[row] <= max_motion_px
        ]
    return sorted(pairs, key=lambda pair: (pair.motion_px, pair.source, pair.target))


def screened(
    reprojector: Reprojector,
    keyframes: KeyframeMap,
    source: int,
    targets: Sequence[int],
    max_motion_px: float,
    min_overlap: float,
) -> list[int]:
    """The targets, or the `_EXAMINED` of them that look nearest from `source`, in their order: work stays bounded."""
    if len(targets) <= _EXAMINED:
        return list(targets)
    subsample = max(1, min(reprojector.grid.height, reprojector.grid.width) // _COARSE_LINES)
    fan = reprojector.fan(keyframes, [source] * len(targets), targets, subsample)
    possible = (fan.motion_px <= _COARSE_SLACK * max_motion_px) & (fan.overlap >= min_overlap / _COARSE_SLACK)
    rows = np.flatnonzero(possible)
    nearest = rows[np.argsort(fan.motion_px[rows], kind="stable")[:_EXAMINED]]
    return [targets[row] for row in np.sort(nearest)]


def loop_edges(pairs: Sequence[Pair], graph: Graph, limit: int, radius: int = 2, num_views: int = 1) -> list[Pair]:
    """The nearest `limit` pairs, none within `radius` steps of an edge of the graph or of another choice.

    Steps are instants of a rig of `num_views`; pairs of other views are no neighbours.
    """
    taken = set(graph)
    chosen: list[Pair] = []
    for pair in pairs:
        if len(chosen) >= limit:
            break
        near = any(
            (pair.source + num_views * di, pair.target + num_views * dj) in taken
            for di in range(-radius, radius + 1)
            for dj in range(-radius + abs(di), radius - abs(di) + 1)
        )
        if not near:
            chosen.append(pair)
            taken.add((pair.source, pair.target))
    return chosen
