"""Pyramidal Lucas-Kanade from a starting point, as the tracks of the classical providers take it."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

_TERMINATION = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.01)


def lucas_kanade(
    source: Array, target: Array, points: Array, start: Array, window: tuple[int, int], levels: int
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """(n, 2) where points of a gray picture are in another one, and (n,) whether they were found.

    Args:
        start: (n, 2) where to begin to look.
        window: Its sides, pixels.
        levels: Of the pyramid, beside the picture itself.
    """
    moved, status, _ = cv2.calcOpticalFlowPyrLK(
        source,
        target,
        np.ascontiguousarray(points, np.float32)[:, None],
        np.ascontiguousarray(start, np.float32)[:, None].copy(),
        winSize=window,
        maxLevel=levels,
        criteria=_TERMINATION,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        minEigThreshold=1e-4,
    )
    return np.asarray(moved[:, 0]), np.asarray(status[:, 0] > 0)
