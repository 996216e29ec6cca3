"""The height of the camera above the ground, from the map of its keyframes.

A plane at height h below a camera with unit normal n (downwards) is seen at inverse depth d = n . r / h along the ray
r. So planes are judged in inverse depth, where the errors of the map are of one size, over some successive keyframes
together; those votes give the height of the whole shot.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vipe_core.depth.projection import MapProjector
from vipe_core.depth.scale import FrameRatio, ScaleEstimate, scale_from_ratios
from vipe_core.depth.types import SceneMap
from vipe_core.errors import ScaleUnobservable
from vipe_core.statistics import consensus

Array = NDArray[Any]

# Keyframes that look for the ground together, and points of each that take part.
_TOGETHER, _POINTS = 9, 1500
_HYPOTHESES, _JUDGES = 1500, 3000
# Relative error of an inverse depth that still lies on the plane (a noisier map needs the wider one, which is worth
# less), and the share of the median that is added to what it is relative to.
_TOLERANCES, _FLOOR = (0.03, 0.05), 0.3
# Widths of the kernels of the refinement in units of it: the map is often better.
_WIDTHS = (1.0, 1.0, 0.7, 0.5, 0.5, 0.5)
# Cameras are held without much roll, but may look down: how far the ground may seem tilted to either side and forwards.
_MAX_ROLL_DEG, _MAX_PITCH_DEG = 15.0, 50.0
# The least share of the points that must lie on the ground, and the least count.
_MIN_SHARE, _MIN_INLIERS = 0.04, 100
# Nothing lies below the ground: points that would, as a share of those on it. Each costs as much as two on it bring.
_MAX_BELOW, _BELOW_COST = 0.15, 2.0
# The least share of the groups that must find ground, and the largest difference in height of those that agree.
_MIN_FOUND, _AGREE = 0.4, 0.1


@dataclass(frozen=True, slots=True)
class _Points:
    """Points of some keyframes.

    Attributes:
        rays: (n, 3) in the axes of the world, as long as the camera model's.
        centres: (n, 3) of the camera that measured each.
        inverse_depth: (n,) along the rays.
        weight: (n,).
        sigma: (n,) error of the inverse depth that is ordinary.
    """

    rays: NDArray[np.float64]
    centres: NDArray[np.float64]
    inverse_depth: NDArray[np.float64]
    weight: NDArray[np.float64]
    sigma: NDArray[np.float64]

    def some(self, chosen: Array) -> _Points:
        parts = (self.rays, self.centres, self.inverse_depth, self.weight, self.sigma)
        return _Points(*(part[chosen] for part in parts))

    def residuals(self, normals: Array, offsets: Array) -> NDArray[np.float64]:
        """(m, n) inverse depths minus those of m planes normal . x = offset, over what counts as ordinary: negative
        is below."""
        d = self.inverse_depth
        height = offsets[:, None] - normals @ self.centres.T
        expected = (normals @ self.rays.T) / np.where(height > 0, height, np.inf)
        return np.asarray((d - expected) / self.sigma)


def scale_from_height(scene: SceneMap, shot: tuple[int, int], height_m: float) -> ScaleEstimate:
    """From the height of the camera above the ground, which must be in view.

    Raises:
        ScaleUnobservable: No plane below the camera is found, or parts of the shot disagree about it.
    """
    numbers = np.flatnonzero((scene.keyframes >= shot[0]) & (scene.keyframes < shot[1]))
    projector = MapProjector(scene)
    groups = max(1, round(len(numbers) / _TOGETHER * 2) - 1)
    ratios: list[FrameRatio] = []
    tolerance = _TOLERANCES[0]
    for tolerance in _TOLERANCES:
        ratios = []
        for group in range(groups):
            first = round(group * (len(numbers) - _TOGETHER) / max(groups - 1, 1)) if groups > 1 else 0
            found = _ground(scene, projector, numbers[first : first + _TOGETHER], tolerance, seed=group)
            if found is not None:
                heights, share = found
                # The camera may bob: what is known is its usual height.
                ratios.append(FrameRatio(math.log(height_m / float(np.median(heights))), tolerance, share))
        if len(ratios) >= _MIN_FOUND * groups:
            break
    elsewhere = "say path=METRES or depth=METRES@X,Y,FRAME"
    if len(ratios) < _MIN_FOUND * groups:
        raise ScaleUnobservable(f"no ground is seen below the camera; {elsewhere}")
    values, weights = np.array([r.log_ratio for r in ratios]), np.array([r.weight for r in ratios])
    centre, _, _ = consensus(values, weights, _AGREE)
    if (np.abs(values - centre) < 2 * _AGREE).mean() < 0.5:
        raise ScaleUnobservable(f"parts of the video disagree about the ground below the camera; {elsewhere}")
    # What the ground is (a kerb, a carpet, the slope between) and errors that all parts share do not average out.
    estimate = scale_from_ratios(ratios, tolerance)
    if estimate is None:
        raise ScaleUnobservable(f"no ground is seen below the camera; {elsewhere}")
    return estimate


def _ground(
    scene: SceneMap, projector: MapProjector, numbers: NDArray[np.int64], tolerance: float, seed: int
) -> tuple[NDArray[np.float64], float] | None:
    """Heights of some keyframes above the ground that they see together, and the share of their points on it."""
    rng = np.random.default_rng(seed)
    poses = scene.world_from_cam[scene.keyframes[numbers]]
    points = _pooled(projector, numbers, poses, tolerance, rng)
    if points is None:
        return None
    right, down = poses[:, :3, 0], poses[:, :3, 1]
    looking_down = np.flatnonzero(points.rays @ down.mean(0) > 0)
    if len(looking_down) < _MIN_INLIERS:
        return None
    chosen = rng.choice(looking_down, (_HYPOTHESES, 3))
    corners = points.centres[chosen] + points.rays[chosen] / points.inverse_depth[chosen][..., None]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    normals, corners = normals[length > 0] / length[length > 0, None], corners[length > 0]
    normals *= np.where((normals @ down.mean(0)) < 0, -1.0, 1.0)[:, None]
    level = _level(normals, right, down)
    normals, offsets = normals[level], np.einsum("ij,ij->i", normals, corners[:, 0])[level]
    if not len(normals):
        return None
    judges = points.some(rng.permutation(len(points.weight))[:_JUDGES])
    residuals = judges.residuals(normals, offsets)
    # Among planes with as many points, the one that they are closer to.
    near = np.maximum(0, 1 - np.square(residuals))
    score = near @ judges.weight - _BELOW_COST * ((residuals < -2) @ judges.weight)
    best = int(score.argmax())
    normal, offset = _refined(points, normals[best], float(offsets[best]))
    residual = points.residuals(normal[None], np.array([offset]))[0]
    inliers, below = int((np.abs(residual) < 1).sum()), int((residual < -2).sum())
    heights = offset - poses[:, :3, 3] @ normal
    share = inliers / len(residual)
    if inliers < _MIN_INLIERS or share < _MIN_SHARE or below > _MAX_BELOW * inliers or not (heights > 0).all():
        return None
    return (heights, share) if _level(normal[None], right, down)[0] else None


def _pooled(
    projector: MapProjector, numbers: NDArray[np.int64], poses: Array, tolerance: float, rng: np.random.Generator
) -> _Points | None:
    rays, centres, depths, weights = [], [], [], []
    for k, pose in zip(numbers, poses, strict=True):
        r, d, w = projector.points(int(k))
        chosen = rng.permutation(len(d))[:_POINTS]
        rays.append(r[chosen] @ pose[:3, :3].T)
        centres.append(np.broadcast_to(pose[:3, 3], (len(chosen), 3)))
        depths.append(d[chosen])
        weights.append(w[chosen])
    if sum(map(len, depths)) < _MIN_INLIERS:
        return None
    d = np.concatenate(depths)
    sigma = tolerance * (d + _FLOOR * np.median(d))
    return _Points(np.concatenate(rays), np.concatenate(centres), d, np.concatenate(weights), sigma)


def _refined(points: _Points, normal: Array, offset: float) -> tuple[Array, float]:
    """Least squares in inverse depth with the weights of Geman and McClure: what lies off the plane has no say."""
    for width in _WIDTHS:
        residual = points.residuals(normal[None], np.array([offset]))[0] / width
        weight = points.weight / points.sigma**2 / np.square(1 + np.square(residual))
        # d (offset - n . c) = n . r, with n / offset as the unknown: n . (r + d c) / offset = d.
        rows = points.rays + points.inverse_depth[:, None] * points.centres
        matrix = rows.T @ (weight[:, None] * rows)
        scaled = np.linalg.lstsq(matrix, rows.T @ (weight * points.inverse_depth), rcond=None)[0]
        length = float(np.linalg.norm(scaled))
        if not length > 0:
            break
        sign = 1.0 if float(scaled @ normal) > 0 else -1.0
        normal, offset = sign * scaled / length, sign / length
    return normal, offset


def _level(normals: Array, right: Array, down: Array) -> NDArray[np.bool_]:
    """Which of the planes' normals (m, 3) the cameras would call down: without much roll, the picture's lower half."""
    roll = np.sqrt(np.square(normals @ right.T).mean(1))
    pitch = (normals @ down.T).mean(1)
    return np.asarray((roll < math.sin(math.radians(_MAX_ROLL_DEG))) & (pitch > math.cos(math.radians(_MAX_PITCH_DEG))))
