"""Renders frames of a scene with exact depth: one ray per pixel, four more where surfaces or shadows meet."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vipe_core.annotation import depth_kind_of
from vipe_core.cameras import Camera
from vipe_core.evaluation.synthetic.cast import cast, tile_candidates
from vipe_core.evaluation.synthetic.rays import RayGrid, unit_rays
from vipe_core.evaluation.synthetic.scene import PackedScene, Scene, pack
from vipe_core.evaluation.synthetic.shadows import ShadowCells
from vipe_core.evaluation.synthetic.texture import shade

# A rotated 2x2 grid of subpixel offsets.
_SUBPIXELS = np.array([[-0.125, -0.375], [0.375, -0.125], [0.125, 0.375], [-0.375, 0.125]])
_MIN_FACING = 0.12  # footprints grow with 1 / cosine; at grazing angles they are cut here


@dataclass(frozen=True, slots=True)
class RenderedFrame:
    """One frame with its truth.

    Attributes:
        rgb: (H, W, 3) uint8.
        depth: (H, W) float32 at the pixel centres, metres; 0 is sky. Kind: `depth_kind_of(camera)`.
        dynamic: (H, W) bool, pixels of moving primitives.
        surface: (H, W) int32, which face of which primitive is seen (shadow bit cleared); -1 is sky.
    """

    rgb: NDArray[np.uint8]
    depth: NDArray[np.float32]
    dynamic: NDArray[np.bool_]
    surface: NDArray[np.int32]


@dataclass(frozen=True, slots=True)
class _Hits:
    distance: NDArray[np.float64]
    surface: NDArray[np.int32]
    rgb: NDArray[np.float32]


def render_frames(
    scene: Scene,
    camera: Camera,
    world_from_cam: NDArray[np.float64],
    *,
    fps: float = 24.0,
    noise: float = 0.0,
    seed: int = 0,
) -> Iterator[RenderedFrame]:
    """Frames of `scene` one at a time; frame i shows the scene at i / fps seconds.

    Args:
        world_from_cam: (N, 4, 4) poses, OpenCV axes, z-up world in metres.
        noise: Standard deviation of additive sensor noise in 8-bit steps, per frame and channel.
        seed: Seed of that noise.
    """
    grid = RayGrid.of(camera)
    shadows = ShadowCells.of(scene, pack(scene, 0.0))
    for index, pose in enumerate(world_from_cam):
        frame = _render(scene, grid, shadows, np.ascontiguousarray(pose, dtype=np.float64), index / fps)
        if noise > 0:
            rng = np.random.default_rng((seed, index))
            grainy = frame.rgb + noise * rng.standard_normal(frame.rgb.shape, dtype=np.float32)
            rgb = np.clip(np.rint(grainy), 0, 255).astype(np.uint8)
            frame = RenderedFrame(rgb, frame.depth, frame.dynamic, frame.surface)
        yield frame


def _render(
    scene: Scene, grid: RayGrid, shadows: ShadowCells, world_from_cam: NDArray[np.float64], time_s: float
) -> RenderedFrame:
    camera = grid.camera
    packed = pack(scene, time_s)
    candidates = np.empty((len(grid.tile_axis), len(packed.kind)), np.int64)
    counts = np.empty(len(grid.tile_axis), np.int64)
    tile_candidates(
        grid.tile_axis @ world_from_cam[:3, :3].T,
        grid.tile_half_angle,
        packed.kind,
        packed.centre - world_from_cam[:3, 3],
        packed.bound,
        candidates,
        counts,
    )

    def trace(rays: NDArray[np.float64], tile: NDArray[np.int64], pixel_angle: NDArray[np.float64]) -> _Hits:
        return _trace(scene, packed, shadows, world_from_cam, rays, tile, pixel_angle, candidates, counts)

    hits = trace(grid.directions, grid.tile, grid.pixel_angle)
    rgb = hits.rgb
    edges = np.flatnonzero(_borders(hits.surface.reshape(camera.height, camera.width)))
    if len(edges):
        v, u = np.divmod(edges, camera.width)
        points = np.stack([u + 0.5, v + 0.5], axis=-1)[:, None] + _SUBPIXELS
        rays = unit_rays(camera, points[..., 0], points[..., 1]).reshape(-1, 3)
        samples = len(_SUBPIXELS)
        fine = trace(rays, np.repeat(grid.tile[edges], samples), np.repeat(0.5 * grid.pixel_angle[edges], samples))
        rgb[edges] = fine.rgb.reshape(-1, samples, 3).mean(axis=1)

    shape = (camera.height, camera.width)
    distance = np.where(np.isfinite(hits.distance), hits.distance, 0.0)
    if depth_kind_of(camera) == "z":
        distance = distance * grid.directions[:, 2]
    primitive = hits.surface >> 4
    dynamic = packed.dynamic[np.maximum(primitive, 0)] & (primitive >= 0)
    return RenderedFrame(
        rgb=np.rint(np.clip(rgb, 0, 255)).astype(np.uint8).reshape(*shape, 3),
        depth=distance.astype(np.float32).reshape(shape),
        dynamic=dynamic.reshape(shape),
        surface=(hits.surface & ~1 | -(hits.surface < 0).astype(np.int32)).reshape(shape),
    )


def _trace(
    scene: Scene,
    packed: PackedScene,
    shadows: ShadowCells,
    world_from_cam: NDArray[np.float64],
    directions: NDArray[np.float64],
    tile: NDArray[np.int64],
    pixel_angle: NDArray[np.float64],
    candidates: NDArray[np.int64],
    counts: NDArray[np.int64],
) -> _Hits:
    rays = len(directions)
    distance, surface = np.empty(rays), np.empty(rays, np.int32)
    coords, facing, brightness = np.empty((rays, 3)), np.empty(rays), np.empty(rays)
    lamp = scene.light
    light = np.array([*lamp.position, float(lamp.is_sun), lamp.ambient, lamp.diffuse], dtype=np.float64)
    cast(
        world_from_cam,
        directions,
        tile,
        candidates,
        counts,
        packed.kind,
        packed.centre,
        packed.local_from_world,
        packed.half,
        packed.bound,
        light,
        shadows.per_edge,
        shadows.candidates,
        shadows.counts,
        distance,
        surface,
        coords,
        facing,
        brightness,
    )
    primitive, face = surface >> 4, (surface >> 1) & 7
    hit = surface >= 0
    material = np.where(hit, packed.face_material[np.maximum(primitive, 0), np.minimum(face, 5)], -1)
    footprint = pixel_angle * np.where(hit, distance, 1.0) / np.maximum(facing, _MIN_FACING)
    rgb = np.empty((rays, 3), np.float32)
    variant = np.where(hit, primitive * 6 + face, 0).astype(np.int64)
    sky = np.array(scene.sky, dtype=np.float64).ravel()
    shade(packed.materials, sky, material, variant, coords, footprint, brightness, rgb)
    return _Hits(distance, surface, rgb)


def _borders(surface: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Pixels whose surface or shadow differs from one of their four neighbours."""
    border = np.zeros(surface.shape, np.bool_)
    across = surface[:, 1:] != surface[:, :-1]
    along = surface[1:] != surface[:-1]
    border[:, 1:] |= across
    border[:, :-1] |= across
    border[1:] |= along
    border[:-1] |= along
    return border
