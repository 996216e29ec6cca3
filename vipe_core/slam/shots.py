"""Where a video breaks: cuts between shots, and single pictures that belong to nothing (a flash, a torn frame).

A picture continues another when their thumbnails are about as alike as those of the pictures before, or else when
something of the one can be found in the other: cells whose flow agrees with the reverse flow, or corners under one
two-view geometry. Appearance alone would call a wide step a cut, and flow alone a blurred one.

A cut is believed when the pictures behind it continue each other and show no place that the shot before it has shown; a
picture that neither continues the last one nor is continued is passed over, so a flash leaves the shot in one piece.
"""

from __future__ import annotations

import statistics
from collections import deque
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
import poselib
from numpy.typing import NDArray

from vipe_core.priors.protocols import DenseMatcher, WorkingFrame

Array = NDArray[Any]

_THUMBNAIL = (32, 24)
# The thumbnail of a picture without contrast is noise: a standard deviation below this, grey levels, is not scaled up.
_LEAST_CONTRAST = 1.0
# Thumbnails that differ less are of the same shot: 1 minus their correlation. Cameras stay below 0.11 from frame to
# frame, a sparse collection of photographs goes up to 0.9, and so does a cut.
_ALIKE = 0.1
# ... and so are those that differ less than this many times the median of the last steps, up to where there is no
# likeness left to speak of.
_UNUSUAL = 2.0
_UNLIKE = 0.6
_HISTORY = 12
# Share of the cells with a measured flow in both directions that shows the same place: 0.2 to 0.9 a few frames apart,
# between shots at most 0.02 at 640 x 480 and 0.16 at 160 x 120, where a few dozen cells agree by chance.
_MEASURED = 0.3
_MIN_WEIGHT = 0.1
# Corners under one two-view geometry: at least this many (any seven fit one), and this share of the matches. Between
# shots about 40 % of the few that look alike fit.
_MIN_CORNERS = 16
_MIN_SHARE = 0.65
_MAX_CORNERS = 1000
_RATIO = 0.8
_EPIPOLAR_PX = 1.5
# Pictures of a shot that are kept to recognise its places.
_REMEMBERED = 24
# A flash or a torn picture lasts at most this many frames; what lasts longer is a shot.
_LONGEST_FLASH = 4


@dataclass(frozen=True)
class Picture:
    """A frame with what continuity is judged by.

    Attributes:
        index: Frame index in the video.
        features: The matcher's features of it.
        gray: (h, w) uint8.
        thumbnail: (24, 32) float32 of mean 0 and variance 1, or less where there is no contrast.
    """

    index: int
    features: Any
    gray: NDArray[np.uint8]
    thumbnail: NDArray[np.float32]

    @classmethod
    def of(cls, frame: WorkingFrame, features: Any) -> Picture:
        small = cv2.resize(frame.gray, _THUMBNAIL, interpolation=cv2.INTER_AREA).astype(np.float32)
        small = cv2.GaussianBlur(small, (0, 0), 1.0)
        small -= small.mean()
        return cls(frame.index, features, frame.gray, small / max(float(small.std()), _LEAST_CONTRAST))

    @cached_property
    def corners(self) -> tuple[Array, Array]:
        """(n, 2) distinctive points, pixels, and (n, 128) their descriptors."""
        points, descriptors = cv2.SIFT.create(_MAX_CORNERS).detectAndCompute(self.gray, None)
        if not len(points):
            return np.zeros((0, 2)), np.zeros((0, 128), np.float32)
        return np.array([point.pt for point in points]), np.asarray(descriptors)


@dataclass(frozen=True, slots=True)
class Placed:
    """A picture that is part of a shot.

    Attributes:
        cut: Whether it is the first one behind a cut.
    """

    picture: Picture
    cut: bool


class ShotSplitter:
    """Takes the pictures of a video one by one and gives them back with the cuts, a few frames later near one."""

    def __init__(self, matcher: DenseMatcher) -> None:
        self._matcher = matcher
        self._last: Picture | None = None
        self._shown: list[Picture] = []
        self._spacing = 1
        self._waiting: list[Picture] = []
        self._steps: deque[float] = deque(maxlen=_HISTORY)

    def add(self, picture: Picture) -> list[Placed]:
        """The pictures whose place is known now, in order."""
        if self._last is None:
            self._remember(picture)
            return [Placed(picture, cut=False)]
        if self._continues(self._last, picture):
            # What waited was a flash: it belongs to nothing.
            self._waiting = []
            self._remember(picture)
            return [Placed(picture, cut=False)]
        if self._waiting and not self._continues(self._waiting[-1], picture):
            self._waiting = []
        self._waiting.append(picture)
        return self._new_shot() if len(self._waiting) > _LONGEST_FLASH else []

    def finish(self) -> list[Placed]:
        """The pictures that still waited, at the end of the video: a last shot if there are at least two."""
        return self._new_shot() if len(self._waiting) > 1 else []

    def _new_shot(self) -> list[Placed]:
        waiting, self._waiting = self._waiting, []
        ends = (waiting[0], waiting[-1])
        cut = not any(_share_corners(shown, picture) for shown in reversed(self._shown) for picture in ends)
        if cut:
            self._shown, self._spacing = [], 1
        for picture in waiting:
            self._remember(picture)
        return [Placed(picture, cut=cut and number == 0) for number, picture in enumerate(waiting)]

    def _remember(self, picture: Picture) -> None:
        """The last picture, and every so many-th one of the shot so that there are never too many."""
        self._last = picture
        if picture.index % self._spacing == 0:
            self._shown.append(picture)
        if len(self._shown) > _REMEMBERED:
            self._spacing *= 2
            self._shown = [shown for shown in self._shown if shown.index % self._spacing == 0]

    def _continues(self, before: Picture, after: Picture) -> bool:
        difference = 0.5 * float(np.square(before.thumbnail - after.thumbnail).mean())
        usual = statistics.median(self._steps) if self._steps else 0.0
        self._steps.append(difference)
        return difference <= min(max(_ALIKE, _UNUSUAL * usual), _UNLIKE) or self._share_a_place(before, after)

    def _share_a_place(self, before: Picture, after: Picture) -> bool:
        there, back = self._matcher.match(before.features, after.features)
        measured = min(float((match.weight.max(axis=1) > _MIN_WEIGHT).mean()) for match in (there, back))
        return measured >= _MEASURED or _share_corners(before, after)


def _share_corners(before: Picture, after: Picture) -> bool:
    """Whether most of the distinctive corners that look alike fit one two-view geometry."""
    (points_before, descriptors_before), (points_after, descriptors_after) = before.corners, after.corners
    if min(len(points_before), len(points_after)) < _MIN_CORNERS:
        return False
    pairs = cv2.BFMatcher().knnMatch(descriptors_before, descriptors_after, k=2)
    kept = [best for best, second in pairs if best.distance < _RATIO * second.distance]
    if len(kept) < _MIN_CORNERS:
        return False
    source = points_before[[match.queryIdx for match in kept]]
    target = points_after[[match.trainIdx for match in kept]]
    options = {"max_epipolar_error": _EPIPOLAR_PX, "max_iterations": 500, "seed": 0}
    _, report = poselib.estimate_fundamental(source, target, options, {})
    fitting = int(np.sum(report["inliers"]))
    return fitting >= max(_MIN_CORNERS, _MIN_SHARE * len(kept))
