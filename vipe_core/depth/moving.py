"""Depth of what moves by itself, for which no other frame can be asked: it stands where it touches the static scene."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

# A thing of which so much is measured as static is no moving thing.
_STATIC_SHARE = 0.2
# Pixels below a thing that it stands on, or around it.
_CONTACT_PX = 4
# What the picture cuts off at the bottom is as near as the nearer part of what is around it: more of it is in front of
# the scene than behind it, but a thin neighbour may be nearer still.
# Of a small piece at the border nobody can tell, and the scene is continued into it.
_CUT_OFF_QUANTILE, _MIN_CUT_OFF_AREA = 0.8, 0.04
_MIN_PIXELS = 10


def stand(
    inverse_depth: NDArray[np.float32], moving: NDArray[np.bool_], measured: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """One inverse depth for every moving thing, that of the ground where it meets it.

    Args:
        inverse_depth: (h, w) of the static scene, filled where things hide it.
        moving: (h, w) what moves.
        measured: (h, w) where the inverse depth is measured, also inside of `moving`.

    Returns:
        (h, w) float32, the same outside of what moves.
    """
    height = len(moving)
    out = inverse_depth.copy()
    count, parts, boxes, _ = cv2.connectedComponentsWithStats(moving.astype(np.uint8), connectivity=4)
    disk = np.ones((2 * _CONTACT_PX + 1, 2 * _CONTACT_PX + 1), np.uint8)
    lower = np.zeros_like(disk)
    lower[: _CONTACT_PX + 1, _CONTACT_PX] = 1
    for part in range(1, count):
        thing = parts == part
        if measured[thing].mean() > _STATIC_SHARE:
            continue
        area = thing.astype(np.uint8)
        tall = int(boxes[part, cv2.CC_STAT_HEIGHT])
        bottom = int(boxes[part, cv2.CC_STAT_TOP]) + tall
        if bottom < height:
            ground = (cv2.dilate(area, lower) > 0) & ~moving
            # Only under its lower half: what is under an arm is not what it stands on.
            ground[: bottom - tall // 2] = False
            nearness = 0.5
        else:
            ground = (cv2.dilate(area, disk) > 0) & ~moving
            nearness = _CUT_OFF_QUANTILE
            if thing.mean() < _MIN_CUT_OFF_AREA:
                continue
        if ground.sum() >= _MIN_PIXELS:
            out[thing] = np.quantile(inverse_depth[ground], nearness)
    return out
