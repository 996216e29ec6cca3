"""The pose of a rig that most of what its views see agrees on; `consensus.py` for a single camera."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import poselib
from numpy.typing import NDArray

from vipe_core.cameras.ideal import ideal_camera, ideal_px
from vipe_core.geometry.arrays import inverse
from vipe_core.priors.protocols import Match
from vipe_core.slam.consensus import MIN_WEIGHT
from vipe_core.slam.keyframes import KeyframeMap
from vipe_core.slam.reprojection import Reprojector

Array = NDArray[Any]

_MIN_POINTS = 50
# Per measured pair of views.
_MAX_POINTS = 400


@dataclass(frozen=True, slots=True)
class Sighting:
    """A placed keyframe's match into a view of the instant that is to be placed.

    Attributes:
        keyframe: Its number.
        view: The view of the new instant.
        usable: (P,) bool, cells of the keyframe whose depth is known.
    """

    keyframe: int
    view: int
    match: Match
    usable: NDArray[np.bool_]


def consensus_rig_pose(
    reprojector: Reprojector, keyframes: KeyframeMap, sightings: Sequence[Sighting], threshold_px: float
) -> tuple[NDArray[np.float64], float] | None:
    """The pose of a new instant that explains the largest area of the placed keyframes that were matched to it.

    Returns:
        rig_from_world (4, 4) and the share of the cells it explains; None with too few of them.
    """
    assert keyframes.cam_from_rig is not None
    seen: list[list[Array]] = [[] for _ in keyframes.cam_from_rig]
    world: list[list[Array]] = [[] for _ in keyframes.cam_from_rig]
    for sighting in sightings:
        k, match = sighting.keyframe, sighting.match
        cells = np.flatnonzero(sighting.usable & (match.weight.max(axis=1) > MIN_WEIGHT))
        px, ahead = ideal_px(keyframes.camera_of(sighting.view), match.target_px[cells].astype(np.float64))
        cells, px = cells[ahead], px[ahead]
        kept = np.linspace(0, len(cells) - 1, min(len(cells), _MAX_POINTS)).astype(np.int64)
        cells, px = cells[kept], px[kept]
        rays = reprojector.rays(keyframes.intrinsics_at(k))[cells]
        local = rays / keyframes.depth(k)[cells, None].astype(np.float64)
        world_from_cam = inverse(keyframes.pose(k))
        world[sighting.view].append(local @ world_from_cam[:3, :3].T + world_from_cam[:3, 3])
        seen[sighting.view].append(px)
    if sum(len(part) for parts in seen for part in parts) < _MIN_POINTS:
        return None
    views = [view for view, parts in enumerate(seen) if parts]
    mounts, cameras = [], []
    for view in views:
        mount = poselib.CameraPose()
        mount.R, mount.t = keyframes.cam_from_rig[view][:3, :3], keyframes.cam_from_rig[view][:3, 3]
        mounts.append(mount)
        cameras.append(ideal_camera(keyframes.camera_of(view)))
    ransac = {"max_iterations": 1000, "min_iterations": 100, "max_reproj_error": threshold_px, "seed": 0}
    pose, report = poselib.estimate_generalized_absolute_pose(
        [np.concatenate(seen[view]) for view in views],
        [np.concatenate(world[view]) for view in views],
        mounts,
        cameras,
        ransac,
        {},
    )
    found = np.eye(4)
    found[:3, :3], found[:3, 3] = pose.R, pose.t
    share = float(report["inlier_ratio"])
    return (found, share) if np.isfinite(found).all() and math.isfinite(share) else None
