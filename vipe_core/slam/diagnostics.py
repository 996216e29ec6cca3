"""What the finished map says about itself: residuals, coverage, parallax, and how well each depth is determined."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vipe_core.slam.graph import Graph
from vipe_core.slam.keyframes import KeyframeMap
from vipe_core.slam.reprojection import Reprojector, relative_pose

Array = NDArray[Any]

_MIN_WEIGHT = 0.05
_LOG_STEP = 0.01
_SURE_LOG_DEPTH = 0.1


@dataclass(frozen=True, slots=True)
class MapReport:
    """Diagnostics of a keyframe map.

    Attributes:
        residual_px: Median residual of inliers, working pixels; NaN without measurements.
        inlier_ratio: Share of the measurements' weight within the robust scale, moving cells included: masking what
            does not fit would make any answer look right. 0 without measurements.
        coverage: Share of keyframe cells that at least one edge measures.
        weakest_link: The clip falls apart in two at each step between keyframes but for the edges across it: share of
            cells that fit on the best of those edges, at the worst step. 1 with a single keyframe.
        parallax_deg: Median over keyframes of the median angle between the rays of a point, over its widest edge.
        confidence: (K, P) float32 in 0..1: 0.5 where the inverse depth is determined to 10 % given the poses.
    """

    residual_px: float
    inlier_ratio: float
    coverage: float
    weakest_link: float
    parallax_deg: float
    confidence: NDArray[np.float32]


def examine(reprojector: Reprojector, keyframes: KeyframeMap, graph: Graph, robust_scale_px: float) -> MapReport:
    """Measure every edge of the graph against the map."""
    count, cells = len(keyframes), keyframes.grid.num_cells
    information = np.zeros((count, cells), dtype=np.float64)
    covered = np.zeros((count, cells), dtype=np.bool_)
    parallax = np.zeros(count)
    link = np.zeros(max(count - 1, 0))
    inside = total = 0.0
    errors: list[Array] = []
    for i, j in graph:
        match = graph[i, j]
        relative = relative_pose(keyframes.pose(j), keyframes.pose(i))
        depth = keyframes.depth(i)
        induced = reprojector.induced(keyframes.intrinsics, relative, depth)
        weight = match.weight.mean(axis=1)
        use = (weight > _MIN_WEIGHT) & np.isfinite(induced.target_px).all(axis=1)
        if not use.any():
            continue
        error = np.linalg.norm(induced.target_px - match.target_px, axis=1)
        inlier = use & (error < robust_scale_px)
        total += float(weight[use].sum())
        inside += float(weight[inlier].sum())
        errors.append(error[inlier])
        first, last = min(i, j), max(i, j)
        link[first:last] = np.maximum(link[first:last], float(inlier.mean()))
        covered[i] |= inlier
        # Change of the projection with log depth: what this edge knows about the cell's depth.
        moved = reprojector.induced(keyframes.intrinsics, relative, depth * np.exp(_LOG_STEP))
        slope = np.linalg.norm(moved.target_px - induced.target_px, axis=1) / _LOG_STEP
        information[i] += np.where(inlier & np.isfinite(slope), weight * slope**2, 0.0)
        if inlier.any():
            angle = reprojector.parallax_deg(keyframes.intrinsics, relative, depth)
            parallax[i] = max(parallax[i], float(np.median(angle[inlier])))
    sigma = 1.0 / np.sqrt(np.maximum(information, 1e-12))
    confidence = 1.0 / (1.0 + np.square(sigma / _SURE_LOG_DEPTH))
    residuals = np.concatenate(errors) if errors else np.zeros(0)
    return MapReport(
        residual_px=float(np.median(residuals)) if len(residuals) else float("nan"),
        inlier_ratio=inside / total if total > 0 else 0.0,
        coverage=float(covered.mean()) if count else 0.0,
        weakest_link=float(link.min()) if len(link) else 1.0,
        parallax_deg=float(np.median(parallax)) if count else 0.0,
        confidence=np.where(information > 0, confidence, 0.0).astype(np.float32),
    )
