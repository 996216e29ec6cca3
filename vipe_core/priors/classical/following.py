"""Corners followed through consecutive frames: Shi-Tomasi corners, pyramidal Lucas-Kanade both ways.

They are looked for in the frame in which most of them began, so that errors do not add up with every frame.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from vipe_core.cameras import Camera
from vipe_core.priors.classical.features import length_px
from vipe_core.priors.classical.lucas_kanade import lucas_kanade
from vipe_core.priors.points import bounded_size, visible
from vipe_core.priors.protocols import TrackedPoints
from vipe_core.video.source import Frame

_WINDOW = (15, 15)
_LEVELS = 3
# New corners are looked for when fewer than this share of them is left.
_REFILL = 0.8


class CornerFollower:
    """`PointFollower` of OpenCV.

    Args:
        most: Points followed at once.
        max_return_px: A point that is not found again this close to where it was, back in the frame that it is followed
            from, is lost.
    """

    def __init__(self, most: int = 600, max_return_px: float = 0.5) -> None:
        self._most = most
        self._max_return_px = max_return_px

    def input_size(self, width: int, height: int) -> tuple[int, int]:
        return bounded_size(width, height)

    def follow(self, frames: Iterable[Frame], camera: Camera) -> Iterator[TrackedPoints]:
        """See `PointFollower`; the camera makes no difference."""
        anchor: NDArray[np.uint8] | None = None
        nothing = np.zeros((0, 2), np.float32)
        begun_px, points_px, steps_px = nothing, nothing, nothing
        ids, first_free = np.zeros(0, np.int64), 0
        for frame in frames:
            gray = np.asarray(cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY), np.uint8)
            if anchor is not None and len(ids):
                # What moves goes on as it did for a frame; the way back begins where the point is known to be.
                there, found = lucas_kanade(anchor, gray, begun_px, points_px + steps_px, _WINDOW, _LEVELS)
                back, returned = lucas_kanade(gray, anchor, there, begun_px, _WINDOW, _LEVELS)
                kept = found & returned & (length_px(back - begun_px) < self._max_return_px)
                kept &= visible(there, (gray.shape[0], gray.shape[1]), frame.masked)
                steps_px = (there - points_px)[kept]
                begun_px, points_px, ids = begun_px[kept], there[kept], ids[kept]
            if anchor is None or len(ids) < _REFILL * self._most:
                new = self._corners(gray, points_px, frame.masked)
                points_px = np.concatenate((points_px, new))
                steps_px = np.concatenate((steps_px, np.zeros_like(new)))
                ids = np.concatenate((ids, np.arange(first_free, first_free + len(new))))
                first_free += len(new)
                anchor, begun_px = gray, points_px
            yield TrackedPoints(ids, points_px)

    def _corners(
        self, gray: NDArray[np.uint8], known_px: NDArray[np.float32], masked: NDArray[np.bool_] | None
    ) -> NDArray[np.float32]:
        """(n, 2) corners away from the points that are followed already."""
        # Evenly spread, this many points would be half as far again from each other.
        apart_px = np.sqrt(gray.size / self._most) / 1.5
        free = np.full(gray.shape, 255, np.uint8) if masked is None else np.where(masked, 0, 255).astype(np.uint8)
        for x, y in np.rint(known_px).astype(int).tolist():
            cv2.circle(free, (x, y), int(apart_px), 0, -1)
        found = cv2.goodFeaturesToTrack(gray, self._most - len(known_px), 0.005, apart_px, mask=free)
        return np.zeros((0, 2), np.float32) if found is None else np.asarray(found[:, 0], np.float32)
