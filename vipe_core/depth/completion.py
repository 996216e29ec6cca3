"""Filling what was not measured: inverse depth as plane as the measurements and the edges of the picture allow.

Every pixel carries an inverse depth u and its slope p. They minimise

    sum c (u - m)^2 + sum g [(u_j - u_i - (p_i + p_j) / 2 . (x_j - x_i))^2 + b |p_i - p_j|^2]

over pixels with measurements m of weight c and over pairs of neighbours, with a small g across edges of the picture:
the quadratic form of total generalised variation (Bredies, Kunisch and Pock, SIAM J. Imaging Sci. 2010) with the
weights of weighted least squares (Farbman et al., SIGGRAPH 2008). Inverse depth is linear on a plane, so a blank wall
continues the planes through what is measured on it. Solved from coarse to fine; a second solution leaves out what the
first one contradicts.

Numba's cache notices changes of the file of a function only, so what calls each other lives here together.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vipe_core.compilation import compiled

Array = NDArray[Any]

# Of an edge of the picture, beside 1 of no edge: never cut off altogether.
_LEAST_LINK = 1e-4
# Of a difference between slopes, in pixels squared; and what holds slopes at zero: nothing is continued for ever.
_STIFFNESS, _LEVELLING = 100.0, 1e-4
_SWEEPS = 8
_COARSEST = 4
_SOLUTIONS = 2
# What is continued stays within these multiples of the range of what is measured.
_FAR_SHARE, _NEAR_SHARE = 0.5, 1.5


def complete(
    inverse_depth: Array,
    weight: Array,
    rgb: NDArray[np.uint8],
    apart: NDArray[np.bool_],
    smoothness: float,
    edge: float,
    tolerance: float,
) -> NDArray[np.float32]:
    """The inverse depth of all pixels of a frame.

    Args:
        inverse_depth: (h, w) float32 measurements.
        weight: (h, w) float32 >= 0; 0 where nothing was measured. One must be positive.
        rgb: (h, w, 3) the picture.
        apart: (h, w) bool, pixels that nothing is carried into or out of; what they get means nothing.
        smoothness: Weight of a difference between neighbours that look the same.
        edge: Difference in colour (grey levels) that lowers it by a factor e.
        tolerance: Relative difference to the solution at which a measurement counts a quarter.

    Returns:
        (h, w) float32.
    """
    right, down = _links(rgb, smoothness, edge)
    right[:, :-1][apart[:, :-1] != apart[:, 1:]] = 0
    down[:-1][apart[:-1] != apart[1:]] = 0
    links = [(right, down)]
    while min(links[-1][0].shape) > _COARSEST:
        links.append(_coarser_links(*links[-1]))
    weight = np.where(apart, 0, weight).astype(np.float32)
    measured = np.where(weight > 0, inverse_depth, 0).astype(np.float32)
    total = float(weight.sum())
    mean = float((weight * measured).sum() / total)
    low, high = float(inverse_depth[weight > 0].min()), float(inverse_depth[weight > 0].max())
    solution = np.zeros(0, np.float32)
    kept = weight
    for number in range(_SOLUTIONS):
        if number:
            away = (measured - solution) / (tolerance * np.maximum(solution, 1e-3 * mean))
            kept = (weight / (1 + away * away) ** 2).astype(np.float32)
        solution = _solved(measured, kept, links, mean)
        np.clip(solution, _FAR_SHARE * low, _NEAR_SHARE * high, out=solution)
    return solution


def _solved(measured: Array, weight: Array, links: list[tuple[Array, Array]], mean: float) -> NDArray[np.float32]:
    data = [((weight * measured).astype(np.float32), weight.astype(np.float32))]
    for _ in links[1:]:
        data.append((_summed(data[-1][0]), _summed(data[-1][1])))
    # Channels: inverse depth, and its slopes per pixel of the level.
    solution = np.zeros((3, *links[-1][0].shape), np.float32)
    solution[0] = mean
    for level in reversed(range(len(links))):
        (pull, hold), (right, down) = data[level], links[level]
        if solution.shape[1:] != pull.shape:
            solution = _finer(solution, *pull.shape)
        _relax(solution, pull, hold, right, down, _STIFFNESS / 4**level, _LEVELLING, _SWEEPS)
    return np.asarray(solution[0])


@compiled
def _finer(solution: Array, height: int, width: int) -> Array:
    """The solution on pixels of half the size: each continues the plane of its block."""
    out = np.empty((3, height, width), np.float32)
    half, quarter = np.float32(0.5), np.float32(0.25)
    for y in range(height):
        for x in range(width):
            v, u = y // 2, x // 2
            across, below = solution[1, v, u], solution[2, v, u]
            out[0, y, x] = (
                solution[0, v, u] + (quarter if x % 2 else -quarter) * across + (quarter if y % 2 else -quarter) * below
            )
            out[1, y, x] = half * across
            out[2, y, x] = half * below
    return out


def _summed(values: Array) -> NDArray[np.float32]:
    """Sums over blocks of 2 x 2, the last ones cut off at the border."""
    h, w = values.shape
    padded = np.zeros((h + h % 2, w + w % 2), np.float32)
    padded[:h, :w] = values
    return np.asarray(padded[::2, ::2] + padded[1::2, ::2] + padded[::2, 1::2] + padded[1::2, 1::2])


@compiled
def _links(rgb: Array, smoothness: float, edge: float) -> tuple[Array, Array]:
    """Weights (h, w) of the difference to the right and to the lower neighbour; 0 where there is none."""
    h, w = rgb.shape[:2]
    right, down = np.zeros((h, w), np.float32), np.zeros((h, w), np.float32)
    for y in range(h):
        for x in range(w):
            across, below = 0, 0
            for c in range(3):
                if x + 1 < w:
                    across = max(across, abs(int(rgb[y, x + 1, c]) - int(rgb[y, x, c])))
                if y + 1 < h:
                    below = max(below, abs(int(rgb[y + 1, x, c]) - int(rgb[y, x, c])))
            if x + 1 < w:
                right[y, x] = smoothness * max(math.exp(-across / edge), _LEAST_LINK)
            if y + 1 < h:
                down[y, x] = smoothness * max(math.exp(-below / edge), _LEAST_LINK)
    return right, down


@compiled
def _coarser_links(right: Array, down: Array) -> tuple[Array, Array]:
    """Links between blocks of 2 x 2: those between their centres in series, the two paths side by side in parallel."""
    h, w = right.shape
    rows, cols = (h + 1) // 2, (w + 1) // 2
    across, below = np.zeros((rows, cols), np.float32), np.zeros((rows, cols), np.float32)
    for y in range(rows):
        for x in range(cols):
            for i in range(2):
                v, u = 2 * y + i, 2 * x + 1
                if v < h and u < w and right[v, u] > 0:
                    resistance = 1 / right[v, u]
                    if right[v, u - 1] > 0:
                        resistance += 0.5 / right[v, u - 1]
                    if u + 1 < w and right[v, u + 1] > 0:
                        resistance += 0.5 / right[v, u + 1]
                    across[y, x] += 1 / resistance
                v, u = 2 * y + 1, 2 * x + i
                if v < h and u < w and down[v, u] > 0:
                    resistance = 1 / down[v, u]
                    if down[v - 1, u] > 0:
                        resistance += 0.5 / down[v - 1, u]
                    if v + 1 < h and down[v + 1, u] > 0:
                        resistance += 0.5 / down[v + 1, u]
                    below[y, x] += 1 / resistance
    return across, below


@compiled
def _relax(
    solution: Array,
    pull: Array,
    hold: Array,
    right: Array,
    down: Array,
    stiffness: float,
    levelling: float,
    sweeps: int,
) -> None:
    """Symmetric Gauss-Seidel sweeps over depth and slopes (3, h, w), in place."""
    _, h, w = solution.shape
    tiny, half, quarter = np.float32(1e-12), np.float32(0.5), np.float32(0.25)
    stiff, level = np.float32(stiffness), np.float32(levelling)
    value, across, below = solution[0], solution[1], solution[2]
    zero = np.float32(0)
    for sweep in range(2 * sweeps):
        for i in range(h * w):
            at = i if sweep % 2 == 0 else h * w - 1 - i
            y, x = at // w, at % w
            to_left = right[y, x - 1] if x > 0 else zero
            to_right = right[y, x]
            to_upper = down[y - 1, x] if y > 0 else zero
            to_lower = down[y, x]
            total, weight = pull[y, x], hold[y, x] + to_left + to_right + to_upper + to_lower
            rise, rise_weight = zero, level + quarter * (to_left + to_right)
            fall, fall_weight = zero, level + quarter * (to_upper + to_lower)
            links = stiff * (to_left + to_right + to_upper + to_lower)
            here_across, here_below, here = across[y, x], below[y, x], value[y, x]
            stiff_across, stiff_below = zero, zero
            if to_left > 0:
                there, slope = value[y, x - 1], across[y, x - 1]
                total += to_left * (there + half * (slope + here_across))
                rise += half * to_left * (here - there - half * slope)
                stiff_across += to_left * slope
                stiff_below += to_left * below[y, x - 1]
            if to_right > 0:
                there, slope = value[y, x + 1], across[y, x + 1]
                total += to_right * (there - half * (slope + here_across))
                rise += half * to_right * (there - here - half * slope)
                stiff_across += to_right * slope
                stiff_below += to_right * below[y, x + 1]
            if to_upper > 0:
                there, slope = value[y - 1, x], below[y - 1, x]
                total += to_upper * (there + half * (slope + here_below))
                fall += half * to_upper * (here - there - half * slope)
                stiff_below += to_upper * slope
                stiff_across += to_upper * across[y - 1, x]
            if to_lower > 0:
                there, slope = value[y + 1, x], below[y + 1, x]
                total += to_lower * (there - half * (slope + here_below))
                fall += half * to_lower * (there - here - half * slope)
                stiff_below += to_lower * slope
                stiff_across += to_lower * across[y + 1, x]
            if weight > tiny:
                value[y, x] = total / weight
                across[y, x] = (rise + stiff * stiff_across) / (rise_weight + links)
                below[y, x] = (fall + stiff * stiff_below) / (fall_weight + links)
