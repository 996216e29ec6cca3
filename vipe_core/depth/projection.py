"""What the map of the keyframes says about any frame: sparse inverse depth, confirmed by other keyframes, z-buffered.

Paper, section 3.3: the point cloud of the bundle adjustment, without the points that contradict other keyframes, seen
from the frame. Nearest surfaces hide what is behind them.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vipe_core.depth.types import SceneMap
from vipe_core.geometry.arrays import inverse

Array = NDArray[Any]

# Keyframes to either side, in their order, that are projected, and that a keyframe is checked against.
_NEIGHBOURS = 3
# Keyframes that must agree with a point (fewer where there are not so many), to this relative inverse depth.
_MIN_AGREEING, _AGREES = 2, 0.05
# Neighbouring cells whose inverse depths differ by less are one surface, without gaps between them.
_SAME_SURFACE = 1.15
# Points of a cell that are this much further than its nearest are behind it.
_BEHIND = 0.9
# Keyframes whose filtered points are kept: those that one frame needs, and the next ones.
_CACHED = 4 * _NEIGHBOURS


@dataclass(frozen=True, slots=True)
class ProjectedMap:
    """What the map says about one frame: at most one sample per cell.

    Attributes:
        px: (n, 2) index coordinates in the working image.
        cell: (n,) int64 row-major number of the cell that the sample lies in.
        inverse_depth: (n,) along the rays of the camera.
        weight: (n,) in 0..1, confidence of the map.
        coverage: Share of the cells that have a sample.
    """

    px: NDArray[np.float64]
    cell: NDArray[np.int64]
    inverse_depth: NDArray[np.float64]
    weight: NDArray[np.float64]
    coverage: float

    def without(self, unusable: NDArray[np.bool_]) -> ProjectedMap:
        """The samples outside of some cells (h8, w8). Coverage stays a share of all cells."""
        kept = ~unusable.ravel()[self.cell]
        return ProjectedMap(
            self.px[kept],
            self.cell[kept],
            self.inverse_depth[kept],
            self.weight[kept],
            int(kept.sum()) / max(unusable.size, 1),
        )


class MapProjector:
    """Projects the map into frames. Holds the points of a few keyframes: memory does not grow with the clip."""

    def __init__(self, scene: SceneMap) -> None:
        self._scene = scene
        height, width = scene.inverse_depth.shape[1:]
        self._size = (height, width)
        self._camera = scene.camera.resized(width, height)
        self._rays = self._camera.rays()
        v, u = np.mgrid[0 : 2 * height - 1, 0 : 2 * width - 1] / 2
        self._fine_rays = self._camera.unproject(np.stack((u, v), axis=-1)).reshape(-1, 3)
        self._points: OrderedDict[int, tuple[Array, Array, Array]] = OrderedDict()

    def of(self, frame: int) -> ProjectedMap:
        """The map as a frame sees it, from the keyframes of its shot that are nearest in time."""
        height, width = self._size
        parts = [self._seen(int(k), frame) for k in self._around(frame)]
        if not parts:
            return ProjectedMap(np.zeros((0, 2)), np.zeros(0, np.int64), np.zeros(0), np.zeros(0), 0.0)
        px, d, weight = (np.concatenate(part) for part in zip(*parts, strict=True))
        cell = np.rint(px[:, 1]).astype(np.int64) * width + np.rint(px[:, 0]).astype(np.int64)
        front = np.zeros(height * width)
        np.maximum.at(front, cell, d)
        seen = d >= _BEHIND * front[cell]
        cell, px, d, weight = cell[seen], px[seen], d[seen], weight[seen]
        total = np.bincount(cell, weight, height * width)
        filled = np.flatnonzero(total > 0)
        norm = 1 / total[filled]
        # Inverse depth is linear in pixels on a plane, so means of both are a point of it.
        mean = np.bincount(cell, weight * d, height * width)[filled] * norm
        at = [np.bincount(cell, weight * px[:, i], height * width)[filled] * norm for i in (0, 1)]
        count = np.bincount(cell, minlength=height * width)[filled]
        scale = np.array([self._scene.camera.width / width, self._scene.camera.height / height])
        where = (np.stack(at, axis=-1) + 0.5) * scale - 0.5
        return ProjectedMap(where, filled, mean, total[filled] / count, len(filled) / (height * width))

    def _around(self, frame: int) -> NDArray[np.int64]:
        """Numbers of the keyframes to project: up to `_NEIGHBOURS` to either side, and the frame's own."""
        keyframes = self._scene.keyframes
        start, stop = self._scene.shot_of(frame)
        first, last = np.searchsorted(keyframes, (start, stop))
        at = int(np.searchsorted(keyframes, frame, side="left"))
        own = at < len(keyframes) and int(keyframes[at]) == frame
        return np.arange(max(first, at - _NEIGHBOURS), min(last, at + _NEIGHBOURS + own))

    def _seen(self, k: int, frame: int) -> tuple[Array, Array, Array]:
        """Index coordinates (n, 2) on the grid of cells, inverse depth and weight of a keyframe's points in a frame."""
        height, width = self._size
        rays, d, weight = self.points(k)
        length, px, imaged = self._moved(rays, d, int(self._scene.keyframes[k]), frame)
        inside = imaged & (length > 1e-9) & (px > -0.5).all(1) & (px < (width - 0.5, height - 0.5)).all(1)
        return px[inside], d[inside] / length[inside], weight[inside]

    def _moved(self, rays: Array, d: Array, source: int, target: int) -> tuple[Array, Array, Array]:
        """Points of one frame in another: what their inverse depth is to be divided by, and where they are imaged."""
        poses = self._scene.world_from_cam
        motion = inverse(poses[target][None])[0] @ poses[source]
        points = rays @ motion[:3, :3].T + d[:, None] * motion[:3, 3]
        length = points[:, 2] if self._camera.model == "pinhole" else np.linalg.norm(points, axis=1)
        px, imaged = self._camera.project(points)
        return length, px, imaged

    def points(self, k: int) -> tuple[Array, Array, Array]:
        """Rays, inverse depth and weight of the points of a keyframe that its neighbours confirm, on a grid twice as
        fine as the cells, so that surfaces keep no holes where the frame is nearer to them than the keyframe."""
        if k not in self._points:
            self._points[k] = self._refined(k)
            while len(self._points) > _CACHED:
                self._points.popitem(last=False)
        self._points.move_to_end(k)
        return self._points[k]

    def _refined(self, k: int) -> tuple[Array, Array, Array]:
        d = self._scene.inverse_depth[k].astype(np.float64)
        weight = np.where(self._agreed(k), self._scene.confidence[k], 0).astype(np.float64)
        safe = np.where(weight > 0, d, 1.0)
        low, high, mean, least = safe, safe, safe, weight
        for axis in (0, 1):
            low, high = _between(low, axis, np.minimum), _between(high, axis, np.maximum)
            mean, least = _between(mean, axis, lambda a, b: (a + b) / 2), _between(least, axis, np.minimum)
        kept = ((least > 0) & (high < _SAME_SURFACE * low)).ravel()
        return self._fine_rays[kept], mean.ravel()[kept], least.ravel()[kept]

    def _agreed(self, k: int) -> NDArray[np.bool_]:
        """(h8, w8) cells of a keyframe with a value that enough of the neighbouring keyframes share."""
        scene, (height, width) = self._scene, self._size
        d = scene.inverse_depth[k].astype(np.float64).ravel()
        use = np.flatnonzero((scene.confidence[k].ravel() > 0) & (d > 0) & np.isfinite(d))
        start, stop = scene.shot_of(int(scene.keyframes[k]))
        first, last = np.searchsorted(scene.keyframes, (start, stop))
        others = [j for j in range(max(first, k - _NEIGHBOURS), min(last, k + _NEIGHBOURS + 1)) if j != k]
        votes = np.zeros(len(use), np.int64)
        rays = self._rays.reshape(-1, 3)[use]
        for j in others:
            length, px, imaged = self._moved(rays, d[use], int(scene.keyframes[k]), int(scene.keyframes[j]))
            expected = d[use] / np.where(length > 1e-9, length, 1.0)
            inside = imaged & (length > 1e-9) & (px > -0.5).all(1) & (px < (width - 0.5, height - 0.5)).all(1)
            column = np.clip(np.floor(px[:, 0]), 0, width - 2).astype(np.int64)
            row = np.clip(np.floor(px[:, 1]), 0, height - 2).astype(np.int64)
            agrees = np.zeros(len(use), np.bool_)
            for below in (0, 1):
                for right in (0, 1):
                    other = scene.inverse_depth[j][row + below, column + right]
                    known = scene.confidence[j][row + below, column + right] > 0
                    agrees |= known & (np.abs(other - expected) < _AGREES * expected)
            votes += inside & agrees
        agreed = np.zeros(height * width, np.bool_)
        agreed[use[votes >= min(_MIN_AGREEING, len(others))]] = True
        return agreed.reshape(height, width)


def _between(values: Array, axis: int, combine: Any) -> Array:
    """The values along an axis with what `combine` makes of neighbours put between them: n -> 2n - 1."""
    moved = np.moveaxis(values, axis, 0)
    out = np.empty((2 * len(moved) - 1, *moved.shape[1:]))
    out[::2] = moved
    out[1::2] = combine(moved[:-1], moved[1:])
    return np.moveaxis(out, 0, axis)
