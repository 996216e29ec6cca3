"""Compiled loops of fusion: surface normals, the voxel table of the cloud, the blocks of the distance field.

Numba's cache notices changes of the file of a function only, so what calls each other lives here together.
Voxel (i, j, k) of size s spans [i s, (i + 1) s) and so on; tables map integer cells to consecutive numbers by open
addressing, in order of first use, so that the same frames give the same order.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vipe_core.compilation import compiled

Array = NDArray[Any]

BLOCK = 8


@compiled
def _project_opencv(params: Array, x: float, y: float, z: float) -> tuple[float, float, bool]:
    """`cameras.distortion`; params (fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6, largest slope)."""
    if z <= 1e-9:
        return 0.0, 0.0, False
    a, b = x / z, y / z
    r2 = a * a + b * b
    if r2 > params[12] * params[12]:
        return 0.0, 0.0, False
    g = (1 + r2 * (params[4] + r2 * (params[5] + r2 * params[8]))) / (
        1 + r2 * (params[9] + r2 * (params[10] + r2 * params[11]))
    )
    u = g * a + 2 * params[6] * a * b + params[7] * (r2 + 2 * a * a)
    v = g * b + params[6] * (r2 + 2 * b * b) + 2 * params[7] * a * b
    return params[0] * u + params[2], params[1] * v + params[3], True


@compiled
def _project_fisheye(params: Array, x: float, y: float, z: float) -> tuple[float, float, bool]:
    """`cameras.distortion`; params (fx, fy, cx, cy, k1, k2, k3, k4, largest angle)."""
    across = math.sqrt(x * x + y * y)
    angle = math.atan2(across, z)
    if angle > params[8]:
        return 0.0, 0.0, False
    t2 = angle * angle
    d = angle * (1 + t2 * (params[4] + t2 * (params[5] + t2 * (params[6] + t2 * params[7]))))
    scale = d / across if across > 0 else 0.0
    return params[0] * scale * x + params[2], params[1] * scale * y + params[3], True


@compiled
def _project(model: int, params: Array, x: float, y: float, z: float) -> tuple[float, float, bool]:
    """Index coordinates of a point of the camera frame, and whether the model images it; `CONVENTIONS.md`."""
    if model == 0:
        if z <= 1e-9:
            return 0.0, 0.0, False
        return params[0] * x / z + params[2], params[1] * y / z + params[3], True
    norm = math.sqrt(x * x + y * y + z * z)
    if model == 1:
        s = z + params[4] * norm
        if s <= 1e-6 * norm or (params[4] > 1 and params[4] * z <= -norm):
            return 0.0, 0.0, False
        return params[0] * x / s + params[2], params[1] * y / s + params[3], True
    if model == 3:
        return _project_opencv(params, x, y, z)
    if model == 4:
        return _project_fisheye(params, x, y, z)
    u = (math.atan2(x, z) / (2 * math.pi) + 0.5) * params[0] - 0.5
    v = math.atan2(math.sqrt(x * x + z * z), -y) / math.pi * params[1] - 0.5
    return u, v, norm > 0


@compiled
def _slot(table: Array, cells: Array, i: int, j: int, k: int) -> int:
    """Where the cell is in the table, or the free place where it belongs."""
    mask = len(table) - 1
    at = ((i * 73856093) ^ (j * 19349663) ^ (k * 83492791)) & mask
    at = (at ^ (at >> 7)) & mask
    while True:
        n = table[at]
        if n < 0 or (cells[n, 0] == i and cells[n, 1] == j and cells[n, 2] == k):
            return at
        at = (at + 1) & mask


@compiled
def surface_normals(depth: Array, weight: Array, rays: Array) -> tuple[Array, Array]:
    """Normals by central differences, facing the camera, and the cosine under which each is seen.

    Args:
        depth, weight: (h, w); pixels of weight 0 are left out, their neighbours' values are still read.
        rays: (h, w, 3), see `points_per_depth`.

    Returns:
        (h, w, 3) float32 in the camera frame, and (h, w) float32 cosine; 0 where there is none. A pixel on the edge of
        an object gets a small cosine: its neighbours lie far apart along the ray.
    """
    h, w = depth.shape
    normals = np.zeros((h, w, 3), np.float32)
    cosine = np.zeros((h, w), np.float32)
    for y in range(h):
        y0, y1 = max(0, y - 1), min(h - 1, y + 1)
        for x in range(w):
            x0, x1 = max(0, x - 1), min(w - 1, x + 1)
            if weight[y, x] <= 0 or not depth[y, x] > 0:
                continue
            left, right, above, below = depth[y, x0], depth[y, x1], depth[y0, x], depth[y1, x]
            if not (left > 0 and right > 0 and above > 0 and below > 0):
                continue
            ax = right * rays[y, x1, 0] - left * rays[y, x0, 0]
            ay = right * rays[y, x1, 1] - left * rays[y, x0, 1]
            az = right * rays[y, x1, 2] - left * rays[y, x0, 2]
            bx = below * rays[y1, x, 0] - above * rays[y0, x, 0]
            by = below * rays[y1, x, 1] - above * rays[y0, x, 1]
            bz = below * rays[y1, x, 2] - above * rays[y0, x, 2]
            nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
            norm = math.sqrt(nx * nx + ny * ny + nz * nz)
            rx, ry, rz = rays[y, x, 0], rays[y, x, 1], rays[y, x, 2]
            length = math.sqrt(rx * rx + ry * ry + rz * rz)
            if norm <= 0 or length <= 0:
                continue
            toward = -(nx * rx + ny * ry + nz * rz) / (norm * length)
            sign = 1.0 if toward > 0 else -1.0
            normals[y, x, 0], normals[y, x, 1], normals[y, x, 2] = sign * nx / norm, sign * ny / norm, sign * nz / norm
            cosine[y, x] = sign * toward
    return normals, cosine


@compiled
def add_points(
    first: int,
    frame: int,
    depth: Array,
    weight: Array,
    rgb: Array,
    rays: Array,
    normals: Array,
    cosine: Array,
    min_cosine: float,
    world_from_cam: Array,
    voxel: float,
    table: Array,
    cells: Array,
    sums: Array,
    seen: Array,
    used: int,
) -> tuple[int, int]:
    """Adds the pixels of a frame, from the `first` on, to the voxels that they fall into.

    Args:
        cells: (n, 3) int32 of the numbered voxels.
        sums: (n, 10) float32 of weight, and weighted place within the voxel, colour, normal.
        seen: (n, 2) int32 of the last frame that fell into a voxel, and how many did.
        used: How many are numbered.

    Returns:
        How many are numbered now, and the first pixel that found no room (the number of pixels if all did).
    """
    h, w = depth.shape
    for pixel in range(first, h * w):
        y, x = pixel // w, pixel % w
        if cosine[y, x] < min_cosine or weight[y, x] <= 0:
            continue
        d = depth[y, x]
        px, py, pz = d * rays[y, x, 0], d * rays[y, x, 1], d * rays[y, x, 2]
        # A patch seen under a slant, or from afar, says less about where it is.
        gain = weight[y, x] * cosine[y, x] / max(1e-12, px * px + py * py + pz * pz)
        gx = (
            world_from_cam[0, 0] * px + world_from_cam[0, 1] * py + world_from_cam[0, 2] * pz + world_from_cam[0, 3]
        ) / voxel
        gy = (
            world_from_cam[1, 0] * px + world_from_cam[1, 1] * py + world_from_cam[1, 2] * pz + world_from_cam[1, 3]
        ) / voxel
        gz = (
            world_from_cam[2, 0] * px + world_from_cam[2, 1] * py + world_from_cam[2, 2] * pz + world_from_cam[2, 3]
        ) / voxel
        if max(abs(gx), abs(gy), abs(gz)) > 1e9:
            continue
        i, j, k = math.floor(gx), math.floor(gy), math.floor(gz)
        at = _slot(table, cells, i, j, k)
        n = table[at]
        if n < 0:
            if used == len(cells):
                return used, pixel
            n = used
            used += 1
            table[at] = n
            cells[n, 0], cells[n, 1], cells[n, 2] = i, j, k
            sums[n, :] = 0
            seen[n, 0], seen[n, 1] = -1, 0
        sums[n, 0] += gain
        sums[n, 1] += gain * (gx - i)
        sums[n, 2] += gain * (gy - j)
        sums[n, 3] += gain * (gz - k)
        for c in range(3):
            sums[n, 4 + c] += gain * rgb[y, x, c]
            sums[n, 7 + c] += gain * (
                world_from_cam[c, 0] * normals[y, x, 0]
                + world_from_cam[c, 1] * normals[y, x, 1]
                + world_from_cam[c, 2] * normals[y, x, 2]
            )
        if seen[n, 0] != frame:
            seen[n, 0] = frame
            seen[n, 1] += 1
    return used, h * w


@compiled
def coarsen_points(table: Array, cells: Array, sums: Array, seen: Array, used: int) -> int:
    """Merges eight voxels into one of twice the size; returns how many are left.

    A merged voxel counts as seen by as many frames as the best of its parts.
    """
    table[:] = -1
    kept = 0
    for n in range(used):
        i, j, k = cells[n, 0] >> 1, cells[n, 1] >> 1, cells[n, 2] >> 1
        weight = sums[n, 0]
        for c in range(3):
            sums[n, 1 + c] = 0.5 * (sums[n, 1 + c] + weight * (cells[n, c] & 1))
        at = _slot(table, cells, i, j, k)
        m = table[at]
        if m < 0:
            m = kept
            kept += 1
            table[at] = m
            cells[m, 0], cells[m, 1], cells[m, 2] = i, j, k
            sums[m, :] = sums[n, :]
            seen[m, 0], seen[m, 1] = seen[n, 0], seen[n, 1]
        else:
            sums[m, :] += sums[n, :]
            seen[m, 0], seen[m, 1] = max(seen[m, 0], seen[n, 0]), max(seen[m, 1], seen[n, 1])
    return kept


@compiled
def seen_through(
    points: Array,
    depth: Array,
    weight: Array,
    model: int,
    params: Array,
    by_z: bool,
    cam_from_world: Array,
    tolerance: float,
    against: Array,
) -> None:
    """Adds 1 to `against` for each point that this frame looks through: what it measures there lies further away."""
    h, w = depth.shape
    for n in range(len(points)):
        x = cam_from_world[0, 0] * points[n, 0] + cam_from_world[0, 1] * points[n, 1]
        x += cam_from_world[0, 2] * points[n, 2] + cam_from_world[0, 3]
        y = cam_from_world[1, 0] * points[n, 0] + cam_from_world[1, 1] * points[n, 1]
        y += cam_from_world[1, 2] * points[n, 2] + cam_from_world[1, 3]
        z = cam_from_world[2, 0] * points[n, 0] + cam_from_world[2, 1] * points[n, 1]
        z += cam_from_world[2, 2] * points[n, 2] + cam_from_world[2, 3]
        u, v, imaged = _project(model, params, x, y, z)
        if not imaged or not (u > -0.5 and v > -0.5 and u < w - 0.5 and v < h - 0.5):
            continue
        col, row = int(u + 0.5), int(v + 0.5)
        away = z if by_z else math.sqrt(x * x + y * y + z * z)
        if weight[row, col] > 0 and depth[row, col] * (1 - tolerance) > away:
            against[n] += 1


@compiled
def touch_blocks(
    depth: Array,
    cosine: Array,
    min_cosine: float,
    rays: Array,
    step: int,
    world_from_cam: Array,
    reach: float,
    size: float,
    table: Array,
    cells: Array,
    used: int,
) -> int:
    """Numbers every block within `reach` of a measured surface; -1 if there is no room for them.

    Args:
        size: Side of a block.
    """
    h, w = depth.shape
    samples = 1 + math.ceil(4 * reach / size)
    for y in range(0, h, step):
        for x in range(0, w, step):
            if cosine[y, x] < min_cosine:
                continue
            rx, ry, rz = rays[y, x, 0], rays[y, x, 1], rays[y, x, 2]
            length = math.sqrt(rx * rx + ry * ry + rz * rz)
            for s in range(samples):
                d = depth[y, x] + reach * (2.0 * s / (samples - 1) - 1.0) / length
                if d <= 0:
                    continue
                gx = world_from_cam[0, 0] * d * rx + world_from_cam[0, 1] * d * ry + world_from_cam[0, 2] * d * rz
                gy = world_from_cam[1, 0] * d * rx + world_from_cam[1, 1] * d * ry + world_from_cam[1, 2] * d * rz
                gz = world_from_cam[2, 0] * d * rx + world_from_cam[2, 1] * d * ry + world_from_cam[2, 2] * d * rz
                gx, gy, gz = gx + world_from_cam[0, 3], gy + world_from_cam[1, 3], gz + world_from_cam[2, 3]
                if max(abs(gx), abs(gy), abs(gz)) > 1e9 * size:
                    continue
                i, j, k = math.floor(gx / size), math.floor(gy / size), math.floor(gz / size)
                at = _slot(table, cells, i, j, k)
                if table[at] < 0:
                    if used == len(cells):
                        return -1
                    table[at] = used
                    cells[used, 0], cells[used, 1], cells[used, 2] = i, j, k
                    used += 1
    return used


@compiled
def _sample_depth(depth: Array, cosine: Array, min_cosine: float, u: float, v: float) -> float:
    """Depth at index coordinates, linear in inverse depth within a surface, the nearest pixel's at its edge, or 0."""
    h, w = depth.shape
    x, y = int(u), int(v)
    x, y = min(x, w - 2), min(y, h - 2)
    low, high = depth[y, x], depth[y, x]
    whole = True
    for dy in range(2):
        for dx in range(2):
            low, high = min(low, depth[y + dy, x + dx]), max(high, depth[y + dy, x + dx])
            whole = whole and cosine[y + dy, x + dx] >= min_cosine
    if whole and high < 1.1 * low:
        fx, fy = u - x, v - y
        upper = (1 - fx) / depth[y, x] + fx / depth[y, x + 1]
        lower = (1 - fx) / depth[y + 1, x] + fx / depth[y + 1, x + 1]
        return float(1.0 / ((1 - fy) * upper + fy * lower))
    col, row = int(u + 0.5), int(v + 0.5)
    return float(depth[row, col]) if cosine[row, col] >= min_cosine else 0.0


@compiled
def integrate(
    depth: Array,
    weight: Array,
    rgb: Array,
    rays: Array,
    cosine: Array,
    min_cosine: float,
    model: int,
    params: Array,
    by_z: bool,
    cam_from_world: Array,
    reach: float,
    voxel: float,
    cells: Array,
    used: int,
    distance: Array,
    total: Array,
    colour: Array,
) -> None:
    """Averages a frame's truncated signed distances (positive in front of the surface) into all blocks in view.

    Args:
        distance, total: (n, 512) float32 signed distance and its weight.
        colour: (n, 512, 3) float32.
    """
    h, w = depth.shape
    radius = 0.5 * math.sqrt(3.0) * BLOCK * voxel
    for n in range(used):
        bx, by, bz = cells[n, 0] * BLOCK * voxel, cells[n, 1] * BLOCK * voxel, cells[n, 2] * BLOCK * voxel
        half = 0.5 * BLOCK * voxel
        mz = (
            cam_from_world[2, 0] * (bx + half) + cam_from_world[2, 1] * (by + half) + cam_from_world[2, 2] * (bz + half)
        )
        if model == 0 and mz + cam_from_world[2, 3] < -radius:
            continue
        for cell in range(BLOCK * BLOCK * BLOCK):
            gx = bx + (cell // (BLOCK * BLOCK) + 0.5) * voxel
            gy = by + (cell // BLOCK % BLOCK + 0.5) * voxel
            gz = bz + (cell % BLOCK + 0.5) * voxel
            x = cam_from_world[0, 0] * gx + cam_from_world[0, 1] * gy + cam_from_world[0, 2] * gz + cam_from_world[0, 3]
            y = cam_from_world[1, 0] * gx + cam_from_world[1, 1] * gy + cam_from_world[1, 2] * gz + cam_from_world[1, 3]
            z = cam_from_world[2, 0] * gx + cam_from_world[2, 1] * gy + cam_from_world[2, 2] * gz + cam_from_world[2, 3]
            u, v, imaged = _project(model, params, x, y, z)
            if not imaged or not (u >= 0 and v >= 0 and u <= w - 1 and v <= h - 1):
                if cell == 0 and imaged and _far_outside(u, v, w, h, model, params, radius, x, y, z):
                    break
                continue
            measured = _sample_depth(depth, cosine, min_cosine, u, v)
            if measured <= 0:
                continue
            col, row = int(u + 0.5), int(v + 0.5)
            slant = cosine[row, col]
            if slant < min_cosine:
                continue
            norm = math.sqrt(x * x + y * y + z * z)
            away = z if by_z else norm
            # Along the ray, then across the surface.
            signed = (measured - away) * (norm / away) * slant
            if signed < -reach:
                continue
            gain = weight[row, col] * slant
            before = total[n, cell]
            share = gain / (before + gain)
            distance[n, cell] += share * (min(signed, reach) - distance[n, cell])
            total[n, cell] = before + gain
            if signed < reach:
                for c in range(3):
                    colour[n, cell, c] += share * (rgb[row, col, c] - colour[n, cell, c])


@compiled
def _far_outside(
    u: float, v: float, w: int, h: int, model: int, params: Array, radius: float, x: float, y: float, z: float
) -> bool:
    """Whether a whole block is out of a pinhole picture when its first voxel is this far out of it."""
    if model != 0 or z <= 4 * radius:
        return False
    # Within the block, x / z changes by less than this.
    margin = max(params[0], params[1]) * 2 * radius / (z - 2 * radius) * (1 + max(abs(x), abs(y)) / z)
    return bool(u < -margin or v < -margin or u > w + margin or v > h + margin)


@compiled
def coarsen_blocks(
    table: Array, cells: Array, used: int, distance: Array, total: Array, colour: Array, spare: Array
) -> int:
    """Merges voxels of eight into one of twice the size; returns how many blocks are left.

    A voxel's centre is the mean of its parts' centres, so that averaging keeps a plane where it is.

    Args:
        spare: (512, 5) float32 scratch.
    """
    table[:] = -1
    kept = 0
    half = BLOCK // 2
    for n in range(used):
        i, j, k = cells[n, 0], cells[n, 1], cells[n, 2]
        spare[:] = 0
        for cell in range(BLOCK * BLOCK * BLOCK):
            gain = total[n, cell]
            x, y, z = cell // (BLOCK * BLOCK), cell // BLOCK % BLOCK, cell % BLOCK
            into = ((x // 2) * BLOCK + y // 2) * BLOCK + z // 2
            spare[into, 0] += gain
            spare[into, 1] += gain * distance[n, cell]
            for c in range(3):
                spare[into, 2 + c] += gain * colour[n, cell, c]
        at = _slot(table, cells, i >> 1, j >> 1, k >> 1)
        m = table[at]
        if m < 0:
            m = kept
            kept += 1
            table[at] = m
            cells[m, 0], cells[m, 1], cells[m, 2] = i >> 1, j >> 1, k >> 1
            distance[m, :], total[m, :], colour[m, :, :] = 0, 0, 0
        for x in range(half):
            for y in range(half):
                for z in range(half):
                    source = (x * BLOCK + y) * BLOCK + z
                    into = ((x + (i & 1) * half) * BLOCK + y + (j & 1) * half) * BLOCK + z + (k & 1) * half
                    gain = spare[source, 0]
                    if gain > 0:
                        # Eight parts that all say the same are one voxel, not eight.
                        total[m, into] = gain / 8
                        distance[m, into] = spare[source, 1] / gain
                        for c in range(3):
                            colour[m, into, c] = spare[source, 2 + c] / gain
    distance[kept:used], total[kept:used], colour[kept:used] = 0, 0, 0
    return kept


@compiled
def block_neighbours(table: Array, cells: Array, used: int) -> Array:
    """(n, 8) int32 numbers of the blocks at (+a, +b, +c), column 4 a + 2 b + c; -1 where there is none."""
    out = np.empty((used, 8), np.int32)
    for n in range(used):
        for corner in range(8):
            i, j, k = cells[n, 0] + (corner >> 2), cells[n, 1] + (corner >> 1 & 1), cells[n, 2] + (corner & 1)
            out[n, corner] = table[_slot(table, cells, i, j, k)]
    return out
