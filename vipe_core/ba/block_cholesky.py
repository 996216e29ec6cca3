"""Cholesky factorisation of sparse symmetric matrices of 6x6 blocks: order, fill and factor.

One block row per free pose, and last ones for the intrinsics of each camera, which couple with everything. The order
is greedy minimum degree (Markowitz 1957, Tinney & Walker 1967): a trajectory eliminates to a band, and an edge that
closes a loop costs the fill of its cycle only. The order is found on sets of neighbours, whose state when a node is
eliminated is at the same time its column of the factor; so the analysis is exact, and made once per graph.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vipe_core.compilation import vectorised

Array = NDArray[Any]

BLOCK = 6


@dataclass(frozen=True, slots=True)
class Structure:
    """Columns of the factor, in order of elimination.

    Attributes:
        place: (N,) int64 column of each node.
        first: (N + 1,) int64 where the columns begin in `rows`.
        rows: (B,) int64 block rows of the columns, ascending, the diagonal first.
    """

    place: NDArray[np.int64]
    first: NDArray[np.int64]
    rows: NDArray[np.int64]

    @property
    def num_nodes(self) -> int:
        return len(self.place)

    @property
    def num_blocks(self) -> int:
        return len(self.rows)


def analyse(num_nodes: int, cliques: Sequence[Sequence[int]], dense_last: int) -> Structure:
    """Order of elimination and fill.

    Args:
        num_nodes: Nodes 0..num_nodes-1.
        cliques: Sets of nodes that are coupled pairwise.
        dense_last: How many more nodes there are, from number `num_nodes` on, coupled with all others and each other
            and eliminated last.
    """
    neighbours: list[set[int]] = [set() for _ in range(num_nodes)]
    for clique in cliques:
        for node in clique:
            neighbours[node].update(clique)
    for node, ring in enumerate(neighbours):
        ring.discard(node)
    order, columns = _eliminate(neighbours)
    dense = list(range(num_nodes, num_nodes + dense_last))
    order += dense
    columns = [[*column, *dense] for column in columns] + [dense[k + 1 :] for k in range(dense_last)]
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    first = np.zeros(len(order) + 1, np.int64)
    first[1:] = np.cumsum([1 + len(column) for column in columns])
    rows = np.empty(first[-1], np.int64)
    for k, (node, column) in enumerate(zip(order, columns, strict=True)):
        rows[first[k] : first[k + 1]] = np.sort(place[[node, *column]])
    return Structure(place, first, rows)


def pattern(num_nodes: int, cliques: Sequence[Sequence[int]], dense_last: int) -> Structure:
    """The blocks of a matrix in the order of its nodes, without any fill: to add up, not to be factorised.

    Args:
        num_nodes, cliques, dense_last: As in `analyse`.
    """
    below: list[set[int]] = [{node} for node in range(num_nodes)]
    for clique in cliques:
        for node in clique:
            below[node].update(other for other in clique if other > node)
    dense = list(range(num_nodes, num_nodes + dense_last))
    rows = [[*sorted(column), *dense] for column in below] + [dense[k:] for k in range(dense_last)]
    first = np.zeros(len(rows) + 1, np.int64)
    first[1:] = np.cumsum([len(column) for column in rows])
    return Structure(np.arange(len(rows)), first, np.concatenate([np.array(column, np.int64) for column in rows]))


def _eliminate(neighbours: list[set[int]]) -> tuple[list[int], list[list[int]]]:
    """Nodes in order of least degree (ties: lowest number), and the later nodes that each is coupled with by then."""
    order: list[int] = []
    columns: list[list[int]] = []
    done = [False] * len(neighbours)
    heap = [(len(ring), node) for node, ring in enumerate(neighbours)]
    heapq.heapify(heap)
    while heap:
        degree, node = heapq.heappop(heap)
        ring = neighbours[node]
        if done[node] or degree != len(ring):
            continue
        if degree == len(neighbours) - len(order) - 1:
            # What is left is one clique: any order is as good.
            rest = sorted({node, *ring})
            order += rest
            columns += [rest[k + 1 :] for k in range(len(rest))]
            break
        done[node] = True
        order.append(node)
        columns.append(list(ring))
        for other in ring:
            union = neighbours[other]
            union |= ring
            union.discard(other)
            union.discard(node)
            heapq.heappush(heap, (len(union), other))
    return order, columns


@vectorised
def factorise(first: Array, rows: Array, blocks: Array) -> bool:
    """Replace the lower blocks (B, 6, 6) of a symmetric matrix by its Cholesky factor; False if not definite."""
    turned = np.empty((BLOCK, BLOCK))
    for k in range(len(first) - 1):
        begin, end = first[k], first[k + 1]
        pivot = blocks[begin]
        for j in range(BLOCK):
            d = pivot[j, j]
            for c in range(j):
                d -= pivot[j, c] * pivot[j, c]
            if not d > 0:
                return False
            d = math.sqrt(d)
            pivot[j, j] = d
            for i in range(j + 1, BLOCK):
                s = pivot[i, j]
                for c in range(j):
                    s -= pivot[i, c] * pivot[j, c]
                pivot[i, j] = s / d
        for p in range(begin + 1, end):
            block = blocks[p]
            for j in range(BLOCK):
                for i in range(BLOCK):
                    s = block[i, j]
                    for c in range(j):
                        s -= block[i, c] * pivot[j, c]
                    block[i, j] = s / pivot[j, j]
        for q in range(begin + 1, end):
            right = blocks[q]
            for i in range(BLOCK):
                for j in range(BLOCK):
                    turned[j, i] = right[i, j]
            into = first[rows[q]]
            for p in range(q, end):
                while rows[into] != rows[p]:
                    into += 1
                left, out = blocks[p], blocks[into]
                for i in range(BLOCK):
                    s0, s1, s2, s3, s4, s5 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
                    for c in range(BLOCK):
                        x = left[i, c]
                        s0 += x * turned[c, 0]
                        s1 += x * turned[c, 1]
                        s2 += x * turned[c, 2]
                        s3 += x * turned[c, 3]
                        s4 += x * turned[c, 4]
                        s5 += x * turned[c, 5]
                    out[i, 0] -= s0
                    out[i, 1] -= s1
                    out[i, 2] -= s2
                    out[i, 3] -= s3
                    out[i, 4] -= s4
                    out[i, 5] -= s5
    return True


@vectorised
def substitute(first: Array, rows: Array, factor: Array, vector: Array) -> None:
    """Replace a vector (N, 6), in order of elimination, by the solution of L L^T x = vector."""
    count = len(first) - 1
    for k in range(count):
        x, pivot = vector[k], factor[first[k]]
        for i in range(BLOCK):
            s = x[i]
            for c in range(i):
                s -= pivot[i, c] * x[c]
            x[i] = s / pivot[i, i]
        for p in range(first[k] + 1, first[k + 1]):
            y, block = vector[rows[p]], factor[p]
            for i in range(BLOCK):
                for c in range(BLOCK):
                    y[i] -= block[i, c] * x[c]
    for k in range(count - 1, -1, -1):
        x, pivot = vector[k], factor[first[k]]
        for p in range(first[k] + 1, first[k + 1]):
            y, block = vector[rows[p]], factor[p]
            for i in range(BLOCK):
                for c in range(BLOCK):
                    x[c] -= block[i, c] * y[i]
        for i in range(BLOCK - 1, -1, -1):
            s = x[i]
            for c in range(i + 1, BLOCK):
                s -= pivot[c, i] * x[c]
            x[i] = s / pivot[i, i]
