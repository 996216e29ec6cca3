"""OpenCV's semi-global stereo matcher on pairs of frames of a video with known poses: the textbook way to depth.

A frame is paired with the neighbour whose baseline suits it best, the two pictures are rectified along the baseline,
and what the matcher leaves open stays open. Motion along the optical axis cannot be rectified: such frames get nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vipe_core.cameras import Camera
from vipe_core.geometry.arrays import inverse

# Parallax of the median depth that is looked for, as a share of the width, and the least angle between the baseline and
# the optical axis at which a picture can still be rectified.
_PARALLAX = 0.06
_MIN_ANGLE_DEG = 40.0
_MAX_TURN_DEG = 25.0
_NEIGHBOURS = 40
_BLOCK = 5
_MAX_DISPARITIES = 256


def stereo_depth(
    index: int,
    pictures: Callable[[int], NDArray[np.uint8]],
    world_from_cam: NDArray[np.float64],
    camera: Camera,
    median_depth: float,
    near_depth: float,
) -> NDArray[np.float32] | None:
    """(h, w) z of a frame at the camera's size, 0 where nothing was found; None without a neighbour to pair it with.

    Args:
        pictures: Gray (h, w) by frame index.
        world_from_cam: (N, 4, 4).
        camera: Pinhole.
        median_depth, near_depth: Of the frame, in units of the poses.
    """
    partner = _partner(index, world_from_cam, camera, median_depth)
    if partner is None:
        return None
    motion = inverse(world_from_cam[partner]) @ world_from_cam[index]
    # The baseline: centre of the partner as the frame sees it.
    baseline = -motion[:3, :3].T @ motion[:3, 3]
    length = float(np.linalg.norm(baseline))
    axis = baseline / length
    # The baseline points to the right of the rectified view, whichever way that turns the picture.
    down = np.cross([0.0, 0.0, 1.0], axis)
    down /= np.linalg.norm(down)
    rectified_from_frame = np.stack([axis, down, np.cross(axis, down)])
    side = int(1.2 * max(camera.width, camera.height))
    focal = camera.focal_px
    # The view is centred on what the frame looks at.
    ahead_px = focal * rectified_from_frame[:2, 2] / rectified_from_frame[2, 2]
    centre = side / 2 - ahead_px
    rays = Camera("pinhole", (focal, focal, float(centre[0]), float(centre[1])), side, side).rays()
    left = _seen(pictures(index), camera, rays @ rectified_from_frame)
    right = _seen(pictures(partner), camera, rays @ rectified_from_frame @ motion[:3, :3].T)
    disparities = int(np.clip(16 * np.ceil(focal * length / near_depth / 16), 16, _MAX_DISPARITIES))
    create: Any = cv2.StereoSGBM.create
    matcher = create(
        minDisparity=0,
        numDisparities=disparities,
        blockSize=_BLOCK,
        P1=8 * _BLOCK**2,
        P2=32 * _BLOCK**2,
        disp12MaxDiff=1,
        uniquenessRatio=10,
        speckleWindowSize=100,
        speckleRange=2,
    )
    disparity = matcher.compute(left, right).astype(np.float32) / 16
    own = camera.rays()
    turned = own @ rectified_from_frame.T
    ahead = turned[..., 2] > 1e-6
    scale = np.where(ahead, turned[..., 2], 1)
    at = (focal * turned[..., :2] / scale[..., None] + centre - 0.5).astype(np.float32)
    sampled = cv2.remap(disparity, at[..., 0], at[..., 1], cv2.INTER_NEAREST, borderValue=-1)
    found = ahead & (sampled > 0)
    # z of the rectified view along the same ray, in the frame's own direction.
    depth = np.where(found, focal * length / np.where(found, sampled, 1) / scale, 0)
    return np.asarray(depth, np.float32)


def _partner(index: int, world_from_cam: NDArray[np.float64], camera: Camera, median_depth: float) -> int | None:
    """The neighbour with the most suitable baseline that can be rectified."""
    wanted = _PARALLAX * camera.width / camera.focal_px * median_depth
    best: tuple[float, int] | None = None
    for j in range(max(0, index - _NEIGHBOURS), min(len(world_from_cam), index + _NEIGHBOURS + 1)):
        motion = inverse(world_from_cam[j]) @ world_from_cam[index]
        baseline = -motion[:3, :3].T @ motion[:3, 3]
        length = float(np.linalg.norm(baseline))
        if j == index or length < 1e-9:
            continue
        angle_deg = np.degrees(np.arccos(min(1.0, abs(baseline[2]) / length)))
        turned_deg = np.degrees(np.arccos(np.clip(motion[2, 2], -1, 1)))
        if angle_deg < _MIN_ANGLE_DEG or turned_deg > _MAX_TURN_DEG:
            continue
        score = abs(float(np.log(length / wanted))), j
        best = score if best is None else min(best, score)
    return None if best is None else best[1]


def _seen(gray: NDArray[np.uint8], camera: Camera, directions: NDArray[np.float64]) -> NDArray[np.uint8]:
    px, imaged = camera.project(directions)
    at = np.where(imaged[..., None], px, -1e4).astype(np.float32)
    return np.asarray(cv2.remap(gray, at[..., 0], at[..., 1], cv2.INTER_LINEAR), np.uint8)
