"""What all that follow points through a video share."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

# Longest side that is worth the time: the map is of about 640 x 480 pixels.
_LONGEST_PX = 1280


def bounded_size(width: int, height: int) -> tuple[int, int]:
    """(width, height) at which pictures of that size are followed in."""
    scale = min(1.0, _LONGEST_PX / max(width, height))
    return round(width * scale), round(height * scale)


def visible(
    points_px: NDArray[Any], size: tuple[int, int], masked: NDArray[np.bool_] | None = None
) -> NDArray[np.bool_]:
    """(n,) whether points are in a picture, and not on what is masked in it.

    Args:
        points_px: (n, 2) index coordinates.
        size: (height, width) of the picture.
    """
    height, width = size
    inside = np.asarray(((points_px >= 0) & (points_px <= (width - 1, height - 1))).all(axis=1), np.bool_)
    if masked is not None:
        column, row = np.rint(np.where(inside[:, None], points_px, 0)).astype(np.int64).T
        inside &= ~masked[row, column]
    return inside
