"""The depth prior of a front end without a depth network: inverse depth varies smoothly where nothing measures it."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vipe_core.ba.problem import Grid
from vipe_core.statistics import weighted_median

Array = NDArray[Any]

_FINE_CELLS = 2.0
_COARSE_CELLS = 8.0
_ENOUGH = 0.05


def smooth_inverse_depth(inverse_depth: Array, confidence: Array, grid: Grid) -> NDArray[np.float32]:
    """Confidence-weighted Gaussian blur of the current inverse depth.

    Args:
        inverse_depth: (P,) positive.
        confidence: (P,) not negative; cells without measurement have 0 and take their neighbours' value.

    Returns:
        (P,) float32: blurred over two cells, over eight where those two hold no confidence, and the weighted median of
        the frame beyond.
    """
    shape = (grid.height, grid.width)
    value = np.asarray(inverse_depth, dtype=np.float32).reshape(shape)
    weight = np.asarray(confidence, dtype=np.float32).reshape(shape)
    typical = weighted_median(value.ravel(), weight.ravel()) if weight.any() else float(np.median(value))
    # A whisper of the frame's typical value keeps the quotient defined everywhere.
    result = np.full(shape, typical, dtype=np.float32)
    for sigma in (_COARSE_CELLS, _FINE_CELLS):
        mass = cv2.GaussianBlur(weight, (0, 0), sigma, borderType=cv2.BORDER_REFLECT_101)
        total = cv2.GaussianBlur(weight * value, (0, 0), sigma, borderType=cv2.BORDER_REFLECT_101)
        result = (total + np.float32(_ENOUGH) * result) / (mass + np.float32(_ENOUGH))
    return np.asarray(result, dtype=np.float32).reshape(-1)
