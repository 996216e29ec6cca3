"""What the finished map says about itself: residuals, coverage, parallax, loops, and how sure each depth is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vipe_core.geometry import umeyama
from vipe_core.geometry.arrays import inverse, relative
from vipe_core.slam.graph import Graph
from vipe_core.slam.keyframes import KeyframeMap, Snapshot
from vipe_core.slam.reprojection import Reprojector

Array = NDArray[Any]

_MIN_WEIGHT = 0.05
_LOG_STEP = 0.01
_SURE_LOG_DEPTH = 0.1
# Of the residuals of a whole map, every so many are enough for a median.
_THIN = 4


@dataclass(frozen=True, slots=True)
class MapReport:
    """Diagnostics of a keyframe map of K keyframes.

    Attributes:
        residual_px: Median residual of inliers, working pixels; NaN without measurements.
        inlier_ratio: Share of the measurements' weight within the robust scale, moving cells included: masking what
            does not fit would make any answer look right. 0 without measurements.
        coverage: Share of keyframe cells that at least one edge measures.
        weakest_link: The clip falls apart in two at each step between keyframes but for the edges across it: share of
            cells that fit on the best of those edges, at the worst step. 1 with a single keyframe.
        parallax_deg: Median over keyframes of the median angle between the rays of a point, over its widest edge.
        confidence: (K, P) float32 in 0..1: 0.5 where the inverse depth is determined to 10 % given the poses.
        keyframe_residual_px: (K,) float32 `residual_px` of the edges out of each keyframe.
        keyframe_inlier_ratio: (K,) float32.
        keyframe_coverage: (K,) float32.
    """

    residual_px: float
    inlier_ratio: float
    coverage: float
    weakest_link: float
    parallax_deg: float
    confidence: NDArray[np.float32]
    keyframe_residual_px: NDArray[np.float32]
    keyframe_inlier_ratio: NDArray[np.float32]
    keyframe_coverage: NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class LoopReport:
    """What the edges between keyframes far apart in time did to the map in the last global adjustment.

    Attributes:
        edges: Their number, each counted once.
        residual_before_px: Median residual of their measurements before it, working pixels; NaN without any.
        residual_after_px: The same after it.
        moved_ratio: RMS shift of the keyframes by it after the best similarity, as a share of the path's length.
    """

    edges: int
    residual_before_px: float
    residual_after_px: float
    moved_ratio: float


def examine(reprojector: Reprojector, keyframes: KeyframeMap, graph: Graph, robust_scale_px: float) -> MapReport:
    """Measure every edge of the graph against the map."""
    count, cells = len(keyframes), keyframes.grid.num_cells
    steps = count // keyframes.num_views
    information = np.zeros((count, cells), dtype=np.float64)
    covered = np.zeros((count, cells), dtype=np.bool_)
    parallax = np.zeros(count)
    link = np.zeros(max(steps - 1, 0))
    inside, total = np.zeros(count), np.zeros(count)
    errors: list[list[Array]] = [[] for _ in range(count)]
    for i, j in graph:
        match = graph[i, j]
        target_from_source = relative(keyframes.pose(j), keyframes.pose(i))
        depth = keyframes.depth(i)
        seen_from, seen_in = keyframes.intrinsics_at(i), keyframes.intrinsics_at(j)
        induced = reprojector.induced(seen_from, target_from_source, depth, into=seen_in)
        weight = match.weight.mean(axis=1)
        use = (weight > _MIN_WEIGHT) & np.isfinite(induced.target_px).all(axis=1)
        if not use.any():
            continue
        error = np.linalg.norm(induced.target_px - match.target_px, axis=1)
        inlier = use & (error < robust_scale_px)
        total[i] += float(weight[use].sum())
        inside[i] += float(weight[inlier].sum())
        errors[i].append(error[inlier][::_THIN].astype(np.float32))
        first, last = sorted((keyframes.instant(i), keyframes.instant(j)))
        link[first:last] = np.maximum(link[first:last], float(inlier.mean()))
        covered[i] |= inlier
        # Change of the projection with log depth: what this edge knows about the cell's depth.
        moved = reprojector.induced(seen_from, target_from_source, depth * np.exp(_LOG_STEP), into=seen_in)
        slope = np.linalg.norm(moved.target_px - induced.target_px, axis=1) / _LOG_STEP
        information[i] += np.where(inlier & np.isfinite(slope), weight * slope**2, 0.0)
        if inlier.any():
            angle = reprojector.parallax_deg(seen_from, target_from_source, depth)
            parallax[i] = max(parallax[i], float(np.median(angle[inlier])))
    sigma = 1.0 / np.sqrt(np.maximum(information, 1e-12))
    confidence = 1.0 / (1.0 + np.square(sigma / _SURE_LOG_DEPTH))
    return MapReport(
        residual_px=_median([error for each in errors for error in each]),
        inlier_ratio=float(inside.sum() / total.sum()) if total.sum() > 0 else 0.0,
        coverage=float(covered.mean()) if count else 0.0,
        weakest_link=float(link.min()) if len(link) else 1.0,
        parallax_deg=float(np.median(parallax)) if count else 0.0,
        confidence=np.where(information > 0, confidence, 0.0).astype(np.float32),
        keyframe_residual_px=np.array([_median(each) for each in errors], dtype=np.float32),
        keyframe_inlier_ratio=np.divide(inside, total, out=np.zeros(count), where=total > 0).astype(np.float32),
        keyframe_coverage=covered.mean(axis=1, dtype=np.float64).astype(np.float32),
    )


def combine(reports: Sequence[MapReport]) -> MapReport:
    """One report of several maps: means over their keyframes, and the weakest of their links."""
    if len(reports) == 1:
        return reports[0]
    share = np.array([len(report.confidence) for report in reports], dtype=np.float64)
    # A map of one keyframe has measured nothing: it says nothing about the others.
    measured = np.array([np.isfinite(report.residual_px) for report in reports])
    weight = np.where(measured, share, 0.0) if measured.any() else share

    def mean(values: Sequence[float]) -> float:
        return float(np.average(np.where(weight > 0, values, 0.0), weights=weight))

    return MapReport(
        residual_px=mean([report.residual_px for report in reports]),
        inlier_ratio=mean([report.inlier_ratio for report in reports]),
        coverage=float(np.average([report.coverage for report in reports], weights=share)),
        weakest_link=min(report.weakest_link for report in reports),
        parallax_deg=mean([report.parallax_deg for report in reports]),
        confidence=np.concatenate([report.confidence for report in reports]),
        keyframe_residual_px=np.concatenate([report.keyframe_residual_px for report in reports]),
        keyframe_inlier_ratio=np.concatenate([report.keyframe_inlier_ratio for report in reports]),
        keyframe_coverage=np.concatenate([report.keyframe_coverage for report in reports]),
    )


def examine_loops(
    reprojector: Reprojector,
    keyframes: KeyframeMap,
    graph: Graph,
    before: Snapshot,
    neighbours: int,
) -> LoopReport:
    """Compare the map with what it was `before`, of the same keyframes."""
    loops = [(i, j) for i, j in graph if abs(keyframes.instant(i) - keyframes.instant(j)) > neighbours]
    poses, depths, intrinsics, *_ = before
    per_view = np.atleast_2d(intrinsics)
    errors_before: list[Array] = []
    errors_after: list[Array] = []
    for i, j in loops:
        match = graph[i, j]
        use = match.weight.mean(axis=1) > _MIN_WEIGHT
        seen_from, seen_in = (per_view[k % len(per_view)] for k in (i, j))
        old = reprojector.induced(seen_from, relative(poses[j], poses[i]), depths[i], into=seen_in)
        new = reprojector.edge(keyframes, i, j)
        for induced, errors in ((old, errors_before), (new, errors_after)):
            error = np.linalg.norm(induced.target_px[use] - match.target_px[use], axis=1)
            # A cell that the map puts behind the camera is wrong by more than any picture is wide.
            errors.append(np.nan_to_num(error, nan=np.inf)[::_THIN])
    was, centres = inverse(poses)[:, :3, 3], inverse(keyframes.poses())[:, :3, 3]
    length = float(np.linalg.norm(np.diff(centres, axis=0), axis=1).sum())
    moved = 0.0
    if len(centres) > 2 and length > 0:
        shift = umeyama(was, centres).apply(was) - centres
        moved = float(np.sqrt(np.square(shift).sum(axis=1).mean())) / length
    return LoopReport(len(loops) // 2, _median(errors_before), _median(errors_after), moved)


def _median(parts: Sequence[Array]) -> float:
    values = np.concatenate(parts) if parts else np.zeros(0)
    return float(np.median(values)) if len(values) else float("nan")
