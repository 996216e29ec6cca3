"""Compiled loops of the renderer: surfels with a depth test, eye-dome lighting, lines in space.

A surfel is a disc around a point, across its normal. Each is drawn as an ellipse whose depth is that of its plane at
every pixel; colours of discs that overlap at the same depth are blended, so that a cloud looks like a surface.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vipe_core.compilation import compiled

Array = NDArray[Any]

FAR = np.float32(np.inf)
# A disc seen this flat is drawn as if it were less flat: its plane says nothing about depth any more.
_MIN_SLANT = 0.15
_MIN_RADIUS_PX = 0.75


@compiled
def draw_surfels(
    points: Array,
    normals: Array,
    colours: Array,
    radius: float,
    cam_from_world: Array,
    focal: float,
    cx: float,
    cy: float,
    near: float,
    back_faces: bool,
    depth: Array,
    total: Array,
) -> None:
    """Draws discs twice: first their depth, then the colours of those at the front.

    Args:
        points, normals: (P, 3) float32 in the world.
        colours: (P, 3) uint8.
        radius: Of the discs, in units of the world.
        focal, cx, cy: Of the pinhole camera, integer pixel indices.
        near: What is closer is left out.
        back_faces: Whether to draw discs that face away.
        depth: (h, w) float32 of infinity; becomes z.
        total: (h, w, 4) float32 of zeros; becomes weighted colour and weight.
    """
    h, w = depth.shape
    m = cam_from_world
    for turn in range(2):
        for n in range(len(points)):
            px, py, pz = points[n, 0], points[n, 1], points[n, 2]
            z = m[2, 0] * px + m[2, 1] * py + m[2, 2] * pz + m[2, 3]
            if z <= near:
                continue
            x = m[0, 0] * px + m[0, 1] * py + m[0, 2] * pz + m[0, 3]
            y = m[1, 0] * px + m[1, 1] * py + m[1, 2] * pz + m[1, 3]
            u, v = focal * x / z + cx, focal * y / z + cy
            size = max(_MIN_RADIUS_PX, focal * radius / z)
            if u < -size or v < -size or u > w - 1 + size or v > h - 1 + size:
                continue
            nx = m[0, 0] * normals[n, 0] + m[0, 1] * normals[n, 1] + m[0, 2] * normals[n, 2]
            ny = m[1, 0] * normals[n, 0] + m[1, 1] * normals[n, 1] + m[1, 2] * normals[n, 2]
            nz = m[2, 0] * normals[n, 0] + m[2, 1] * normals[n, 1] + m[2, 2] * normals[n, 2]
            along = (nx * x + ny * y + nz * z) / math.sqrt(x * x + y * y + z * z)
            if along > 0 and not back_faces:
                continue
            x0, x1 = max(0, math.ceil(u - size)), min(w - 1, math.floor(u + size))
            y0, y1 = max(0, math.ceil(v - size)), min(h - 1, math.floor(v + size))
            plane = abs(along) > _MIN_SLANT and size > 1.5
            offset = nx * x + ny * y + nz * z
            # On the plane of the disc, inverse depth is linear in the pixel.
            by_col, by_row, first = 0.0, 0.0, 1.0 / z
            if plane:
                by_col, by_row = nx / (focal * offset), ny / (focal * offset)
                first = nz / offset - by_col * cx - by_row * cy
            reach = 1.0 / (size * z / focal) ** 2
            flat = 1.0 / (size * size)
            for row in range(y0, y1 + 1):
                ry = (row - cy) / focal
                for col in range(x0, x1 + 1):
                    at = z
                    if plane:
                        inverse = first + by_col * col + by_row * row
                        if inverse * near >= 1 or inverse <= 0:
                            continue
                        at = 1.0 / inverse
                        ex, ey, ez = at * (col - cx) / focal - x, at * ry - y, at - z
                        share = (ex * ex + ey * ey + ez * ez) * reach
                    else:
                        share = ((col - u) * (col - u) + (row - v) * (row - v)) * flat
                    if share > 1:
                        continue
                    if turn == 0:
                        depth[row, col] = min(depth[row, col], at)
                    elif at < depth[row, col] + 1.5 * radius:
                        gain = (1.001 - share) * (1.001 - share)
                        for c in range(3):
                            total[row, col, c] += gain * colours[n, c]
                        total[row, col, 3] += gain


@compiled
def eye_dome(depth: Array, reach: int, strength: float) -> Array:
    """(h, w) float32 factor in 0..1: dark beside what is nearer (Boucheny 2009). 1 on the background."""
    h, w = depth.shape
    out = np.ones((h, w), np.float32)
    logs = np.empty((h, w), np.float32)
    for y in range(h):
        for x in range(w):
            logs[y, x] = math.log(depth[y, x]) if depth[y, x] < FAR else FAR
    rows, cols = np.empty(16, np.int64), np.empty(16, np.int64)
    for k in range(16):
        angle = 0.25 * math.pi * (k % 8)
        rows[k] = round((1 + k // 8) * reach * math.sin(angle))
        cols[k] = round((1 + k // 8) * reach * math.cos(angle))
    for y in range(h):
        for x in range(w):
            here = logs[y, x]
            if not here < FAR:
                continue
            total = 0.0
            for k in range(16):
                row, col = y + rows[k], x + cols[k]
                if row < 0 or col < 0 or row >= h or col >= w:
                    continue
                # The background is infinitely far and adds nothing.
                nearer = min(np.float32(0.08), here - logs[row, col])
                if nearer > 0:
                    total += nearer if k < 8 else 0.5 * nearer
            out[y, x] = math.exp(-strength * total / 12)
    return out


@compiled
def draw_line(
    start: Array,
    end: Array,
    colour: Array,
    radius_px: float,
    hidden: float,
    focal: float,
    cx: float,
    cy: float,
    near: float,
    depth: Array,
    image: Array,
    drawn: Array,
) -> None:
    """Draws a line of space, faint where something is in front of it.

    Args:
        start, end: (3,) in the frame of the camera.
        colour: (3,) 0..255.
        radius_px: Half of its width.
        hidden: Opacity behind surfaces.
        depth: (h, w) z of the surfaces.
        image: (h, w, 3) float32, drawn on.
        drawn: (h, w) float32 greatest opacity of what was drawn in this stroke; keeps joints of a polyline even.
    """
    h, w = depth.shape
    sx, sy, sz = start[0], start[1], start[2]
    ex, ey, ez = end[0], end[1], end[2]
    if sz <= near and ez <= near:
        return
    if sz <= near:
        share = (near - sz) / (ez - sz)
        sx, sy, sz = sx + share * (ex - sx), sy + share * (ey - sy), near
    elif ez <= near:
        share = (near - ez) / (sz - ez)
        ex, ey, ez = ex + share * (sx - ex), ey + share * (sy - ey), near
    u0, v0, u1, v1 = focal * sx / sz + cx, focal * sy / sz + cy, focal * ex / ez + cx, focal * ey / ez + cy
    length = math.sqrt((u1 - u0) ** 2 + (v1 - v0) ** 2)
    edge = radius_px + 0.5
    if max(u0, u1) < -edge or min(u0, u1) > w + edge or max(v0, v1) < -edge or min(v0, v1) > h + edge:
        return
    if length > 8 * (w + h):
        return
    x0, x1 = max(0, int(min(u0, u1) - edge)), min(w - 1, int(max(u0, u1) + edge) + 1)
    y0, y1 = max(0, int(min(v0, v1) - edge)), min(h - 1, int(max(v0, v1) + edge) + 1)
    for row in range(y0, y1 + 1):
        for col in range(x0, x1 + 1):
            t = 0.0
            if length > 0:
                t = ((col - u0) * (u1 - u0) + (row - v0) * (v1 - v0)) / (length * length)
                t = min(1.0, max(0.0, t))
            away = math.sqrt((u0 + t * (u1 - u0) - col) ** 2 + (v0 + t * (v1 - v0) - row) ** 2)
            opacity = min(1.0, max(0.0, edge - away))
            if opacity <= 0:
                continue
            z = 1 / ((1 - t) / sz + t / ez)
            if z > depth[row, col] * 1.01:
                opacity *= hidden
            # Where strokes overlap, the most opaque of them counts once.
            before = drawn[row, col]
            if opacity <= before:
                continue
            share = (opacity - before) / (1 - before)
            drawn[row, col] = opacity
            for c in range(3):
                image[row, col, c] += share * (colour[c] - image[row, col, c])
