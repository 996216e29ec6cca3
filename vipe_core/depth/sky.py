"""Finding the sky, which no depth map measures: it is far, plain, above everything else, and looks like sky.

Neither is enough by itself: a blank ceiling is as plain and as bright, but nothing under it is far; a distant wall is
far, but measured.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

# Blue by so many grey levels over red and none under green, or so bright that the camera saw no colour.
_BLUE, _WHITE = 6, 245
_MIN_BRIGHTNESS = 90
# Mean gradient, in grey levels per pixel, above which a place is not plain.
_PLAIN = 4.0
_PLAIN_BOX = 5
# Out of doors the far end of what is measured is so much further away than the near end.
_FAR_RATIO = 8.0
_NEAR_QUANTILE, _FAR_QUANTILE = 0.95, 0.02
_MIN_MEASURED = 0.05
# Most of the sky's pixels that may be believed to be nearer than that far end.
_MAX_MEASURED = 0.1
_MIN_AREA = 0.003
_SURE_BELIEF = 0.15


def find_sky(
    rgb: NDArray[np.uint8], inverse_depth: Array, belief: Array, moving: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """(h, w) bool, where the sky is.

    Args:
        rgb: (h, w, 3).
        inverse_depth: (h, w) float32.
        belief: (h, w) float32, 0 where nothing is measured.
        moving: (h, w) bool, left out.
    """
    height, width = belief.shape
    nowhere = np.zeros((height, width), np.bool_)
    sure = belief > _SURE_BELIEF
    if sure.mean() < _MIN_MEASURED:
        return nowhere
    far, near = np.quantile(inverse_depth[sure], (_FAR_QUANTILE, _NEAR_QUANTILE))
    if far * _FAR_RATIO > near:
        return nowhere
    red, green, blue = (rgb[..., c].astype(np.int16) for c in range(3))
    coloured = (blue >= red + _BLUE) & (blue >= green) & (blue > _MIN_BRIGHTNESS)
    white = rgb.min(axis=2) >= _WHITE
    gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    across, down = (cv2.Sobel(gray, cv2.CV_32F, dx, 1 - dx, scale=1 / 8) for dx in (1, 0))
    rough = cv2.blur(cv2.magnitude(across, down), (_PLAIN_BOX, _PLAIN_BOX))
    looks = ((coloured | white) & (rough < _PLAIN) & ~moving).astype(np.uint8)
    count, parts, statistics, _ = cv2.connectedComponentsWithStats(looks, connectivity=4)
    nearer = sure & (inverse_depth > 1.5 * far)
    kept = np.zeros(count, np.bool_)
    for part in range(1, count):
        area = int(statistics[part, cv2.CC_STAT_AREA])
        if statistics[part, cv2.CC_STAT_TOP] > 1 or area < _MIN_AREA * height * width:
            continue
        kept[part] = nearer[parts == part].mean() < _MAX_MEASURED
    sky = kept[parts].astype(np.uint8)
    if not sky.any():
        return nowhere
    # Back to the edge that the gradient of the border kept it from, over pixels of the same looks.
    grown = cv2.dilate(sky, np.ones((_PLAIN_BOX, _PLAIN_BOX), np.uint8)) > 0
    return np.asarray((sky > 0) | (grown & (coloured | white) & ~sure & ~moving))
