"""Best-effort motion mask from geometry alone: cells whose measurements contradict the camera motion on most edges.

The paper masks by semantics; without a segmenter this is what the residuals can say. It finds things that move against
textured static surroundings. It cannot find what fills most of the picture.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vipe_core.slam.graph import Graph
from vipe_core.slam.keyframes import KeyframeMap
from vipe_core.slam.reprojection import Reprojector

Array = NDArray[Any]

_MIN_WEIGHT = 0.05
_MIN_EDGES = 2
_CONTRADICTED = 0.6
_MAX_MOVING = 0.6


def moving_cells(
    reprojector: Reprojector, keyframes: KeyframeMap, graph: Graph, k: int, threshold_px: float
) -> NDArray[np.bool_]:
    """(P,) bool, True on cells of keyframe `k` that appear to move by themselves.

    A cell moves when at least two edges measure it and most of them disagree with the reprojection by more than
    `threshold_px`. Specks are dropped and the rest grows by a cell, because flow bleeds over borders. Should most of
    the measured picture disagree, the geometry is wrong rather than the picture, and nothing is masked.
    """
    grid = keyframes.grid
    measured = np.zeros(grid.num_cells, dtype=np.float32)
    contradicted = np.zeros(grid.num_cells, dtype=np.float32)
    for j in graph.targets(k):
        match = graph[k, j]
        induced = reprojector.edge(keyframes, k, j)
        counts = (match.weight.max(axis=1) > _MIN_WEIGHT) & np.isfinite(induced.target_px).all(axis=1)
        error = np.linalg.norm(np.where(counts[:, None], induced.target_px - match.target_px, 0.0), axis=1)
        measured += counts
        contradicted += counts & (error > threshold_px)
    moving = (measured >= _MIN_EDGES) & (contradicted > _CONTRADICTED * measured)
    if moving.sum() > _MAX_MOVING * max(1, int((measured >= _MIN_EDGES).sum())):
        return np.zeros(grid.num_cells, dtype=np.bool_)
    image = moving.reshape(grid.height, grid.width).astype(np.uint8)
    image = cv2.morphologyEx(image, cv2.MORPH_OPEN, np.ones((2, 2), np.uint8))
    image = cv2.dilate(image, np.ones((3, 3), np.uint8))
    return np.asarray(image, dtype=np.bool_).reshape(-1)
