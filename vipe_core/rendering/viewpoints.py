"""Where to look at a cloud from: around what the cameras looked at, upright, with everything in the picture."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vipe_core.cameras import Camera
from vipe_core.fusion import PointCloud

Array = NDArray[Any]

# Points further from the path than this many times the usual distance are background and not to be framed.
_BACKGROUND = 3.0
_OUTLIERS = (2.0, 98.0)
_SAMPLE = 20_000
# Cameras whose mean direction is shorter than this look all around: the picture turns all around, too.
_ALL_AROUND = 0.35
_SWAY_DEG = 30.0
_CELLS = 48  # across the picture, to count what is covered
# Cameras are held level more strictly than they are held straight; floors, tables and streets are level planes.
_PITCHED = 0.1
_LEVEL_COSINE, _LEVEL_SHARE, _LEAST_LEVEL = 0.8, 0.04, 50
_FLATNESS, _TRIALS = 0.006, 200
_MARGIN = 1.06  # room for the frusta of the path


@dataclass(frozen=True, slots=True)
class Stage:
    """A scene in a frame of its own.

    Attributes:
        centre: (3,) middle of what is to be seen, world.
        axes: (3, 3) rows right, up and ahead: level, and the way in which most cameras look.
        points: (n, 3) float64 sample of what is to be seen, relative to `centre`, in `axes`.
        normals: (n, 3) of them, in `axes`.
        eyes: (m, 3) the camera path likewise.
        all_around: Whether the cameras looked all around.
        extent: Half of the size of the scene.
    """

    centre: NDArray[np.float64]
    axes: NDArray[np.float64]
    points: NDArray[np.float64]
    normals: NDArray[np.float64]
    eyes: NDArray[np.float64]
    all_around: bool
    extent: float

    @classmethod
    def of(cls, cloud: PointCloud, world_from_cam: Array) -> Stage:
        """The stage of a cloud and the cameras that made it."""
        eyes = world_from_cam[:, :3, 3]
        near = np.flatnonzero(foreground(cloud, world_from_cam))
        near = near[:: max(1, len(near) // _SAMPLE)]
        points, normals = cloud.points[near].astype(np.float64), cloud.normals[near].astype(np.float64)
        if not len(points):
            points, normals = eyes, -world_from_cam[:, :3, 2]
        up = _upright(world_from_cam, points, normals)
        ways = world_from_cam[:, :3, 2] - (world_from_cam[:, :3, 2] @ up)[:, None] * up
        mean = ways.mean(axis=0)
        ahead = _unit(mean - (mean @ up) * up, _level(up))
        axes = np.stack([np.cross(ahead, up), up, ahead])  # left-handed, hence the order of the cross products
        local = points @ axes.T
        path = eyes @ axes.T
        low, high = np.percentile(local, _OUTLIERS, axis=0)
        low, high = np.minimum(low, path.min(axis=0)), np.maximum(high, path.max(axis=0))
        middle = (low + high) / 2
        all_around = bool(np.linalg.norm(mean) < _ALL_AROUND)
        extent = float(np.linalg.norm(high - low) / 2)
        return cls(middle @ axes, axes, local - middle, normals @ axes.T, path - middle, all_around, max(extent, 1e-9))

    def around(self, azimuth_deg: float, elevation_deg: float, camera: Camera, *, zoom: float = 1.0) -> Array:
        """(4, 4) world_from_cam that looks at the scene from behind the cameras, turned by these angles.

        Args:
            camera: Of the viewer, pinhole; all but the outliers of the scene are in its picture.
            zoom: Above 1 is closer.
        """
        axes = self._turned(azimuth_deg, elevation_deg)
        away = self._distance(axes, camera) / zoom
        return self._looking(axes, away)

    def best(self, camera: Camera) -> tuple[float, float]:
        """Azimuth and elevation of the view that shows most: whose picture is covered most by surfaces that face it."""
        azimuths = range(-180, 180, 30) if self.all_around else range(-40, 41, 10)
        return max(
            ((float(a), float(e)) for e in (24, 32) for a in azimuths),
            key=lambda view: self._shown(view[0], view[1], camera),
        )

    def turntable(
        self, count: int, azimuth_deg: float, elevation_deg: float, camera: Camera, *, zoom: float = 1.0
    ) -> list[Array]:
        """Poses of a film that begins where it ends: once around, or to and fro where the cameras saw one side only."""
        shares = np.arange(count) / count
        turn = 360 * shares if self.all_around else _SWAY_DEG * np.sin(2 * math.pi * shares)
        azimuths = azimuth_deg + turn
        lifts = elevation_deg + (0 if self.all_around else 5) * np.cos(2 * math.pi * shares)
        turned = [self._turned(float(a), float(e)) for a, e in zip(azimuths, lifts, strict=True)]
        # One distance for all, so that the scene does not breathe.
        away = max(self._distance(axes, camera) for axes in turned[:: max(1, count // 12)]) / zoom
        return [self._looking(axes, away) for axes in turned]

    def _shown(self, azimuth_deg: float, elevation_deg: float, camera: Camera) -> int:
        """Number of cells of the picture that a surface covers from its front."""
        axes = self._turned(azimuth_deg, elevation_deg)
        local = self.points @ axes.T
        local[:, 2] += self._distance(axes, camera)
        facing = np.einsum("ni,ni->n", self.normals @ axes.T, local) < 0
        px, ahead = camera.project(local[facing])
        cells = np.floor(px[ahead] * (_CELLS / camera.width)).astype(np.int64)
        rows = round(_CELLS * camera.height / camera.width)
        inside = (cells >= 0).all(axis=1) & (cells[:, 0] < _CELLS) & (cells[:, 1] < rows)
        return len(np.unique(cells[inside, 1] * _CELLS + cells[inside, 0]))

    def _turned(self, azimuth_deg: float, elevation_deg: float) -> Array:
        """(3, 3) rows right, down and forward of the viewer, in the axes of the stage."""
        azimuth, elevation = math.radians(azimuth_deg), math.radians(elevation_deg)
        ahead = np.array([math.sin(azimuth), 0, math.cos(azimuth)])
        forward = math.cos(elevation) * ahead - np.array([0, math.sin(elevation), 0])
        right = np.array([math.cos(azimuth), 0, -math.sin(azimuth)])
        return np.stack([right, np.cross(right, forward), forward])

    def _distance(self, axes: Array, camera: Camera) -> float:
        """From the centre, such that all but a few points are in the picture."""
        wide, high = camera.width / 2 / camera.params[0], camera.height / 2 / camera.params[1]

        def needed(points: Array) -> Array:
            local = points @ axes.T
            return np.asarray(np.maximum(np.abs(local[:, 0]) / wide, np.abs(local[:, 1]) / high) - local[:, 2])

        scene, path = np.percentile(needed(self.points), _OUTLIERS[1]), _MARGIN * needed(self.eyes).max()
        return float(max(scene, path, 0.2 * self.extent))

    def _looking(self, axes: Array, away: float) -> Array:
        pose = np.eye(4)
        pose[:3, :3] = (axes @ self.axes).T
        pose[:3, 3] = self.centre - away * pose[:3, 2]
        return pose


def foreground(cloud: PointCloud, world_from_cam: Array) -> NDArray[np.bool_]:
    """(P,) bool: points that are not many times further from the cameras than usual."""
    eyes = world_from_cam[:: max(1, len(world_from_cam) // 16), :3, 3]
    nearest = np.full(len(cloud), np.inf)
    for eye in eyes:
        nearest = np.minimum(nearest, np.linalg.norm(cloud.points - eye.astype(np.float32), axis=1))
    return np.asarray(nearest <= _BACKGROUND * np.median(nearest) if len(nearest) else nearest > 0)


def _upright(world_from_cam: Array, points: Array, normals: Array) -> Array:
    """(3,) unit vector: across the sideways axes of the cameras, then of the largest level plane, if there is one.

    The plane is fitted to places: normals of single points lean towards the cameras.
    """
    seen = _unit(-world_from_cam[:, :3, 1].mean(axis=0), np.array([0.0, -1.0, 0.0]))
    sideways = world_from_cam[:, :3, 0]
    tilted = sideways.T @ sideways / len(sideways) + _PITCHED * (np.eye(3) - np.outer(seen, seen))
    up = np.linalg.eigh(tilted)[1][:, 0]
    up = up if up @ seen >= 0 else -up
    level = points[np.abs(normals @ up) > _LEVEL_COSINE]
    if len(level) < _LEAST_LEVEL:
        return np.asarray(up)
    close = _FLATNESS * float(np.linalg.norm(np.percentile(points, 95, axis=0) - np.percentile(points, 5, axis=0)))
    rng = np.random.default_rng(0)
    best, normal = 0, up
    for three in rng.integers(0, len(level), (_TRIALS, 3)):
        a, b, c = level[three]
        across = _unit(np.cross(b - a, c - a), up)
        if abs(across @ up) < _LEVEL_COSINE:
            continue
        inliers = int((np.abs((level - a) @ across) < close).sum())
        if inliers > best:
            best, normal, at = inliers, across, a
    if best < _LEVEL_SHARE * len(points):
        return np.asarray(up)
    floor = level[np.abs((level - at) @ normal) < close]
    normal = np.linalg.svd(floor - floor.mean(axis=0), full_matrices=False)[2][2]
    return np.asarray(normal if normal @ up > 0 else -normal)


def _unit(vector: Array, otherwise: Array) -> Array:
    length = float(np.linalg.norm(vector))
    return vector / length if length > 1e-6 else otherwise


def _level(up: Array) -> Array:
    """Any direction across `up`."""
    other = np.array([1.0, 0, 0]) if abs(up[0]) < 0.9 else np.array([0.0, 1, 0])
    across = np.cross(up, other)
    return np.asarray(across / np.linalg.norm(across))
