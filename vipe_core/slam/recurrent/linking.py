"""Which keyframes are linked: by time, and by how little the picture moves between them (paper section 3.1, step 3)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vipe_core.geometry.arrays import relative
from vipe_core.slam.keyframes import KeyframeMap
from vipe_core.slam.proximity import screened
from vipe_core.slam.recurrent.settings import RefinementSettings
from vipe_core.slam.reprojection import Reprojector

Array = NDArray[Any]

_SUBSAMPLE = 4
_BATCH_PAIRS = 256


@dataclass(frozen=True, slots=True)
class Reach:
    """How far links go.

    Attributes:
        neighbours: Keyframes before that each is linked with in any case.
        max_px: Farthest pair otherwise, working pixels.
        gap: Links are at least this many steps apart.
        max_edges: Most directed edges.
    """

    neighbours: int
    max_px: float
    gap: int
    max_edges: int


def distances(
    reprojector: Reprojector,
    keyframes: KeyframeMap,
    pairs: Sequence[tuple[int, int]],
    settings: RefinementSettings,
) -> NDArray[np.float64]:
    """(n,) mean displacement of the cells of both ends, pixels: of all motion, and of what translation alone makes.

    Infinite where too few cells are in front of the other camera.
    """
    grid = reprojector.grid
    step = max(1, min(_SUBSAMPLE, grid.height // 2, grid.width // 2))
    rows, columns = np.arange(step // 2, grid.height, step), np.arange(step // 2, grid.width, step)
    cells = (rows[:, None] * grid.width + columns).reshape(-1)
    there, back = (
        _one_way(reprojector, keyframes, ends, cells, settings) for ends in (pairs, [(j, i) for i, j in pairs])
    )
    return 0.5 * (there + back)


def _one_way(
    reprojector: Reprojector,
    keyframes: KeyframeMap,
    pairs: Sequence[tuple[int, int]],
    cells: NDArray[np.int64],
    settings: RefinementSettings,
) -> NDArray[np.float64]:
    found = np.empty(len(pairs))
    for start in range(0, len(pairs), _BATCH_PAIRS):
        some = pairs[start : start + _BATCH_PAIRS]
        target_from_source = relative(
            np.stack([keyframes.pose(j) for _, j in some]), np.stack([keyframes.pose(i) for i, _ in some])
        )
        shifted = target_from_source.copy()
        shifted[:, :3, :3] = np.eye(3)
        depth = np.stack([keyframes.depth(i)[cells] for i, _ in some])
        whole, shift = (
            reprojector.induced(keyframes.intrinsics, pose, depth, cells).displacement_px
            for pose in (target_from_source, shifted)
        )
        mixed = settings.rotation_share * whole + (1 - settings.rotation_share) * shift
        seen = np.isfinite(mixed)
        mean = np.where(seen, mixed, 0).sum(axis=1, dtype=np.float64) / np.maximum(seen.sum(axis=1), 1)
        found[start : start + len(some)] = np.where(seen.mean(axis=1) >= settings.least_seen, mean, np.inf)
    return found


def links(
    reprojector: Reprojector,
    keyframes: KeyframeMap,
    sources: Iterable[int],
    targets: Iterable[int],
    known: Iterable[tuple[int, int]],
    reach: Reach,
    settings: RefinementSettings,
) -> list[tuple[int, int]]:
    """New directed edges, both ways, between `sources` and older `targets`: neighbours first, then the nearest pairs.

    Args:
        known: Edges that exist, active or not: they are not repeated, and keep others at a distance.
    """
    sources, older = sorted(sources), sorted(targets)
    taken = set(known)
    chosen: list[tuple[int, int]] = []
    suppressed: set[tuple[int, int]] = set()

    def take(i: int, j: int) -> None:
        for edge in ((i, j), (j, i)):
            if edge not in taken:
                taken.add(edge)
                chosen.append(edge)
        suppressed.update(_around(i, j, reach.gap))

    for i, j in list(taken):
        suppressed.update(_around(max(i, j), min(i, j), reach.gap))
    for i in sources:
        for j in range(max(i - reach.neighbours, 0), i):
            take(i, j)
    candidates: list[tuple[int, int]] = []
    for i in sources:
        before = [j for j in older if j < i - reach.neighbours and (i, j) not in suppressed]
        candidates += [(i, j) for j in screened(reprojector, keyframes, i, before, reach.max_px, 0.5)]
    if not candidates:
        return chosen
    apart = distances(reprojector, keyframes, candidates, settings)
    for row in np.argsort(apart, kind="stable"):
        if apart[row] > reach.max_px or len(chosen) >= reach.max_edges:
            break
        if candidates[row] not in suppressed:
            take(*candidates[row])
    return chosen


def _around(i: int, j: int, gap: int) -> list[tuple[int, int]]:
    """Pairs that say about the same as i, j: the more of them the farther apart the two are, up to a gap."""
    reach = max(min(abs(i - j) - 2, gap), 0)
    return [(i + di, j + dj) for di in range(-reach, reach + 1) for dj in range(-reach + abs(di), reach - abs(di) + 1)]
