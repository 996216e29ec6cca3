"""A mesh from the depth of many frames: a truncated signed distance field in blocks around the surfaces.

Curless & Levoy, SIGGRAPH 1996, in blocks of 8 x 8 x 8 voxels as of Niessner et al., SIGGRAPH Asia 2013. Memory is
bounded by the number of blocks: when they run out, voxels of eight become one of twice the size, and the work goes on.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse import csgraph

from vipe_core.annotation import DepthKind
from vipe_core.cameras import MODEL_CODE, Camera
from vipe_core.fusion.cloud import MIN_COSINE
from vipe_core.fusion.kernels import (
    BLOCK,
    block_neighbours,
    coarsen_blocks,
    integrate,
    surface_normals,
    touch_blocks,
)
from vipe_core.fusion.surface import extract
from vipe_core.fusion.views import SurfaceView, kernel_params, points_per_depth
from vipe_core.geometry.arrays import inverse

# The field is known this many voxels to either side of a surface.
_REACH_VOXELS = 4.0
_PIXEL_STEP = 2


@dataclass(frozen=True, slots=True)
class Mesh:
    """A triangle mesh.

    Attributes:
        vertices: (V, 3) float32, world.
        colours: (V, 3) uint8 RGB.
        faces: (F, 3) int32, counter-clockwise seen from the free side.
        spacing: Side of a voxel in units of the world.
    """

    vertices: NDArray[np.float32]
    colours: NDArray[np.uint8]
    faces: NDArray[np.int32]
    spacing: float

    def normals(self) -> NDArray[np.float32]:
        """(V, 3) unit vectors to the free side: means of the faces around, weighted by their area."""
        a, b, c = (self.vertices[self.faces[:, k]].astype(np.float64) for k in range(3))
        area = np.cross(b - a, c - a)
        total = np.zeros((len(self.vertices), 3))
        for k in range(3):
            np.add.at(total, self.faces[:, k], area)
        return np.asarray(total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30), np.float32)


class TsdfVolume:
    """Collects frames, one at a time, in memory that does not grow with their number.

    Args:
        camera: Of all frames, at the size of their depth.
        kind: What depth means.
        voxel: Side of a voxel in units of the world, a lower bound once `max_blocks` are there.
        max_blocks: Most blocks kept; about 10 kB each.
    """

    def __init__(self, camera: Camera, kind: DepthKind, voxel: float, *, max_blocks: int = 24_000) -> None:
        # Blocks on different sides of the origin never merge: eight are the fewest.
        if not voxel > 0 or max_blocks < 8:
            raise ValueError(f"a voxel needs a size and a volume at least eight blocks, got {voxel} and {max_blocks}")
        self.voxel = float(voxel)
        self._model = MODEL_CODE[camera.model]
        self._params = kernel_params(camera)
        self._by_z = kind == "z"
        self._rays = points_per_depth(camera, kind)
        self._table = np.full(1 << (2 * max_blocks - 1).bit_length(), -1, np.int32)
        self._cells = np.empty((max_blocks, 3), np.int32)
        # Zeros are not in memory before a block is used.
        self._distance = np.zeros((max_blocks, BLOCK**3), np.float32)
        self._total = np.zeros((max_blocks, BLOCK**3), np.float32)
        self._colour = np.zeros((max_blocks, BLOCK**3, 3), np.float32)
        self._used = 0

    def add(self, view: SurfaceView) -> None:
        """Fuse one frame.

        Raises:
            ValueError: The frame is not of the camera's size.
        """
        depth, weight = view.planes(self._rays)
        world_from_cam = np.ascontiguousarray(view.world_from_cam, np.float64)
        _, cosine = surface_normals(depth, weight, self._rays)
        while True:
            used = touch_blocks(
                depth,
                cosine,
                MIN_COSINE,
                self._rays,
                _PIXEL_STEP,
                world_from_cam,
                _REACH_VOXELS * self.voxel,
                BLOCK * self.voxel,
                self._table,
                self._cells,
                self._used,
            )
            if used >= 0:
                self._used = used
                break
            self._coarsen()
        integrate(
            depth,
            weight,
            view.rgb,
            self._rays,
            cosine,
            MIN_COSINE,
            self._model,
            self._params,
            self._by_z,
            inverse(world_from_cam),
            _REACH_VOXELS * self.voxel,
            self.voxel,
            self._cells,
            self._used,
            self._distance,
            self._total,
            self._colour,
        )

    def mesh(self, *, min_weight: float = 0.0, min_faces: int = 100) -> Mesh:
        """The surface where the distance is zero.

        Args:
            min_weight: Voxels with less than this weight in all are taken for unknown.
            min_faces: Pieces of fewer faces are left out.
        """
        neighbours = block_neighbours(self._table, self._cells, self._used)
        vertices, colours, faces = extract(
            self._cells[: self._used],
            neighbours,
            self._distance,
            self._total,
            self._colour,
            float(max(min_weight, 1e-12)),
            self.voxel,
        )
        return _without_crumbs(Mesh(vertices, colours, faces, self.voxel), min_faces)

    def _coarsen(self) -> None:
        # Blocks that were numbered but not yet filled go with the rest: they are empty.
        used = int((self._table >= 0).sum())
        spare = np.empty((BLOCK**3, 5), np.float32)
        self._used = coarsen_blocks(self._table, self._cells, used, self._distance, self._total, self._colour, spare)
        self.voxel *= 2


def _without_crumbs(mesh: Mesh, min_faces: int) -> Mesh:
    """Without the connected pieces of fewer faces, and without the vertices that no face uses."""
    count = len(mesh.vertices)
    if not count or not len(mesh.faces):
        return Mesh(mesh.vertices[:0], mesh.colours[:0], mesh.faces[:0], mesh.spacing)
    first, second = mesh.faces[:, [0, 1]].ravel(), mesh.faces[:, [1, 2]].ravel()
    graph = sparse.coo_matrix((np.ones(len(first), np.int8), (first, second)), shape=(count, count))
    _, label = csgraph.connected_components(graph, directed=False)
    of_face = label[mesh.faces[:, 0]]
    kept = mesh.faces[np.bincount(of_face, minlength=count)[of_face] >= min_faces]
    used = np.zeros(count, np.bool_)
    used[kept.ravel()] = True
    number = np.cumsum(used, dtype=np.int64) - 1
    return Mesh(mesh.vertices[used], mesh.colours[used], number[kept].astype(np.int32), mesh.spacing)
