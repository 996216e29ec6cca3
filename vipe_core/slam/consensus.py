"""What the cells of a keyframe agree on across several views: the depth that most measurements support, and the pose
that most of the picture supports.

Both count area: a cell that is measured has one vote, however strong its texture. A textured thing that moves then
weighs no more than the blank wall behind it, while the precision of the adjustment that follows still comes from the
texture. One pair of views cannot tell a thing that moves along its epipolar line from one at another depth; the same
depth has to explain all of them here.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import poselib
from numpy.typing import NDArray

from vipe_core.priors.protocols import Match
from vipe_core.slam.keyframes import KeyframeMap
from vipe_core.slam.reprojection import Reprojector

Array = NDArray[Any]

MIN_WEIGHT = 0.02
"""Raw weight from which a cell counts as measured: its flow passed the check and it is not perfectly blank."""

MAJORITY = 0.5
"""Share of the cells that must agree on a pose for it to be believed."""

_MIN_POINTS = 50
_MAX_POINTS = 1500


@dataclass(frozen=True, slots=True)
class Agreement:
    """The cells of one keyframe against E other views.

    Attributes:
        inverse_depth: (P,) float32 the depth that explains most views; NaN where no view gives one.
        measured: (E, P) bool.
        error_px: (E, P) float32 distance of the measurements from that depth's reprojection; infinite where there is
            none of either.
    """

    inverse_depth: NDArray[np.float32]
    measured: NDArray[np.bool_]
    error_px: NDArray[np.float32]

    @property
    def votes(self) -> NDArray[np.int64]:
        """(P,) number of views that measure each cell."""
        return np.asarray(self.measured.sum(axis=0), dtype=np.int64)

    def support(self, threshold_px: float) -> NDArray[np.int64]:
        """(P,) number of views that the depth explains to within `threshold_px`."""
        return np.asarray((self.error_px < threshold_px).sum(axis=0), dtype=np.int64)


def agree(
    reprojector: Reprojector,
    intrinsics: Array,
    target_from_source: Array,
    matches: Sequence[Match],
    threshold_px: float,
    current: Array | None = None,
) -> Agreement:
    """Find for every cell the inverse depth that the measurements of most views agree on.

    Each view proposes the depth that its own measurement triangulates to, and `current` may propose another. The
    proposal with the lowest truncated cost over all views wins.

    Args:
        target_from_source: (E, 4, 4), one per match; at least one.
        threshold_px: Where the cost of a measurement is cut off.
        current: (P,) inverse depth, or None.
    """
    relative = np.asarray(target_from_source, dtype=np.float64)
    target_px = np.stack([match.target_px for match in matches]).astype(np.float64)
    weight = np.stack([match.weight for match in matches])
    strongest = weight.max(axis=2)
    measured = strongest > MIN_WEIGHT
    # Along an edge of the picture the flow is not measured: that component counts by its share, as in the adjustment.
    share = weight / np.maximum(strongest, 1e-12)[..., None]
    proposals = [triangulate(reprojector, intrinsics, pose, px) for pose, px in zip(relative, target_px, strict=True)]
    if current is not None:
        proposals.append(np.asarray(current, dtype=np.float64))
    best_cost = np.full(measured.shape[1], np.inf)
    best = np.full(measured.shape[1], np.nan)
    best_error = np.full(measured.shape, np.inf)
    for proposal in proposals:
        possible = np.isfinite(proposal) & (proposal > 0)
        depth = np.where(possible, proposal, 0.0)
        induced = reprojector.induced(intrinsics, relative, np.tile(depth, (len(measured), 1)))
        error = induced.target_px - target_px
        seen = measured & np.isfinite(error).all(axis=2)
        error_px = np.where(seen, np.sqrt((share * np.square(np.nan_to_num(error))).sum(axis=2)), np.inf)
        cost = np.where(measured, np.minimum(error_px / threshold_px, 1.0) ** 2, 0.0).sum(axis=0)
        better = possible & (cost < best_cost)
        best_cost = np.where(better, cost, best_cost)
        best = np.where(better, depth, best)
        best_error = np.where(better, error_px, best_error)
    return Agreement(best.astype(np.float32), measured, best_error.astype(np.float32))


def triangulate(
    reprojector: Reprojector, intrinsics: Array, target_from_source: Array, target_px: Array
) -> NDArray[np.float64]:
    """(P,) inverse depth along the source rays for which the point is seen at `target_px`.

    The point a + b d (a = R ray, b = t) lies on the target's ray r where r x (a + b d) = 0, least squares in d. It may
    be negative (behind the camera, or beyond infinity); NaN without a baseline.
    """
    relative = np.asarray(target_from_source, dtype=np.float64)
    rays = reprojector.rays(intrinsics) @ relative[:3, :3].T
    seen = reprojector.rays(intrinsics, target_px)
    seen = seen / np.linalg.norm(seen, axis=1, keepdims=True)
    offset = np.cross(seen, rays)
    slope = np.cross(seen, relative[:3, 3])
    length = np.square(slope).sum(axis=1)
    known = length > 1e-18
    return np.where(known, -(offset * slope).sum(axis=1) / np.where(known, length, 1.0), np.nan)


def consensus_pose(
    reprojector: Reprojector,
    keyframes: KeyframeMap,
    views: Sequence[tuple[int, Match]],
    usable: Sequence[Array],
    threshold_px: float,
) -> tuple[NDArray[np.float64], float] | None:
    """The pose of a new view that explains the largest area of the placed keyframes that were matched to it.

    Args:
        views: Placed keyframes with their matches into the new view.
        usable: (P,) bool for each, the cells whose depth is known.

    Returns:
        cam_from_world (4, 4) and the share of the cells it explains; None with too few of them.
    """
    points, seen = [], []
    rays = reprojector.rays(keyframes.intrinsics)
    for (k, match), known in zip(views, usable, strict=True):
        cells = np.flatnonzero(known & (match.weight.max(axis=1) > MIN_WEIGHT))
        world_from_cam = np.linalg.inv(keyframes.pose(k))
        depth = keyframes.depth(k)[cells].astype(np.float64)
        local = rays[cells] / depth[:, None]
        points.append(local @ world_from_cam[:3, :3].T + world_from_cam[:3, 3])
        seen.append(match.target_px[cells].astype(np.float64))
    world, px = np.concatenate(points), np.concatenate(seen)
    if len(world) < _MIN_POINTS:
        return None
    kept = np.linspace(0, len(world) - 1, min(len(world), _MAX_POINTS * len(views))).astype(np.int64)
    ransac = {"max_iterations": 1000, "min_iterations": 100, "max_reproj_error": threshold_px, "seed": 0}
    camera = pinhole_camera(keyframes)
    pose, report = poselib.estimate_absolute_pose(px[kept], world[kept], camera, ransac, {})
    found = np.eye(4)
    found[:3, :3], found[:3, 3] = pose.R, pose.t
    share = float(report["inlier_ratio"])
    return (found, share) if np.isfinite(found).all() and math.isfinite(share) else None


def pinhole_camera(keyframes: KeyframeMap) -> dict[str, Any]:
    """The camera of the map in the form that PoseLib takes, for index coordinates."""
    grid = keyframes.grid
    return {
        "model": "PINHOLE",
        "width": int(grid.width * grid.stride),
        "height": int(grid.height * grid.stride),
        "params": [float(value) for value in keyframes.intrinsics[:4]],
    }
