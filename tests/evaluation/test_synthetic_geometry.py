"""The ray caster against closed-form intersections."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from vipe_core.cameras import Camera, CameraModel
from vipe_core.errors import ConfigError
from vipe_core.evaluation.synthetic import Light, Material, Motion, Scene, box, render_clip, room, room_scene, sphere
from vipe_core.evaluation.synthetic.paths import look_at
from vipe_core.evaluation.synthetic.render import render_frames

GREY = Material("plaster", ((0.5, 0.5, 0.5),) * 3)
LIGHT = Light((0.3, 0.4, 5.0))
CAMERAS: dict[CameraModel, Camera] = {
    "pinhole": Camera("pinhole", (30.0, 28.0, 15.0, 13.0), 32, 24),
    "mei": Camera("mei", (24.0, 25.0, 17.0, 11.5, 0.7), 32, 24),
    "equirect": Camera("equirect", (), 32, 16),
}


def camera_rays(camera: Camera) -> NDArray[np.float64]:
    """(H, W, 3) unit rays from the published formulas, pixel by pixel."""
    rays = np.zeros((camera.height, camera.width, 3))
    for j in range(camera.height):
        for i in range(camera.width):
            u, v = i + 0.5, j + 0.5
            if camera.model == "equirect":
                theta, phi = (u / camera.width - 0.5) * 2 * math.pi, v / camera.height * math.pi
                ray = (math.sin(phi) * math.sin(theta), -math.cos(phi), math.sin(phi) * math.cos(theta))
            else:
                fx, fy, cx, cy, *rest = camera.params
                k = rest[0] if rest else 0.0
                a, b = (u - cx) / fx, (v - cy) / fy
                rho2 = a * a + b * b
                s = (k + math.sqrt(1 + (1 - k * k) * rho2)) / (1 + rho2)
                ray = (a * s / (s - k), b * s / (s - k), 1.0)
            rays[j, i] = np.array(ray) / np.linalg.norm(ray)
    return rays


def expected(camera: Camera, distance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Depth of the kind that the model states, from distances along the rays (inf is sky)."""
    hit = np.where(np.isfinite(distance), distance, 0.0)
    return hit * camera_rays(camera)[..., 2] if camera.model == "pinhole" else hit


def render_depth(scene: Scene, camera: Camera, pose: NDArray[np.float64]) -> NDArray[np.float32]:
    return render_clip(scene, camera, pose[None]).depth[0]


@pytest.mark.parametrize("model", ["pinhole", "mei", "equirect"])
@settings(deadline=None, max_examples=25)
@given(height=st.floats(0.2, 8.0), x=st.floats(-2.0, 2.0), z=st.floats(-0.6, 0.6), yaw=st.floats(-3.1, 3.1))
def test_depth_of_a_plane(model: CameraModel, height: float, x: float, z: float, yaw: float) -> None:
    camera = CAMERAS[model]
    eye = np.array([x, -0.5, height])
    pose = look_at(eye, eye + np.array([math.cos(yaw), math.sin(yaw), z]))
    scene = Scene((box((0.0, 0.0, -0.5), (2e4, 2e4, 1.0), GREY),), LIGHT)
    rays = camera_rays(camera) @ pose[:3, :3].T
    with np.errstate(divide="ignore"):
        distance = np.where(rays[..., 2] < 0, height / -rays[..., 2], np.inf)
    near = distance < 5e3  # the slab ends somewhere
    depth = render_depth(scene, camera, pose)
    np.testing.assert_allclose(depth[near], expected(camera, distance)[near], rtol=1e-6)
    assert (depth[~np.isfinite(distance)] == 0).all()


@pytest.mark.parametrize("model", ["pinhole", "mei", "equirect"])
@settings(deadline=None, max_examples=25)
@given(gap=st.floats(0.1, 40.0), radius=st.floats(0.05, 5.0), aim=st.floats(-0.8, 0.8), azimuth=st.floats(-3.1, 3.1))
def test_depth_of_a_sphere(model: CameraModel, gap: float, radius: float, aim: float, azimuth: float) -> None:
    camera = CAMERAS[model]
    centre = np.array([0.3, -0.2, 1.0])
    eye = centre + (gap + radius) * np.array([math.cos(azimuth), math.sin(azimuth), 0.2]) / math.hypot(1.0, 0.2)
    pose = look_at(eye, centre + radius * np.array([0.0, 0.0, aim]))
    rays = camera_rays(camera) @ pose[:3, :3].T
    half_b, c = rays @ (eye - centre), (eye - centre) @ (eye - centre) - radius**2
    root = half_b**2 - c
    distance = np.where((root > 0) & (half_b < 0), -half_b - np.sqrt(np.maximum(root, 0)), np.inf)
    clear = np.abs(root) > 1e-6 * c  # pixels that do not graze the silhouette
    depth = render_depth(Scene((sphere((0.3, -0.2, 1.0), radius, GREY),), LIGHT), camera, pose)
    np.testing.assert_allclose(depth[clear], expected(camera, distance)[clear], rtol=1e-5)


@pytest.mark.parametrize("model", ["pinhole", "mei", "equirect"])
def test_a_room_is_closed_and_its_walls_are_where_they_should_be(model: CameraModel) -> None:
    camera = CAMERAS[model]
    eye = np.array([1.0, 2.0, 1.2])
    pose = look_at(eye, np.array([3.0, 2.5, 1.0]))
    low, high = np.array([0.0, 0.0, 0.0]), np.array([4.0, 5.0, 2.5])
    rays = camera_rays(camera) @ pose[:3, :3].T
    distance = np.min(np.where(rays > 0, (high - eye) / rays, (low - eye) / rays), axis=-1)
    depth = render_depth(Scene((room((0, 0, 0), (4, 5, 2.5), GREY),), LIGHT), camera, pose)
    np.testing.assert_allclose(depth, expected(camera, distance), rtol=1e-6)


@pytest.mark.parametrize("model", ["pinhole", "mei", "equirect"])
def test_a_scene_is_the_nearest_of_its_parts(model: CameraModel) -> None:
    """Nothing is lost by the culling of tiles: rendered one by one, the primitives give the same depth."""
    camera = CAMERAS[model].resized(64, 48 if model != "equirect" else 32)
    pose = look_at(np.array([4.6, 0.9, 1.5]), np.array([2.5, 3.0, 0.6]))
    scene = room_scene()
    whole = render_depth(scene, camera, pose)
    nearest = np.full(whole.shape, np.inf, np.float32)
    for primitive in scene.primitives:
        part = render_depth(Scene((primitive,), scene.light), camera, pose)
        nearest = np.minimum(nearest, np.where(part != 0, part, np.inf))
    np.testing.assert_array_equal(whole, nearest)


def test_a_turned_box_is_hit_on_its_corner() -> None:
    camera = Camera("pinhole", (50.0, 50.0, 15.5, 11.5), 31, 23)
    turned = box((0.0, 0.0, 0.0), (2.0, 2.0, 2.0), GREY, yaw_deg=45.0)
    depth = render_depth(Scene((turned,), LIGHT), camera, look_at(np.array([-5.0, 0.0, 0.0]), np.zeros(3)))
    assert depth[11, 15] == pytest.approx(5.0 - math.sqrt(2.0), rel=1e-6)


def test_moving_things_are_masked_where_they_are() -> None:
    camera = Camera.pinhole_from_fov(60.0, 64, 48)
    moving = sphere((0.0, 0.0, 1.0), 0.5, GREY, motion=Motion(velocity=(0.0, 1.0, 0.0)))
    background = box((4.0, 0.0, 1.0), (0.2, 30.0, 30.0), GREY)
    pose = look_at(np.array([-3.0, 0.0, 1.0]), np.array([0.0, 0.0, 1.0]))
    first, second = render_frames(Scene((background, moving), LIGHT), camera, np.stack([pose, pose]), fps=1.0)
    for frame, offset in ((first, 0.0), (second, 1.0)):
        rays = camera_rays(camera) @ pose[:3, :3].T
        towards = np.array([3.0, offset, 0.0])
        along = rays @ towards
        inside = towards @ towards - along**2 < 0.25
        np.testing.assert_array_equal(frame.dynamic, inside)
    assert first.dynamic.any()
    assert not np.array_equal(first.dynamic, second.dynamic)


def test_same_seed_same_bytes_and_noise_is_seeded() -> None:
    camera = CAMERAS["pinhole"]
    poses = look_at(np.array([[4.6, 0.9, 1.5], [4.5, 0.9, 1.5]]), np.array([2.5, 3.0, 0.6]))
    clean = render_clip(room_scene(), camera, poses)
    noisy = [render_clip(room_scene(), camera, poses, noise=2.0, seed=seed) for seed in (1, 1, 2)]
    np.testing.assert_array_equal(clean.rgb, render_clip(room_scene(), camera, poses).rgb)
    np.testing.assert_array_equal(noisy[0].rgb, noisy[1].rgb)
    assert (noisy[0].rgb != noisy[2].rgb).mean() > 0.3
    np.testing.assert_array_equal(noisy[0].depth, clean.depth)
    spread = (noisy[0].rgb.astype(np.float64) - clean.rgb)[(clean.rgb > 10) & (clean.rgb < 245)].std()
    assert spread == pytest.approx(2.0, rel=0.1)


def test_bad_primitives_are_refused() -> None:
    with pytest.raises(ConfigError, match="positive"):
        box((0, 0, 0), (1.0, 0.0, 1.0), GREY)
    with pytest.raises(ConfigError, match="1 or 6"):
        box((0, 0, 0), (1.0, 1.0, 1.0), GREY, GREY)
