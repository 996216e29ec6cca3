"""The ray caster's geometry: the nearest surface along each ray, its texture coordinates and its light.

Nothing here is sampled or iterated: a hit is the closed-form intersection in float64, so depth is exact. Rays are
grouped in tiles; a primitive whose bounding sphere misses the cone of a tile is not tested for the rays of that tile.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from vipe_core.compilation import compiled

_EPS = 1e-9


@compiled
def tile_candidates(
    axis: NDArray[np.float64],
    half_angle: NDArray[np.float64],
    kind: NDArray[np.int64],
    offset: NDArray[np.float64],
    bound: NDArray[np.float64],
    candidates: NDArray[np.int64],
    counts: NDArray[np.int64],
) -> None:
    """Fills `candidates` (T, P) and `counts` (T,) with the primitives that may be seen in each tile.

    Args:
        axis: (T, 3) unit cone axes, world.
        half_angle: (T,) radians.
        offset: (P, 3) centres relative to the camera, world axes.
    """
    for tile in range(axis.shape[0]):
        count = 0
        for i in range(kind.shape[0]):
            distance = math.sqrt(offset[i, 0] ** 2 + offset[i, 1] ** 2 + offset[i, 2] ** 2)
            visible = kind[i] == 2 or distance <= bound[i]
            if not visible:
                along = axis[tile, 0] * offset[i, 0] + axis[tile, 1] * offset[i, 1] + axis[tile, 2] * offset[i, 2]
                angle = math.acos(min(1.0, max(-1.0, along / distance)))
                visible = angle <= half_angle[tile] + math.asin(bound[i] / distance) + 1e-9
            if visible:
                candidates[tile, count] = i
                count += 1
        counts[tile] = count


@compiled
def _hit_box(
    ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, hx: float, hy: float, hz: float, inside: bool
) -> tuple[float, int]:
    """Slab test in the local frame: (t, face) of the entry, or of the exit for a room; (inf, 0) for a miss."""
    if abs(dx) < 1e-14:
        dx = 1e-14
    if abs(dy) < 1e-14:
        dy = 1e-14
    if abs(dz) < 1e-14:
        dz = 1e-14
    # Entry through the face that the direction points away from: its side is negative where the direction is positive.
    sx = 1.0 if dx > 0 else -1.0
    sy = 1.0 if dy > 0 else -1.0
    sz = 1.0 if dz > 0 else -1.0
    near_x, far_x = (-sx * hx - ox) / dx, (sx * hx - ox) / dx
    near_y, far_y = (-sy * hy - oy) / dy, (sy * hy - oy) / dy
    near_z, far_z = (-sz * hz - oz) / dz, (sz * hz - oz) / dz
    near, face = near_x, (0 if sx > 0 else 1)
    if near_y > near:
        near, face = near_y, (2 if sy > 0 else 3)
    if near_z > near:
        near, face = near_z, (4 if sz > 0 else 5)
    far, exit_face = far_x, (1 if sx > 0 else 0)
    if far_y < far:
        far, exit_face = far_y, (3 if sy > 0 else 2)
    if far_z < far:
        far, exit_face = far_z, (5 if sz > 0 else 4)
    if near > far or far < _EPS:
        return math.inf, 0
    if inside:
        return far, exit_face
    if near < _EPS:
        return math.inf, 0
    return near, face


@compiled
def _hit_sphere(ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, radius: float) -> float:
    """Nearest intersection in front of a unit-direction ray that starts outside; inf for a miss."""
    b = ox * dx + oy * dy + oz * dz
    if b > 0:
        return math.inf
    # |o - b d|^2 is the squared distance of the line from the centre; this form loses no digits far away.
    px, py, pz = ox - b * dx, oy - b * dy, oz - b * dz
    gap = radius * radius - (px * px + py * py + pz * pz)
    if gap < 0:
        return math.inf
    t = -b - math.sqrt(gap)
    return t if t > _EPS else math.inf


@compiled
def _lamp_cell(x: float, y: float, z: float, per_edge: int) -> int:
    """The cell of a cube around the lamp that the direction (x, y, z) from the lamp passes through; 0 for the sun."""
    if per_edge == 0:
        return 0
    ax, ay, az = abs(x), abs(y), abs(z)
    if ax >= ay and ax >= az:
        face, size, first, second = (1 if x > 0 else 0), ax, y, z
    elif ay >= az:
        face, size, first, second = (3 if y > 0 else 2), ay, z, x
    else:
        face, size, first, second = (5 if z > 0 else 4), az, x, y
    column = min(per_edge - 1, int((first / size + 1.0) * 0.5 * per_edge))
    row = min(per_edge - 1, int((second / size + 1.0) * 0.5 * per_edge))
    return (face * per_edge + row) * per_edge + column


@compiled
def _occluded(
    x: float,
    y: float,
    z: float,
    dx: float,
    dy: float,
    dz: float,
    reach: float,
    possible: NDArray[np.int64],
    kind: NDArray[np.int64],
    centre: NDArray[np.float64],
    rotation: NDArray[np.float64],
    half: NDArray[np.float64],
    bound: NDArray[np.float64],
) -> bool:
    """Whether one of the solids `possible` lies between a surface point and the light, `reach` metres away."""
    for slot in range(possible.shape[0]):
        i = possible[slot]
        wx, wy, wz = centre[i, 0] - x, centre[i, 1] - y, centre[i, 2] - z
        along = wx * dx + wy * dy + wz * dz
        if along < -bound[i] or along > reach + bound[i]:
            continue
        if wx * wx + wy * wy + wz * wz - along * along > bound[i] * bound[i]:
            continue
        if kind[i] == 1:
            t = _hit_sphere(-wx, -wy, -wz, dx, dy, dz, half[i, 0])
        else:
            r = rotation[i]
            t, _ = _hit_box(
                -(r[0, 0] * wx + r[0, 1] * wy + r[0, 2] * wz),
                -(r[1, 0] * wx + r[1, 1] * wy + r[1, 2] * wz),
                -(r[2, 0] * wx + r[2, 1] * wy + r[2, 2] * wz),
                r[0, 0] * dx + r[0, 1] * dy + r[0, 2] * dz,
                r[1, 0] * dx + r[1, 1] * dy + r[1, 2] * dz,
                r[2, 0] * dx + r[2, 1] * dy + r[2, 2] * dz,
                half[i, 0],
                half[i, 1],
                half[i, 2],
                False,
            )
        if t < reach:
            return True
    return False


@compiled
def cast(
    world_from_cam: NDArray[np.float64],
    directions: NDArray[np.float64],
    tile_of_ray: NDArray[np.int64],
    candidates: NDArray[np.int64],
    counts: NDArray[np.int64],
    kind: NDArray[np.int64],
    centre: NDArray[np.float64],
    rotation: NDArray[np.float64],
    half: NDArray[np.float64],
    bound: NDArray[np.float64],
    light: NDArray[np.float64],
    cells_per_edge: int,
    occluders: NDArray[np.int64],
    occluder_counts: NDArray[np.int64],
    distance: NDArray[np.float64],
    surface: NDArray[np.int32],
    coords: NDArray[np.float64],
    facing: NDArray[np.float64],
    shade: NDArray[np.float64],
) -> None:
    """Casts R rays from one point; fills the outputs.

    Args:
        world_from_cam: (4, 4) pose; its translation is where all rays start.
        directions: (R, 3) unit vectors, camera axes.
        tile_of_ray: (R,) row of `candidates` for each ray.
        light: (6,) x, y, z, is_sun, ambient, diffuse.
        cells_per_edge, occluders, occluder_counts: As in `shadows.ShadowCells`.
        distance: Output (R,) metres along the ray; inf where nothing is hit.
        surface: Output (R,) 16 * primitive + 2 * face + in_shadow, -1 where nothing is hit.
        coords: Output (R, 3) texture coordinates, metres: (u, v, 0) from a face's corner, the local point on a sphere.
        facing: Output (R,) cosine between the surface normal and the ray.
        shade: Output (R,) brightness factor.
    """
    origin = world_from_cam[:, 3]
    a = world_from_cam
    # Relative origins in every local frame, once for all rays.
    local_origin = np.empty((kind.shape[0], 3))
    for i in range(kind.shape[0]):
        wx, wy, wz = origin[0] - centre[i, 0], origin[1] - centre[i, 1], origin[2] - centre[i, 2]
        for k in range(3):
            local_origin[i, k] = rotation[i, k, 0] * wx + rotation[i, k, 1] * wy + rotation[i, k, 2] * wz

    for ray in range(directions.shape[0]):
        cx, cy, cz = directions[ray, 0], directions[ray, 1], directions[ray, 2]
        dx = a[0, 0] * cx + a[0, 1] * cy + a[0, 2] * cz
        dy = a[1, 0] * cx + a[1, 1] * cy + a[1, 2] * cz
        dz = a[2, 0] * cx + a[2, 1] * cy + a[2, 2] * cz
        tile = tile_of_ray[ray]
        best, hit, face = math.inf, -1, 0
        for slot in range(counts[tile]):
            i = candidates[tile, slot]
            r = rotation[i]
            lx = r[0, 0] * dx + r[0, 1] * dy + r[0, 2] * dz
            ly = r[1, 0] * dx + r[1, 1] * dy + r[1, 2] * dz
            lz = r[2, 0] * dx + r[2, 1] * dy + r[2, 2] * dz
            ox, oy, oz = local_origin[i, 0], local_origin[i, 1], local_origin[i, 2]
            if kind[i] == 1:
                t, this_face = _hit_sphere(ox, oy, oz, lx, ly, lz, half[i, 0]), 0
            else:
                t, this_face = _hit_box(ox, oy, oz, lx, ly, lz, half[i, 0], half[i, 1], half[i, 2], kind[i] == 2)
            if t < best:
                best, hit, face = t, i, this_face
        distance[ray] = best
        if hit < 0:
            surface[ray] = -1
            facing[ray] = 1.0
            shade[ray] = 1.0
            coords[ray, 0], coords[ray, 1], coords[ray, 2] = dx, dy, dz
            continue

        r = rotation[hit]
        px = local_origin[hit, 0] + best * (r[0, 0] * dx + r[0, 1] * dy + r[0, 2] * dz)
        py = local_origin[hit, 1] + best * (r[1, 0] * dx + r[1, 1] * dy + r[1, 2] * dz)
        pz = local_origin[hit, 2] + best * (r[2, 0] * dx + r[2, 1] * dy + r[2, 2] * dz)
        hx, hy, hz = half[hit, 0], half[hit, 1], half[hit, 2]
        corner = 1.0
        if kind[hit] == 1:
            nx, ny, nz = px / hx, py / hx, pz / hx
            coords[ray, 0], coords[ray, 1], coords[ray, 2] = px, py, pz
        else:
            side = 1.0 if face % 2 == 1 else -1.0
            if kind[hit] == 2:
                side = -side
                # Corners of a room receive less of the sky of light: a cheap stand-in for ambient occlusion.
                if face >= 2:
                    corner *= 1.0 - 0.30 * math.exp(-(hx - abs(px)) / 0.3)
                if face < 2 or face >= 4:
                    corner *= 1.0 - 0.30 * math.exp(-(hy - abs(py)) / 0.3)
                if face < 4:
                    corner *= 1.0 - 0.30 * math.exp(-(hz - abs(pz)) / 0.3)
            nx, ny, nz = 0.0, 0.0, 0.0
            if face < 2:
                nx = side
                coords[ray, 0], coords[ray, 1] = py + hy, pz + hz
            elif face < 4:
                ny = side
                coords[ray, 0], coords[ray, 1] = px + hx, pz + hz
            else:
                nz = side
                coords[ray, 0], coords[ray, 1] = px + hx, py + hy
            coords[ray, 2] = 0.0
        # Normal in the world: the rotation's transpose.
        mx = r[0, 0] * nx + r[1, 0] * ny + r[2, 0] * nz
        my = r[0, 1] * nx + r[1, 1] * ny + r[2, 1] * nz
        mz = r[0, 2] * nx + r[1, 2] * ny + r[2, 2] * nz
        facing[ray] = abs(mx * dx + my * dy + mz * dz)

        wx, wy, wz = origin[0] + best * dx, origin[1] + best * dy, origin[2] + best * dz
        vx, vy, vz, reach = light[0], light[1], light[2], math.inf
        if light[3] == 0.0:
            vx, vy, vz = light[0] - wx, light[1] - wy, light[2] - wz
        length = math.sqrt(vx * vx + vy * vy + vz * vz)
        vx, vy, vz = vx / length, vy / length, vz / length
        if light[3] == 0.0:
            reach = length
        lambert = mx * vx + my * vy + mz * vz
        shadowed = 0
        if lambert <= 0.0:
            lambert = 0.0
        else:
            # Start a little above the surface, else it would shade itself.
            sx, sy, sz = wx + 1e-4 * mx, wy + 1e-4 * my, wz + 1e-4 * mz
            cell = _lamp_cell(sx - light[0], sy - light[1], sz - light[2], cells_per_edge)
            possible = occluders[cell, : occluder_counts[cell]]
            if _occluded(sx, sy, sz, vx, vy, vz, reach, possible, kind, centre, rotation, half, bound):
                lambert, shadowed = 0.0, 1
        shade[ray] = corner * (light[4] * (0.95 + 0.05 * mz) + light[5] * lambert)
        surface[ray] = 16 * hit + 2 * face + shadowed
