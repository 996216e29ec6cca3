"""Filling what was not measured, along the edges of the picture."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

_RADII = (3, 6, 12, 24, 48)
_EDGE_VARIANCE = 60.0
_MIN_SUPPORT = 0.02


def complete(inverse_depth: Array, weight: Array, gray: Array, fallback: Array) -> NDArray[np.float32]:
    """Fills pixels without weight by weighted guided filters of growing radius (He et al., PAMI 2013).

    Args:
        inverse_depth: (h, w) float32.
        weight: (h, w) float32, 0 where the value is not to be trusted.
        gray: (h, w) float32 guide.
        fallback: (h, w) float32 values where no filter finds support.

    Returns:
        (h, w) float32; pixels with weight keep their value.
    """
    out = np.asarray(inverse_depth, np.float32).copy()
    open_pixels = weight <= 0
    known = ~open_pixels
    if not open_pixels.any():
        return out
    if not known.any():
        return np.asarray(fallback, np.float32).copy()
    low, high = float(out[known].min()), float(out[known].max())
    # In grey levels around zero, the sums below stay small enough for float32.
    guide = gray - float(gray.mean())
    for radius in _RADII:
        box = (2 * radius + 1, 2 * radius + 1)

        def mean(values: Array, box: tuple[int, int] = box) -> Array:
            return np.asarray(cv2.blur(values, box, borderType=cv2.BORDER_CONSTANT))

        support = mean(weight)
        norm = 1 / np.maximum(support, 1e-6)
        mean_guide, mean_value = mean(weight * guide) * norm, mean(weight * out) * norm
        variance = mean(weight * guide * guide) * norm - mean_guide**2
        covariance = mean(weight * guide * out) * norm - mean_guide * mean_value
        slope = covariance / (np.maximum(variance, 0) + _EDGE_VARIANCE)
        offset = mean_value - slope * mean_guide
        usable = (support > _MIN_SUPPORT).astype(np.float32)
        share = np.maximum(mean(usable), 1e-6)
        filled = mean(slope * usable) / share * guide + mean(offset * usable) / share
        take = open_pixels & (usable > 0)
        out[take] = np.clip(filled[take], low, high)
        open_pixels &= usable == 0
        if not open_pixels.any():
            break
    out[open_pixels] = np.asarray(fallback, np.float32)[open_pixels]
    return out
