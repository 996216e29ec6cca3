"""Moving things as pixel masks: from what the cells of a frame are known to do, to every pixel of its picture.

Geometry labels the cells that several views measure. Those it leaves open, the inside of plain things and what is seen
from one side only, go with what looks like them: an energy of colour models and edges, cut at a quarter of the size
(GrabCut; Rother et al., SIGGRAPH 2004, as in OpenCV).
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from vipe_core.ba.problem import Grid
from vipe_core.priors.protocols import Match
from vipe_core.slam.consensus import MIN_WEIGHT

Array = NDArray[Any]

MOVING, UNKNOWN, STATIC = 1, 0, -1

# Pixels per side of a cell in the picture that is cut.
_DETAIL = 2
_ITERATIONS = 2
# Fewer cells than this are no thing but errors of matching.
_MIN_CELLS = 6
# Undecided cells are taken for moving at first where most labels within so many cells say so, or the nearest one does.
_REACH_CELLS = 2.0


def carried(labels: Array, match: Match, grid: Grid) -> NDArray[np.float32]:
    """(P,) what the labels (P,) of a frame say about the cells of another that it was matched to: the sum of the labels
    that land in each cell, 0 where none does."""
    known = (match.weight.max(axis=1) > MIN_WEIGHT) & (np.asarray(labels) != UNKNOWN)
    cell = np.rint((match.target_px[known] - grid.offset) / grid.stride).astype(np.int64)
    inside = ((cell >= 0) & (cell < (grid.width, grid.height))).all(axis=1)
    index = cell[inside, 1] * grid.width + cell[inside, 0]
    votes = np.bincount(index, np.asarray(labels, dtype=np.float64)[known][inside], grid.num_cells)
    return votes.astype(np.float32)


def segment(rgb: NDArray[np.uint8], labels: Array, grid: Grid) -> NDArray[np.uint8]:
    """(H, W) uint8 of a picture, 1 where something moves by itself, 0 elsewhere.

    Args:
        rgb: (H, W, 3) at any size.
        labels: (P,) `MOVING`, `STATIC` or `UNKNOWN`.
    """
    height, width = rgb.shape[:2]
    nothing = np.zeros((height, width), dtype=np.uint8)
    cells = np.asarray(labels).reshape(grid.height, grid.width)
    moving = cv2.medianBlur((cells == MOVING).astype(np.uint8), 3)
    trimap = np.where(_leaning(cells, moving), cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    trimap[(cells == STATIC) & (moving == 0)] = cv2.GC_BGD
    trimap[cv2.erode(moving, np.ones((3, 3), np.uint8)) > 0] = cv2.GC_FGD
    # Either side needs something to take its colours from.
    front = (trimap == cv2.GC_FGD) | (trimap == cv2.GC_PR_FGD)
    if int(front.sum()) < _MIN_CELLS or front.all():
        return nothing
    foreground = (trimap == cv2.GC_FGD) | (trimap == cv2.GC_PR_FGD)
    if not foreground.any() or foreground.all():
        # A strip too thin to hold its ground among static cells, or nothing left to hold anything against.
        return nothing
    size = (_DETAIL * grid.width, _DETAIL * grid.height)
    fine = cv2.resize(trimap, size, interpolation=cv2.INTER_NEAREST)
    small = np.ascontiguousarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA))
    # OpenCV's colour models start from its own random numbers.
    cv2.setRNGSeed(0)
    cv2.grabCut(small, fine, None, np.zeros((1, 65)), np.zeros((1, 65)), _ITERATIONS, cv2.GC_INIT_WITH_MASK)
    cut = ((fine == cv2.GC_FGD) | (fine == cv2.GC_PR_FGD)).astype(np.uint8)
    _, parts, statistics, _ = cv2.connectedComponentsWithStats(cut, connectivity=4)
    large = statistics[:, cv2.CC_STAT_AREA] >= _MIN_CELLS * _DETAIL**2
    large[0] = False
    kept = large[parts].astype(np.float32)
    enlarged = cv2.resize(kept, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(enlarged > 0.5, dtype=np.uint8)


def _leaning(cells: Array, moving: Array) -> NDArray[np.bool_]:
    """(h, w) bool, cells that may belong to something that moves: by most labels around them, or by the nearest one.

    A thing that changes its shape leaves few measurements, scattered inside of a hole in the static scene: the nearest
    label knows the hole. Cells that stand alone with it are errors of matching, and the fringes of static things.
    """
    static = cells == STATIC
    if not static.any() or not (cells == MOVING).any():
        return np.zeros(cells.shape, dtype=np.bool_)
    around = cv2.GaussianBlur(moving - np.where(static, np.float32(1), 0), (0, 0), _REACH_CELLS) > 0
    to_moving, to_static = (distance_transform_edt(cells != label) for label in (MOVING, STATIC))
    nearest = cv2.morphologyEx((to_moving < to_static).astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    return np.asarray(around | (nearest > 0), dtype=np.bool_)
