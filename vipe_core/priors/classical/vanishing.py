"""Focal length from vanishing points: lines along three perpendicular directions, as rooms and streets are built.

For every focal length of a grid, a frame is asked how much of its line segments the best perpendicular frame of
directions explains; the answers of all frames are added up, since they share the focal length. A frame whose lines do
not depend on it (all fronto-parallel, or none) adds the same everywhere and thereby nothing. This is evidence of its
own: it comes from single pictures and knows nothing of motion, parallax or what moves (Caprile and Torre, IJCV 1990).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vipe_core.priors.classical.claims import FocalClaim
from vipe_core.priors.protocols import WorkingFrame

Array = NDArray[np.float64]

_MIN_LENGTH = 25 / 640
_MAX_SEGMENTS = 120
_MASK_MARGIN = 9
_MIN_SEGMENTS = 15
# How far the end of a segment may lie from the line through its middle and the vanishing point, of 640 px.
_TOLERANCE = 1.5 / 640
_HYPOTHESES = 600
_MAX_POINTS = 12
_SAME_POINT = 0.5
_LOG_STEP = 0.03
_SQUARE_ENOUGH = math.sin(math.radians(60))
_MIN_FOCAL_RATIO, _MAX_FOCAL_RATIO = 0.35, 2.5
# Most of what is seen has to be built along three directions.
_MIN_EXPLAINED = 0.5
# Lines repeat from frame to frame and share their errors: all of them count as so many independent ones.
_EVIDENCE = 60.0
_MIN_LOG_SIGMA, _MAX_LOG_SIGMA = 0.05, 0.3


class VanishingFocal:
    """What the lines of a few frames say about the focal length.

    Args:
        num_frames: How many, evenly spread.
    """

    def __init__(self, num_frames: int = 8) -> None:
        self._num_frames = num_frames

    def claim(self, frames: Sequence[WorkingFrame]) -> FocalClaim | None:
        """Mean and spread of the focal lengths under which the lines follow three perpendicular directions.

        Returns:
            None where they follow none, or fit about as well whatever the focal length.
        """
        logs = np.arange(math.log(_MIN_FOCAL_RATIO), math.log(_MAX_FOCAL_RATIO), _LOG_STEP)
        chosen = np.unique(np.rint(np.linspace(0, len(frames) - 1, self._num_frames)).astype(int))
        found = [_profile(segments(frames[k]), np.exp(logs)) for k in chosen]
        profiles = [row for row in found if row is not None]
        if 2 * len(profiles) < len(chosen):
            return None
        explained = np.mean(profiles, axis=0)
        best = int(explained.argmax())
        if explained[best] < _MIN_EXPLAINED or best in (0, len(logs) - 1):
            return None
        likelihood = np.exp(_EVIDENCE * (explained - explained[best]))
        likelihood /= likelihood.sum()
        mean = float(likelihood @ logs)
        sigma = max(_MIN_LOG_SIGMA, math.sqrt(float(likelihood @ np.square(logs - mean))))
        if sigma > _MAX_LOG_SIGMA:
            return None
        return FocalClaim("vanishing points", mean + math.log(frames[0].gray.shape[1]), sigma, len(profiles))


def segments(frame: WorkingFrame) -> Array:
    """(S, 4) longest line segments (x0, y0, x1, y1) of what may be used, from the centre, in widths."""
    height, width = frame.gray.shape
    lines: Any = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD).detect(frame.gray)[0]
    if lines is None:
        return np.zeros((0, 4))
    if frame.valid is not None:
        # The border of a mask is a line too, but not of the scene.
        inner = cv2.erode(frame.valid.astype(np.uint8), np.ones((_MASK_MARGIN, _MASK_MARGIN), np.uint8))
        middle = np.rint(lines.reshape(-1, 2, 2).mean(axis=1)).astype(np.int64)
        lines = lines[inner[middle[:, 1].clip(0, height - 1), middle[:, 0].clip(0, width - 1)] > 0]
    centre = np.array([(width - 1) / 2, (height - 1) / 2] * 2)
    found = (lines.reshape(-1, 4).astype(np.float64) - centre) / width
    length = np.hypot(found[:, 2] - found[:, 0], found[:, 3] - found[:, 1])
    order = np.argsort(-length, kind="stable")[:_MAX_SEGMENTS]
    return np.asarray(found[order[length[order] > _MIN_LENGTH]], dtype=np.float64)


def _profile(found: Array, focal: Array) -> Array | None:
    """(L,) share of the segments' length that the best perpendicular frame explains at each focal length."""
    if len(found) < _MIN_SEGMENTS:
        return None
    points = _vanishing_points(found)
    if len(points) < 2:
        return None
    length = np.hypot(found[:, 2] - found[:, 0], found[:, 3] - found[:, 1])
    first, second = (i.ravel() for i in np.meshgrid(range(len(points)), range(len(points)), indexing="ij"))
    first, second = first[first != second], second[first != second]
    alone = _fit(found, points) @ length
    best = np.full(len(focal), alone.max())
    for row, f in enumerate(focal):
        directions = points / np.array([f, f, 1.0])
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        one, two = directions[first], directions[second]
        two = two - (one * two).sum(axis=1, keepdims=True) * one
        norm = np.linalg.norm(two, axis=1)
        kept = norm > _SQUARE_ENOUGH
        if not kept.any():
            continue
        one, two = one[kept], two[kept] / norm[kept, None]
        axes = np.stack([one, two, np.cross(one, two)], axis=1) * np.array([f, f, 1.0])
        support = _fit(found, axes.reshape(-1, 3)).reshape(len(one), 3, -1).max(axis=1) @ length
        best[row] = max(best[row], float(support.max()))
    return best / float(length.sum())


def _vanishing_points(found: Array) -> Array:
    """(V, 3) homogeneous points where many segments meet, the best first, each refined by its segments."""
    length = np.hypot(found[:, 2] - found[:, 0], found[:, 3] - found[:, 1])
    lines = np.cross(np.c_[found[:, :2], np.ones(len(found))], np.c_[found[:, 2:], np.ones(len(found))])
    lines /= np.linalg.norm(lines[:, :2], axis=1, keepdims=True)
    rng = np.random.default_rng(0)
    pairs = rng.integers(0, len(found), (_HYPOTHESES, 2))
    points = np.cross(lines[pairs[:, 0]], lines[pairs[:, 1]])
    norm = np.linalg.norm(points, axis=1)
    points = points[norm > 1e-9] / norm[norm > 1e-9, None]
    close: NDArray[np.bool_] = _distance(found, points) < _TOLERANCE
    score = np.asarray(close @ length, dtype=np.float64)
    chosen: list[Array] = []
    taken: list[NDArray[np.bool_]] = []
    for k in np.argsort(-score, kind="stable").tolist():
        inside = close[k]
        if inside.sum() < 3 or len(chosen) == _MAX_POINTS:
            break
        if any((inside & other).sum() > _SAME_POINT * min(inside.sum(), other.sum()) for other in taken):
            continue
        weighted = lines[inside] * length[inside, None]
        chosen.append(np.linalg.svd(weighted)[2][-1])
        taken.append(inside)
    return np.array(chosen).reshape(-1, 3)


def _fit(found: Array, points: Array) -> Array:
    """(V, S) 0..1, how well each segment points at each vanishing point."""
    return np.asarray(np.maximum(0.0, 1 - np.square(_distance(found, points) / _TOLERANCE)), dtype=np.float64)


def _distance(found: Array, points: Array) -> Array:
    """(V, S) distance of each segment's end from the line through its middle and each point."""
    middle = np.c_[(found[:, :2] + found[:, 2:]) / 2, np.ones(len(found))]
    lines = np.cross(points[:, None], middle[None])
    norm = np.maximum(np.hypot(lines[..., 0], lines[..., 1]), 1e-12)
    half = (found[:, 2:] - found[:, :2]) / 2
    return np.asarray(np.abs(lines[..., 0] * half[:, 0] + lines[..., 1] * half[:, 1]) / norm, dtype=np.float64)
