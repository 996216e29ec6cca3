"""The zero set of a distance field in blocks, as triangles: naive surface nets (Gibson, MICCAI 1998).

A cell between eight voxel centres that see both signs gets one vertex, the mean of the crossings on its edges; each
edge with a crossing joins the four cells around it. Against marching cubes: half as many triangles, no slivers, no case
table, and cells on the border of two blocks need nothing but the number of the neighbouring block.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from vipe_core.compilation import compiled

Array = NDArray[Any]

_BLOCK = 8
_CELLS = _BLOCK**3


def extract(
    cells: Array,
    neighbours: Array,
    distance: Array,
    total: Array,
    colour: Array,
    min_weight: float,
    voxel: float,
) -> tuple[NDArray[np.float32], NDArray[np.uint8], NDArray[np.int32]]:
    """Vertices (V, 3) in the world, their colours (V, 3), and faces (F, 3) with normals to the positive side.

    Args:
        cells: (n, 3) int32 coordinates of the blocks, in blocks.
        neighbours: (n, 8) int32, see `kernels.block_neighbours`.
        distance, total: (n, 512) float32 signed distance and its weight.
        colour: (n, 512, 3) float32.
        min_weight: Cells with a corner of less weight have no surface.
        voxel: Side of a voxel.
    """
    number = np.full((len(cells), _CELLS), -1, np.int32)
    count = _number_cells(neighbours, distance, total, min_weight, number)
    vertices = np.empty((count, 3), np.float32)
    colours = np.empty((count, 3), np.uint8)
    _place(cells, neighbours, distance, colour, voxel, number, vertices, colours)
    faces = np.empty((6 * count, 3), np.int32)
    used = _join(neighbours, distance, number, faces)
    return vertices, colours, faces[:used].copy()


@compiled
def _at(neighbours: Array, n: int, x: int, y: int, z: int) -> tuple[int, int]:
    """Block and voxel of coordinates within block `n` that may reach one block further; block -1 if it is not there."""
    corner = 4 * (x // _BLOCK) + 2 * (y // _BLOCK) + z // _BLOCK
    block = n if corner == 0 else neighbours[n, corner]
    return block, ((x % _BLOCK) * _BLOCK + y % _BLOCK) * _BLOCK + z % _BLOCK


@compiled
def _number_cells(neighbours: Array, distance: Array, total: Array, min_weight: float, number: Array) -> int:
    """Numbers the cells that the surface passes through; `number` is (n, 512) of -1. Returns how many."""
    count = 0
    for n in range(len(neighbours)):
        for cell in range(_CELLS):
            x, y, z = cell // (_BLOCK * _BLOCK), cell // _BLOCK % _BLOCK, cell % _BLOCK
            positive = 0
            known = True
            for corner in range(8):
                block, voxel = _at(neighbours, n, x + (corner >> 2), y + (corner >> 1 & 1), z + (corner & 1))
                if block < 0 or total[block, voxel] < min_weight:
                    known = False
                    break
                positive += distance[block, voxel] > 0
            if known and 0 < positive < 8:
                number[n, cell] = count
                count += 1
    return count


@compiled
def _place(
    cells: Array,
    neighbours: Array,
    distance: Array,
    colour: Array,
    voxel_size: float,
    number: Array,
    vertices: Array,
    colours: Array,
) -> None:
    """Puts each vertex at the mean of the crossings on the edges of its cell."""
    values = np.empty(8, np.float64)
    tints = np.empty((8, 3), np.float64)
    for n in range(len(neighbours)):
        for cell in range(_CELLS):
            vertex = number[n, cell]
            if vertex < 0:
                continue
            x, y, z = cell // (_BLOCK * _BLOCK), cell // _BLOCK % _BLOCK, cell % _BLOCK
            for corner in range(8):
                block, voxel = _at(neighbours, n, x + (corner >> 2), y + (corner >> 1 & 1), z + (corner & 1))
                values[corner] = distance[block, voxel]
                for c in range(3):
                    tints[corner, c] = colour[block, voxel, c]
            place = np.zeros(3)
            tint = np.zeros(3)
            crossings = 0
            for corner in range(8):
                for axis in range(3):
                    bit = 4 >> axis
                    other = corner | bit
                    if corner & bit or (values[corner] > 0) == (values[other] > 0):
                        continue
                    share = values[corner] / (values[corner] - values[other])
                    for c in range(3):
                        at = (corner >> (2 - c)) & 1
                        place[c] += share if c == axis else at
                        tint[c] += tints[corner, c] + share * (tints[other, c] - tints[corner, c])
                    crossings += 1
            for c in range(3):
                at = x if c == 0 else (y if c == 1 else z)
                vertices[vertex, c] = (cells[n, c] * _BLOCK + at + 0.5 + place[c] / crossings) * voxel_size
                colours[vertex, c] = np.uint8(min(255.0, max(0.0, tint[c] / crossings + 0.5)))


@compiled
def _join(neighbours: Array, distance: Array, number: Array, faces: Array) -> int:
    """Two triangles for each edge with a crossing whose four cells all have a vertex. Returns how many."""
    used = 0
    four = np.empty(4, np.int64)
    for n in range(len(neighbours)):
        for cell in range(_CELLS):
            x, y, z = cell // (_BLOCK * _BLOCK), cell // _BLOCK % _BLOCK, cell % _BLOCK
            if number[n, cell] < 0:
                continue
            # The edge of each direction that ends in the far corner is shared with cells further on only.
            far_block, far_voxel = _at(neighbours, n, x + 1, y + 1, z + 1)
            ends_positive = distance[far_block, far_voxel] > 0
            for axis in range(3):
                ax, ay, az = axis == 0, axis == 1, axis == 2
                block, voxel = _at(neighbours, n, x + 1 - ax, y + 1 - ay, z + 1 - az)
                starts_positive = distance[block, voxel] > 0
                if starts_positive == ends_positive:
                    continue
                # The two other directions, in the order that makes a right-handed turn round `axis`.
                bx, by, bz = axis == 2, axis == 0, axis == 1
                cx, cy, cz = axis == 1, axis == 2, axis == 0
                complete = True
                for turn in range(4):
                    b, c = turn in (1, 2), turn in (2, 3)
                    block, voxel = _at(neighbours, n, x + b * bx + c * cx, y + b * by + c * cy, z + b * bz + c * cz)
                    vertex = number[block, voxel] if block >= 0 else -1
                    complete = complete and vertex >= 0
                    four[turn] = vertex
                if not complete:
                    continue
                second, last = (1, 3) if ends_positive else (3, 1)
                faces[used, 0], faces[used, 1], faces[used, 2] = four[0], four[second], four[2]
                faces[used + 1, 0], faces[used + 1, 1], faces[used + 1, 2] = four[0], four[2], four[last]
                used += 2
    return used
