"""Compiled loops over a cost volume: prior, semi-global aggregation, and the winner with how distinct it is.

Numba's cache notices changes of the file of a function only, so what calls each other lives here together.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vipe_core.compilation import compiled

Array = NDArray[Any]

# Hypotheses so close to the winner are the same answer.
_SAME_ANSWER = 2


@compiled
def add_prior(cost: Array, position: Array, confidence: Array, gain: float, reach: float) -> None:
    """Adds a truncated cost of leaving plane `position` (h, w), in place; `confidence` (h, w) scales it."""
    h, w, num_planes = cost.shape
    for y in range(h):
        for x in range(w):
            if confidence[y, x] > 0:
                scale = np.float32(gain * confidence[y, x])
                for k in range(num_planes):
                    away = abs(k - position[y, x]) / reach
                    cost[y, x, k] += scale * np.float32(min(1.0, away))


@compiled
def _pass(
    cost: Array, gray: Array, total: Array, small: float, large: float, edge: float, vertical: bool, backward: bool
) -> None:
    """One direction of the aggregation."""
    h, w, n = cost.shape
    lines, length = (w, h) if vertical else (h, w)
    far = np.float32(1e9)
    p1 = np.float32(small)
    previous, current = np.full(n + 2, far, np.float32), np.full(n + 2, far, np.float32)
    for line in range(lines):
        lowest = np.float32(0)
        last_gray = np.float32(0)
        for step in range(length):
            i = length - 1 - step if backward else step
            y, x = (i, line) if vertical else (line, i)
            value = gray[y, x]
            smallest = far
            if step == 0:
                for k in range(n):
                    current[k + 1] = cost[y, x, k]
                    smallest = min(smallest, current[k + 1])
            else:
                p2 = np.float32(max(2 * small, large * math.exp(-abs(value - last_gray) / edge)))
                jump = lowest + p2
                for k in range(n):
                    best = min(min(previous[k + 1], previous[k] + p1), min(previous[k + 2] + p1, jump))
                    current[k + 1] = cost[y, x, k] + best - lowest
                for k in range(n):
                    smallest = min(smallest, current[k + 1])
            for k in range(n):
                total[y, x, k] += current[k + 1]
            previous, current = current, previous
            lowest, last_gray = smallest, value


@compiled
def aggregate(cost: Array, gray: Array, small: float, large: float, edge: float) -> Array:
    """Semi-global aggregation along four directions (Hirschmueller 2008, equation 13): (h, w, D) float32."""
    total = np.zeros_like(cost)
    _pass(cost, gray, total, small, large, edge, False, False)
    _pass(cost, gray, total, small, large, edge, False, True)
    _pass(cost, gray, total, small, large, edge, True, False)
    _pass(cost, gray, total, small, large, edge, True, True)
    return total


@compiled
def winner(total: Array, cost: Array) -> tuple[Array, Array, Array]:
    """Position of the lowest aggregated cost with a parabola through its neighbours, the raw cost there, and how much
    lower that is than the lowest raw cost of any other answer (at least 0): what is flat or repeats has no margin."""
    h, w, n = total.shape
    position, raw, margin = np.empty((h, w), np.float32), np.empty((h, w), np.float32), np.empty((h, w), np.float32)
    for y in range(h):
        for x in range(w):
            best = 0
            for k in range(1, n):
                if total[y, x, k] < total[y, x, best]:
                    best = k
            offset = 0.0
            if 0 < best < n - 1:
                before, here, after = total[y, x, best - 1], total[y, x, best], total[y, x, best + 1]
                bend = before - 2 * here + after
                if bend > 1e-9:
                    offset = max(-0.5, min(0.5, 0.5 * (before - after) / bend))
            position[y, x] = best + offset
            raw[y, x] = cost[y, x, best]
            rival = np.float32(2)
            for k in range(n):
                if abs(k - best) > _SAME_ANSWER:
                    rival = min(rival, cost[y, x, k])
            margin[y, x] = max(np.float32(0), rival - raw[y, x])
    return position, raw, margin
