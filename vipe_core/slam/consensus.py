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

from vipe_core.cameras.ideal import ideal_camera, ideal_px
from vipe_core.compilation import compiled
from vipe_core.priors.protocols import Match
from vipe_core.slam.keyframes import KeyframeMap
from vipe_core.slam.reprojection import MIN_DEPTH_RATIO, Reprojector

Array = NDArray[Any]

MIN_WEIGHT = 0.02
"""Raw weight from which a cell counts as measured: its flow passed the check and it is not perfectly blank."""

MAJORITY = 0.5
"""Share of the cells that must agree on a pose for it to be believed."""

# Squared sine between the baseline and a ray, in units of the squared baseline, below which no depth follows.
_NO_BASELINE = 1e-18
_MIN_POINTS = 50
_MAX_POINTS = 600
# The squared root of the unified model at which a pixel is taken to be off its image disk; `projection.py`.
_MIN_DISK = 1e-6


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
    into: Sequence[Array] | None = None,
) -> Agreement:
    """Find for every cell the inverse depth that the measurements of most views agree on.

    Each view proposes the depth that its own measurement triangulates to, and `current` may propose another. The
    proposal with the lowest truncated cost over all views wins.

    Args:
        intrinsics: (K,) index parameters.
        target_from_source: (E, 4, 4), one per match; at least one.
        threshold_px: Where the cost of a measurement is cut off.
        current: (P,) inverse depth, or None.
        into: (K,) index parameters of the other views' cameras, where they have others.
    """
    relative = np.ascontiguousarray(target_from_source, dtype=np.float64)
    target_px = np.stack([match.target_px for match in matches]).astype(np.float32, copy=False)
    weight = np.stack([match.weight for match in matches]).astype(np.float32, copy=False)
    rays = reprojector.rays(intrinsics)
    no_current = np.full(len(rays), np.nan)
    views, cells = weight.shape[:2]
    cameras = np.zeros((views, 5))
    for view in range(views):
        params = np.asarray(intrinsics if into is None else into[view], dtype=np.float64)
        cameras[view, : len(params)] = params
    best = np.empty(cells, np.float32)
    measured = np.empty((views, cells), np.bool_)
    error_px = np.empty((views, cells), np.float32)
    _agree(
        np.ascontiguousarray(rays),
        cameras,
        reprojector.model == "mei",
        relative,
        target_px,
        weight,
        no_current if current is None else np.asarray(current, dtype=np.float64),
        threshold_px,
        MIN_DEPTH_RATIO,
        best,
        measured,
        error_px,
    )
    return Agreement(best, measured, error_px)


@compiled
def _agree(
    rays: Array,
    cameras: Array,
    unified: bool,
    relative: Array,
    target_px: Array,
    weight: Array,
    current: Array,
    threshold_px: float,
    min_depth_ratio: float,
    best: Array,
    measured: Array,
    error_px: Array,
) -> None:
    """`agree` cell by cell, for pinholes or unified cameras (fx, fy, cx, cy, alpha), one per view.

    Along an edge of the picture the flow is not measured: that component counts by its share, as in the adjustment.
    """
    views = len(relative)
    turned = np.empty((views, 3))
    share = np.empty((views, 2))
    error, best_error = np.empty(views), np.empty(views)
    for cell in range(len(rays)):
        x, y, z = rays[cell, 0], rays[cell, 1], rays[cell, 2]
        for view in range(views):
            pose = relative[view]
            turned[view, 0] = pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z
            turned[view, 1] = pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z
            turned[view, 2] = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z
            strongest = max(weight[view, cell, 0], weight[view, cell, 1])
            measured[view, cell] = strongest > MIN_WEIGHT
            share[view, 0] = weight[view, cell, 0] / max(strongest, 1e-12)
            share[view, 1] = weight[view, cell, 1] / max(strongest, 1e-12)
            best_error[view] = np.inf
        best_cost, best_depth = np.inf, np.nan
        for proposal in range(views + 1):
            if proposal == views:
                depth = current[cell]
            else:
                # The point a + b d (a = R ray, b = t) lies on the target's ray r where r x (a + b d) = 0, least
                # squares in d. It may be negative: behind the camera, or beyond infinity.
                fx, fy, cx, cy = cameras[proposal, 0], cameras[proposal, 1], cameras[proposal, 2], cameras[proposal, 3]
                alpha = cameras[proposal, 4]
                rx = (target_px[proposal, cell, 0] - cx) / fx
                ry = (target_px[proposal, cell, 1] - cy) / fy
                rz = 1.0
                if unified:
                    radius = rx * rx + ry * ry
                    eta = (alpha + math.sqrt(max(1 + (1 - alpha * alpha) * radius, _MIN_DISK))) / (1 + radius)
                    rx, ry, rz = eta * rx, eta * ry, eta - alpha
                ax, ay, az = turned[proposal, 0], turned[proposal, 1], turned[proposal, 2]
                bx, by, bz = relative[proposal, 0, 3], relative[proposal, 1, 3], relative[proposal, 2, 3]
                ox, oy, oz = ry * az - rz * ay, rz * ax - rx * az, rx * ay - ry * ax
                sx, sy, sz = ry * bz - rz * by, rz * bx - rx * bz, rx * by - ry * bx
                length = sx * sx + sy * sy + sz * sz
                if not length > _NO_BASELINE * (rx * rx + ry * ry + rz * rz):
                    continue
                depth = -(ox * sx + oy * sy + oz * sz) / length
            if not (depth > 0 and depth < np.inf):
                continue
            cost = 0.0
            for view in range(views):
                error[view] = np.inf
                if not measured[view, cell]:
                    continue
                fx, fy, cx, cy = cameras[view, 0], cameras[view, 1], cameras[view, 2], cameras[view, 3]
                alpha = cameras[view, 4]
                px = turned[view, 0] + relative[view, 0, 3] * depth
                py = turned[view, 1] + relative[view, 1, 3] * depth
                pz = turned[view, 2] + relative[view, 2, 3] * depth
                ahead, scale = pz > min_depth_ratio, pz
                if unified:
                    norm = math.sqrt(px * px + py * py + pz * pz)
                    scale = pz + alpha * norm
                    ahead = norm > min_depth_ratio and scale > 1e-9 * norm and alpha * pz > -norm
                if ahead:
                    du = fx * px / scale + cx - target_px[view, cell, 0]
                    dv = fy * py / scale + cy - target_px[view, cell, 1]
                    squared = share[view, 0] * du * du + share[view, 1] * dv * dv
                    if squared < np.inf:
                        error[view] = math.sqrt(squared)
                cost += min(error[view] / threshold_px, 1.0) ** 2
                if not cost < best_cost:
                    break
            if cost < best_cost:
                best_cost, best_depth = cost, depth
                best_error[:] = error
        best[cell] = best_depth
        for view in range(views):
            error_px[view, cell] = best_error[view]


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
    world, (px, ahead) = np.concatenate(points), ideal_px(keyframes.camera, np.concatenate(seen))
    world, px = world[ahead], px[ahead]
    if len(world) < _MIN_POINTS:
        return None
    kept = np.linspace(0, len(world) - 1, min(len(world), _MAX_POINTS * len(views))).astype(np.int64)
    ransac = {"max_iterations": 1000, "min_iterations": 100, "max_reproj_error": threshold_px, "seed": 0}
    camera = ideal_camera(keyframes.camera)
    pose, report = poselib.estimate_absolute_pose(px[kept], world[kept], camera, ransac, {})
    found = np.eye(4)
    found[:3, :3], found[:3, 3] = pose.R, pose.t
    share = float(report["inlier_ratio"])
    return (found, share) if np.isfinite(found).all() and math.isfinite(share) else None
