"""A box in a room, seen exactly by any camera: depth at every pixel, and how far any point is from the surfaces."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from vipe_core.annotation import DepthKind
from vipe_core.cameras import Camera
from vipe_core.fusion import SurfaceView

Array = NDArray[Any]

ROOM = np.array([3.0, 2.0, 3.0])  # half sides, round the origin
BOX_CENTRE, BOX = np.array([0.3, 0.9, 1.2]), np.array([0.6, 1.1, 0.5])
WALL_COLOURS = np.array([[200, 60, 60], [60, 200, 60], [60, 60, 200]], np.uint8)  # by axis


def pose(x: float, y: float, z: float, turn_deg: float = 0.0) -> Array:
    """(4, 4) world_from_cam, turned about the vertical axis."""
    angle = np.radians(turn_deg)
    out = np.eye(4)
    out[0, 0] = out[2, 2] = np.cos(angle)
    out[0, 2], out[2, 0] = np.sin(angle), -np.sin(angle)
    out[:3, 3] = x, y, z
    return out


POSES = [pose(-1.2 + 0.3 * k, -0.4 + 0.05 * k, -2.4 + 0.1 * k, 12 - 3 * k) for k in range(9)]


def depth_and_colour(camera: Camera, world_from_cam: Array, kind: DepthKind) -> tuple[Array, Array]:
    """(H, W) float32 exact depth and (H, W, 3) uint8 colour of what each pixel sees."""
    rays = camera.rays()
    directions = rays @ world_from_cam[:3, :3].T
    directions = np.where(np.abs(directions) < 1e-12, 1e-12, directions)
    origin = world_from_cam[:3, 3]
    walls = (np.sign(directions) * ROOM - origin) / directions
    axis, along = walls.argmin(-1), walls.min(-1)
    a, b = (BOX_CENTRE - BOX - origin) / directions, (BOX_CENTRE + BOX - origin) / directions
    near, far = np.minimum(a, b), np.maximum(a, b)
    hit = (near.max(-1) < far.min(-1)) & (near.max(-1) > 0)
    along = np.where(hit, near.max(-1), along)
    axis = np.where(hit, near.argmax(-1), axis)
    depth = along * (np.linalg.norm(rays, axis=-1) if kind == "ray" else rays[..., 2])
    return np.where(depth > 0, depth, 0).astype(np.float32), WALL_COLOURS[axis]


def view(camera: Camera, world_from_cam: Array, kind: DepthKind = "z") -> SurfaceView:
    depth, rgb = depth_and_colour(camera, world_from_cam, kind)
    return SurfaceView(world_from_cam, rgb, depth, (depth > 0).astype(np.float32))


def distance_to_surfaces(points: Array) -> Array:
    """(P,) distance of points to the nearest wall or face of the box."""
    walls = np.abs(ROOM - np.abs(points)).min(axis=-1)
    outside = np.abs(points - BOX_CENTRE) - BOX
    box = np.where(
        outside.max(-1) > 0, np.linalg.norm(np.maximum(outside, 0), axis=-1), -outside.max(-1, initial=-np.inf)
    )
    return np.minimum(walls, np.abs(box))
