"""What moves by itself: whether it does, and its depth, for which no other frame can be asked.

It stands where it touches the static scene.
"""

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
# What seems to move is taken for static where most of it is measured, within windows of this share of the width.
_MOST, _WINDOW = 0.5, 0.1


def unrefuted(moving: NDArray[np.bool_], measured: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """What seems to move, less the parts that are measured as static.

    Masks come from the flow between keyframes, which fails on what passes by fast or repeats; that other frames see
    the same depth through their static geometry happens to no thing that moves by itself, but for a few pixels.

    Args:
        moving: (h, w) bool.
        measured: (h, w) bool, where enough frames agree on one depth.
    """
    if not (moving & measured).any():
        return moving
    side = 2 * round(_WINDOW * moving.shape[1] / 2) + 1
    masked, refuted = (
        cv2.boxFilter(area.astype(np.float32), -1, (side, side), borderType=cv2.BORDER_CONSTANT)
        for area in (moving, moving & measured)
    )
    return np.asarray(moving & (refuted <= _MOST * masked))


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
        # What is only filled in may itself be a guess about something that moves.
        ground &= measured
        if ground.sum() >= _MIN_PIXELS:
            out[thing] = np.quantile(inverse_depth[ground], nearness)
    return out
