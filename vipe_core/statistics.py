"""Robust statistics of small weighted samples."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

# Standard deviation of a Gaussian over its median absolute deviation, and of its median over that of its mean.
MAD_TO_SIGMA = 1.4826
_MEDIAN_LOSS = 1.2533


def weighted_median(values: Array, weights: Array) -> float:
    """The value below and above which half of the weight lies; the mean of two where half falls between them.

    Args:
        values: (n,), n > 0, finite.
        weights: (n,), not negative, not all 0.
    """
    order = np.argsort(values, kind="stable")
    ordered, below = np.asarray(values, np.float64)[order], np.cumsum(np.asarray(weights, np.float64)[order])
    half = 0.5 * below[-1]
    left = int(np.searchsorted(below, half * (1 - 1e-12), side="left"))
    right = int(np.searchsorted(below, half * (1 + 1e-12), side="left"))
    return float(0.5 * (ordered[left] + ordered[min(right, len(ordered) - 1)]))


def weighted_spread(values: Array, weights: Array, centre: float) -> float:
    """Standard deviation of a Gaussian with the same weighted median absolute deviation from `centre`."""
    return MAD_TO_SIGMA * weighted_median(np.abs(np.asarray(values, np.float64) - centre), weights)


def consensus(values: Array, weights: Array, least_spread: float, reach: float = 3.0) -> tuple[float, float, int]:
    """Weighted median of what is left once values further than `reach` spreads from it are rejected.

    Args:
        values: (n,), n > 0.
        weights: (n,), not negative, not all 0.
        least_spread: Values this close together are never told apart.

    Returns:
        The value, its standard error (0 for a single one), and how many values it rests on.
    """
    values, weights = np.asarray(values, np.float64), np.asarray(weights, np.float64)
    centre = weighted_median(values, weights)
    spread = max(weighted_spread(values, weights, centre), least_spread)
    kept = (np.abs(values - centre) <= reach * spread) & (weights > 0)
    values, weights = values[kept], weights[kept]
    centre = weighted_median(values, weights)
    effective = float(weights.sum()) ** 2 / float(np.square(weights).sum())
    error = _MEDIAN_LOSS * weighted_spread(values, weights, centre) / np.sqrt(effective)
    return centre, float(error), len(values)
