"""A point cloud and a camera path as a picture: surfels with eye-dome lighting, twice as large and then reduced."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vipe_core.cameras import Camera
from vipe_core.fusion import PointCloud
from vipe_core.geometry.arrays import inverse
from vipe_core.rendering.kernels import FAR, draw_line, draw_surfels, eye_dome

Array = NDArray[Any]
Canvas = NDArray[np.uint8]

_SUPERSAMPLING = 2
_BACKGROUND = ((38.0, 43.0, 52.0), (14.0, 16.0, 20.0))  # in the middle, in the corners
_DISC_VOXELS = 1.0  # radius of a disc: discs of neighbouring voxels overlap by half
# Colours of the path from its start to its end.
_PATH = np.array([(255, 190, 60), (240, 80, 110), (150, 95, 255)], np.float64)


@dataclass(frozen=True, slots=True)
class Path3D:
    """A camera path to draw.

    Attributes:
        world_from_cam: (N, 4, 4).
        camera: Gives the frusta their shape.
        frustum: Their length in units of the world.
        num_frusta: How many along the path; 0 for none.
        upto: Draw the path to this index only, with a frustum there; all of it if None.
        colour: One for all of it; from amber to violet if None.
        width: Of the lines, 1 is usual.
    """

    world_from_cam: NDArray[np.float64]
    camera: Camera
    frustum: float
    num_frusta: int = 7
    upto: int | None = None
    colour: tuple[float, float, float] | None = None
    width: float = 1.0

    def colour_at(self, index: float) -> Array:
        """Colour of the path at an index of its poses."""
        share = index / max(1, len(self.world_from_cam) - 1)
        return np.array(self.colour if self.colour is not None else path_colour(share))


def render_cloud(
    cloud: PointCloud,
    world_from_cam: Array,
    camera: Camera,
    *,
    paths: Sequence[Path3D] = (),
    back_faces: bool = False,
    clay: bool = False,
) -> Canvas:
    """(H, W, 3) uint8 picture of a cloud.

    Args:
        world_from_cam: (4, 4) pose of the viewer.
        camera: Of the viewer, pinhole with square pixels.
        paths: Drawn in this order with the depth test: dim behind surfaces.
        back_faces: Whether to draw surfaces from behind. Without, one looks into a room through its walls.
        clay: In one colour, lit from above the viewer, instead of in the colours of the frames.
    """
    scale = _SUPERSAMPLING
    large = camera.resized(camera.width * scale, camera.height * scale)
    focal, _, cx, cy = (float(value) for value in large.index_params())
    cam_from_world = inverse(world_from_cam)
    height, width = large.height, large.width
    depth = np.full((height, width), FAR, np.float32)
    total = np.zeros((height, width, 4), np.float32)
    colours = _clay(cloud.normals, world_from_cam) if clay else cloud.colours
    near = 2 * cloud.spacing
    draw_surfels(
        cloud.points,
        cloud.normals,
        colours,
        _DISC_VOXELS * cloud.spacing,
        cam_from_world,
        focal,
        cx,
        cy,
        near,
        back_faces,
        depth,
        total,
    )
    image = _background(height, width)
    hit = total[..., 3] > 0
    image[hit] = total[hit][:, :3] / total[hit][:, 3:]
    image *= eye_dome(depth, scale, 30.0 if not clay else 40.0)[..., None]
    for path in paths:
        _draw_path(image, depth, path, cam_from_world, focal, cx, cy, near)
    small = cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    return np.asarray(np.clip(np.rint(small), 0, 255), np.uint8)


def path_colour(share: float) -> tuple[float, float, float]:
    """Colour of the place `share` (0..1) along a path."""
    position = min(max(share, 0.0), 1.0) * (len(_PATH) - 1)
    first = min(int(position), len(_PATH) - 2)
    mixed = _PATH[first] + (position - first) * (_PATH[first + 1] - _PATH[first])
    return float(mixed[0]), float(mixed[1]), float(mixed[2])


def _background(height: int, width: int) -> NDArray[np.float32]:
    y = np.linspace(-1, 1, height, dtype=np.float32)[:, None]
    x = np.linspace(-1, 1, width, dtype=np.float32)[None, :]
    share = np.clip(np.sqrt((x * x + y * y) / 2), 0, 1)[..., None]
    middle, corner = (np.array(colour, np.float32) for colour in _BACKGROUND)
    return np.asarray((1 - share) * middle + share * corner, np.float32)


def _clay(normals: Array, world_from_cam: Array) -> Canvas:
    """Light from above the viewer's left shoulder, and a little from everywhere."""
    light = world_from_cam[:3, :3] @ np.array([-0.35, -0.35, -0.87])
    lit = np.clip(normals @ light, 0, 1)[:, None]
    around = (0.5 - 0.5 * (normals @ world_from_cam[:3, 1]))[:, None]
    shade = 0.2 + 0.25 * around + 0.6 * lit
    return np.asarray(np.clip(shade * np.array([226.0, 220.0, 210.0]), 0, 255), np.uint8)


def _draw_path(
    image: Array, depth: Array, path: Path3D, cam_from_world: Array, focal: float, cx: float, cy: float, near: float
) -> None:
    poses = path.world_from_cam
    count = len(poses)
    last = count - 1 if path.upto is None else path.upto
    local = poses[:, :3, 3] @ cam_from_world[:3, :3].T + cam_from_world[:3, 3]
    width = path.width * max(1.0, image.shape[1] / 900)

    def stroke(segments: list[tuple[Array, Array, Array]], radius: float, hidden: float) -> None:
        drawn = np.zeros(depth.shape, np.float32)
        for start, end, colour in segments:
            draw_line(start, end, colour, radius, hidden, focal, cx, cy, near, depth, image, drawn)

    line = [(local[k], local[k + 1], path.colour_at(k + 0.5)) for k in range(last)]
    dark = np.zeros(3)
    stroke([(a, b, dark) for a, b, _ in line], 2.6 * width, 0.12)
    stroke(line, 1.5 * width, 0.35)
    if path.num_frusta == 0:
        return
    shown = set(np.unique(np.linspace(0, last, min(path.num_frusta, last + 1)).round().astype(int)).tolist())
    edges = _frustum_edges(path.camera, path.frustum)
    for k in sorted(shown | {last}):
        pose = cam_from_world @ poses[k]
        colour = path.colour_at(k)
        lines = [(a @ pose[:3, :3].T + pose[:3, 3], b @ pose[:3, :3].T + pose[:3, 3], colour) for a, b in edges]
        current = k == last
        stroke([(a, b, dark) for a, b, _ in lines], (2.2 if current else 1.7) * width, 0.1)
        stroke(lines, (1.3 if current else 0.8) * width, 0.3)


def _frustum_edges(camera: Camera, length: float) -> list[tuple[Array, Array]]:
    """Edges of a pyramid with the picture as its base, in the camera frame; of a box for a camera that sees around."""
    if camera.model == "equirect":
        corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * 0.4 * length
        return [(corners[a], corners[b]) for a in range(8) for b in range(a + 1, 8) if (a ^ b) in (1, 2, 4)]
    wide = min(1.2, np.tan(np.radians(min(camera.fov_x_deg, 110.0)) / 2))
    high = wide * camera.height / camera.width
    base = length * np.array([[-wide, -high, 1], [wide, -high, 1], [wide, high, 1], [-wide, high, 1]])
    apex = np.zeros(3)
    return [(apex, corner) for corner in base] + [(base[k], base[(k + 1) % 4]) for k in range(4)]
