"""From the twists of edges to the poses of frames: assembly and damping of the sparse reduced system.

With tau = delta_j - Ad(T) delta_i of edge i -> j, a quadratic form in the twists becomes one in the poses by products
with -Ad(T) on the side of the source. Poses are named by their column in the structure (`block_cholesky.py`); -1 is a
fixed one, whose blocks are dropped. Only blocks on and below the diagonal are stored. All float64.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vipe_core.ba.rules import MIN_CURVATURE
from vipe_core.compilation import vectorised

Array = NDArray[Any]


@vectorised
def _slot(first: Array, rows: Array, row: int, column: int) -> int:
    """Index of block (row, column), row >= column, which must be part of the structure."""
    low, high = first[column], first[column + 1] - 1
    while low < high:
        middle = (low + high) // 2
        if rows[middle] < row:
            low = middle + 1
        else:
            high = middle
    return int(low)


@vectorised
def _add(first: Array, rows: Array, i: int, j: int, local: Array, a0: int, b0: int, height: int, blocks: Array) -> None:
    """Add local[a0 : a0 + height, b0 : b0 + 6] to the block of row i and column j, or its transpose to (j, i)."""
    if i < 0 or j < 0:
        return
    if i >= j:
        block = blocks[_slot(first, rows, i, j)]
        for a in range(height):
            for b in range(6):
                block[a, b] += local[a0 + a, b0 + b]
    else:
        block = blocks[_slot(first, rows, j, i)]
        for a in range(height):
            for b in range(6):
                block[b, a] += local[a0 + a, b0 + b]


@vectorised
def add_twists(
    first: Array,
    rows: Array,
    group: Array,
    source: Array,
    target: Array,
    cameras: Array,
    adjoint: Array,
    offset: Array,
    matrices: Array,
    blocks: Array,
    gradient: Array,
) -> None:
    """Add quadratic forms in the twists of groups of edges with a common source.

    Args:
        first, rows: The structure.
        group: (G + 1,) where the groups begin among the edges.
        source, target: (E,) columns of the poses.
        cameras: (G, T) columns of the intrinsics that the T rows of the tail are of, -1 where held.
        adjoint: (E, 6, 6).
        offset: (G + 1,) where the groups begin in `matrices`.
        matrices: Flat; per group of D edges nothing, or (6 D + 3 T)^2 numbers whose lower 3x3 blocks hold the rows of
            the D twists, then log f, alpha and one more T times, the first of which is the right-hand side.
        blocks: (B, 6, 6), added to.
        gradient: (nodes, 6), added to.
    """
    most = 0
    for g in range(len(group) - 1):
        most = max(most, group[g + 1] - group[g])
    # Rows of the source, of the twists, of the tail.
    tail = cameras.shape[1]
    local = np.empty((6 * most + 6 + 3 * tail, 6 * most + 6 + 3 * tail))
    for g in range(len(group) - 1):
        begin, degree, base = group[g], group[g + 1] - group[g], offset[g]
        if base == offset[g + 1] or degree == 0:
            continue
        size = 6 * degree + 3 * tail
        for a in range(size):
            for b in range(a + 1):
                local[6 + a, 6 + b] = matrices[base + a * size + b]
                local[6 + b, 6 + a] = local[6 + a, 6 + b]
        for a in range(6):
            for b in range(size + 6):
                local[a, b] = 0.0
        for m in range(degree):
            for k in range(6):
                for a in range(6):
                    x = adjoint[begin + m, k, a]
                    for b in range(6, size + 6):
                        local[a, b] -= x * local[6 + 6 * m + k, b]
        for m in range(degree):
            for a in range(6):
                for k in range(6):
                    x = local[a, 6 + 6 * m + k]
                    for b in range(6):
                        local[a, b] -= x * adjoint[begin + m, k, b]
        for a in range(6):
            for b in range(6, size + 6):
                local[b, a] = local[a, b]

        i, end = source[begin], 6 + 6 * degree
        right = end + 2
        _add(first, rows, i, i, local, 0, 0, 6, blocks)
        for m in range(degree):
            j, at = target[begin + m], 6 + 6 * m
            _add(first, rows, j, i, local, at, 0, 6, blocks)
            for other in range(m + 1):
                k = target[begin + other]
                _add(first, rows, j, k, local, at, 6 + 6 * other, 6, blocks)
                if j == k and m != other:
                    _add(first, rows, j, k, local, 6 + 6 * other, at, 6, blocks)
            for t in range(tail):
                _add(first, rows, cameras[g, t], j, local, end + 3 * t, at, 2, blocks)
            if j >= 0:
                for a in range(6):
                    gradient[j, a] += local[right, at + a]
        if i >= 0:
            for a in range(6):
                gradient[i, a] += local[right, a]
        for t in range(tail):
            camera, at = cameras[g, t], end + 3 * t
            if camera < 0:
                continue
            _add(first, rows, camera, i, local, at, 0, 2, blocks)
            for a in range(2):
                gradient[camera, a] += local[right, at + a]
            for other in range(tail):
                # Every pair is met twice: of one camera both count, of two the one below the diagonal.
                k, beside = cameras[g, other], end + 3 * other
                if 0 <= k <= camera:
                    block = blocks[_slot(first, rows, camera, k)]
                    for a in range(2):
                        for b in range(2):
                            block[a, b] += local[at + a, beside + b]


@vectorised
def _add_one(first: Array, rows: Array, i: int, j: int, local: Array, blocks: Array) -> None:
    """Add a block (i, j) of a symmetric matrix with its mirror image (j, i), of which the lower one is stored."""
    if i < 0 or j < 0:
        return
    _add(first, rows, i, j, local, 0, 0, 6, blocks)
    if i == j:
        block = blocks[_slot(first, rows, i, i)]
        for a in range(6):
            for b in range(6):
                block[a, b] += local[b, a]


@vectorised
def add_frames(
    first: Array,
    rows: Array,
    blocks: Array,
    gradient: Array,
    turn: Array,
    pose: Array,
    view: Array,
    into_first: Array,
    into_rows: Array,
    into: Array,
    into_gradient: Array,
) -> None:
    """Take a system in the twists of frames to one in the poses and extrinsics of a rig, see `rigs.py`.

    Args:
        first, rows, blocks, gradient: The system of F frames, and one node more for each camera with free intrinsics.
        turn: (N, 6, 6) maps from twists of poses to those of frames.
        pose: (nodes,) columns of the poses in the other structure; -1 where held, and for the intrinsics.
        view: (nodes,) those of the extrinsics, and of the intrinsics.
        into_first, into_rows, into, into_gradient: That structure, added to.
    """
    left, right, both = np.empty((6, 6)), np.empty((6, 6)), np.empty((6, 6))
    for k in range(len(first) - 1):
        for p in range(first[k], first[k + 1]):
            f, block = rows[p], blocks[p]
            # left = turn_f^T block, right = block turn_k, both = turn_f^T block turn_k.
            for a in range(6):
                for b in range(6):
                    left[a, b] = right[a, b] = both[a, b] = 0.0
            if pose[f] >= 0:
                for c in range(6):
                    for a in range(6):
                        for b in range(6):
                            left[a, b] += turn[f, c, a] * block[c, b]
            if pose[k] >= 0:
                for a in range(6):
                    for c in range(6):
                        for b in range(6):
                            right[a, b] += block[a, c] * turn[k, c, b]
                            both[a, b] += left[a, c] * turn[k, c, b]
            if f == k:
                _add(into_first, into_rows, pose[f], pose[f], both, 0, 0, 6, into)
                _add(into_first, into_rows, view[f], view[f], block, 0, 0, 6, into)
                # One of the mirror images: the pose is never the same unknown as the extrinsics.
                _add(into_first, into_rows, view[f], pose[f], right, 0, 0, 6, into)
            else:
                _add_one(into_first, into_rows, pose[f], pose[k], both, into)
                _add_one(into_first, into_rows, view[f], view[k], block, into)
                _add_one(into_first, into_rows, view[f], pose[k], right, into)
                _add_one(into_first, into_rows, pose[f], view[k], left, into)
        if pose[k] >= 0:
            for c in range(6):
                for a in range(6):
                    into_gradient[pose[k], a] += turn[k, c, a] * gradient[k, c]
        if view[k] >= 0:
            for a in range(6):
                into_gradient[view[k], a] += gradient[k, a]


@vectorised
def damp(
    first: Array, rows: Array, direct: Array, eliminated: Array, damping: float, factor: Array, scale: Array
) -> None:
    """Fill `factor` (B, 6, 6) with the damped reduced system at unit diagonal, and `scale` (nodes, 6)."""
    shrink = 1 / (1 + damping)
    count = len(first) - 1
    for k in range(count):
        p = first[k]
        for a in range(6):
            curvature = direct[p, a, a] - shrink * eliminated[p, a, a]
            # Without any curvature there is no gradient either: scaled to a unit row, it does not move.
            known = curvature > MIN_CURVATURE * direct[p, a, a]
            scale[k, a] = 1 / math.sqrt(curvature) if known else 0.0
    for k in range(count):
        for p in range(first[k], first[k + 1]):
            i = rows[p]
            for a in range(6):
                for b in range(6):
                    factor[p, a, b] = (direct[p, a, b] - shrink * eliminated[p, a, b]) * scale[i, a] * scale[k, b]
        for a in range(6):
            factor[first[k], a, a] += damping + (0.0 if scale[k, a] > 0 else 1.0)
