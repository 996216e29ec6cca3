"""A point cloud from the depth of many frames: one point per voxel, the weighted mean of what fell into it.

Memory is bounded by the number of voxels: when they run out, voxels of eight become one of twice the size, and the work
goes on. Colours and normals are averaged with the places.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vipe_core.annotation import DepthKind
from vipe_core.cameras import MODEL_CODE, Camera
from vipe_core.fusion.kernels import add_points, coarsen_points, seen_through, surface_normals
from vipe_core.fusion.views import SurfaceView, kernel_params, points_per_depth
from vipe_core.geometry.arrays import inverse

Array = NDArray[Any]

# A patch seen under more than 80 degrees is an edge between two objects, or too slanted to be measured.
MIN_COSINE = 0.17
# Length of the mean normal of a voxel: 1 on a plane, 0.7 on an edge between two.
_COHERENT = 0.6
# What another frame measures must lie this much further away before a point counts as looked through.
_THROUGH = 0.06


@dataclass(frozen=True, slots=True)
class PointCloud:
    """Points of a surface.

    Attributes:
        points: (P, 3) float32, world.
        colours: (P, 3) uint8 RGB.
        normals: (P, 3) float32 unit vectors that face the cameras which saw the points.
        spacing: Side of a voxel, about the distance between neighbours, in units of the world.
    """

    points: NDArray[np.float32]
    colours: NDArray[np.uint8]
    normals: NDArray[np.float32]
    spacing: float

    def __len__(self) -> int:
        return len(self.points)

    def where(self, keep: Array) -> PointCloud:
        """The points of a (P,) bool or index array."""
        return PointCloud(self.points[keep], self.colours[keep], self.normals[keep], self.spacing)


class CloudFuser:
    """Collects frames, one at a time, in memory that does not grow with their number.

    Args:
        camera: Of all frames, at the size of their depth.
        kind: What depth means.
        voxel: Side of a voxel in units of the world, a lower bound once `max_points` are there.
        max_points: Most voxels kept; about 60 bytes each.
    """

    def __init__(self, camera: Camera, kind: DepthKind, voxel: float, *, max_points: int = 4_000_000) -> None:
        # Voxels on different sides of the origin never merge: eight are the fewest.
        if not voxel > 0 or max_points < 8:
            raise ValueError(f"a voxel needs a size and a cloud at least eight points, got {voxel} and {max_points}")
        self.voxel = float(voxel)
        self._model = MODEL_CODE[camera.model]
        self._params = kernel_params(camera)
        self._by_z = kind == "z"
        self._rays = points_per_depth(camera, kind)
        self._table = np.full(1 << (2 * max_points - 1).bit_length(), -1, np.int32)
        self._cells = np.empty((max_points, 3), np.int32)
        self._sums = np.empty((max_points, 10), np.float32)
        self._seen = np.empty((max_points, 2), np.int32)
        self._used = 0
        self._frames = 0

    def __len__(self) -> int:
        return self._used

    def add(self, view: SurfaceView) -> None:
        """Fuse one frame.

        Raises:
            ValueError: The frame is not of the camera's size.
        """
        depth, weight = view.planes(self._rays)
        normals, cosine = surface_normals(depth, weight, self._rays)
        first = 0
        while True:
            self._used, first = add_points(
                first,
                self._frames,
                depth,
                weight,
                view.rgb,
                self._rays,
                normals,
                cosine,
                MIN_COSINE,
                np.ascontiguousarray(view.world_from_cam, np.float64),
                self.voxel,
                self._table,
                self._cells,
                self._sums,
                self._seen,
                self._used,
            )
            if first == depth.size:
                break
            self._used = coarsen_points(self._table, self._cells, self._sums, self._seen, self._used)
            self.voxel *= 2
        self._frames += 1

    def cloud(self, *, min_frames: int = 1) -> PointCloud:
        """The points that at least `min_frames` frames saw (fewer, where there were fewer), in order of first sight.

        Voxels whose pixels do not agree on which way the surface faces are left out: there is none.
        """
        used = self._used
        normals = self._sums[:used, 7:10]
        keep = self._seen[:used, 1] >= min(min_frames, max(1, self._frames))
        keep &= np.linalg.norm(normals, axis=1) >= _COHERENT * self._sums[:used, 0]
        sums = self._sums[:used][keep].astype(np.float64)
        weight = sums[:, :1]
        points = (self._cells[:used][keep] + sums[:, 1:4] / weight) * self.voxel
        normals = sums[:, 7:10] / np.maximum(np.linalg.norm(sums[:, 7:10], axis=1, keepdims=True), 1e-30)
        colours = np.clip(np.rint(sums[:, 4:7] / weight), 0, 255)
        return PointCloud(
            points.astype(np.float32), colours.astype(np.uint8), normals.astype(np.float32), float(self.voxel)
        )

    def looked_through(self, cloud: PointCloud, view: SurfaceView, against: NDArray[np.int32]) -> None:
        """Add 1 to `against` (P,) for each point of `cloud` that `view` sees something behind of.

        Such a point is not there, or was not there then: a thing that moved, or a wrong depth.
        """
        depth, weight = view.planes(self._rays)
        seen_through(
            cloud.points,
            depth,
            weight,
            self._model,
            self._params,
            self._by_z,
            inverse(view.world_from_cam),
            _THROUGH,
            against,
        )
