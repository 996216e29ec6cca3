"""Rendered clips are consistent with their own truth: colours agree at reprojected points."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from vipe_core.cameras import Camera, CameraModel
from vipe_core.errors import ConfigError
from vipe_core.evaluation.synthetic import (
    CLIP_KINDS,
    ClipKind,
    SyntheticClip,
    render_clip,
    render_rig,
    room_scene,
    sample_camera,
    tiny_clip,
)
from vipe_core.evaluation.synthetic.paths import handheld, look_at
from vipe_core.evaluation.synthetic.rays import unit_rays


def project(camera: Camera, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """(..., 3) camera points -> (..., 2) image points, half-pixel centres; the forward formulas of the models."""
    x, y, z = np.moveaxis(points, -1, 0)
    r = np.linalg.norm(points, axis=-1)
    if camera.model == "equirect":
        u = (np.arctan2(x, z) / (2 * math.pi) + 0.5) * camera.width
        return np.stack([u, np.arccos(-y / r) / math.pi * camera.height], axis=-1)
    fx, fy, cx, cy, *rest = camera.params
    denominator = z + (rest[0] if rest else 0.0) * r
    denominator = np.where(denominator > 1e-3, denominator, np.nan)
    return np.stack([fx * x / denominator + cx, fy * y / denominator + cy], axis=-1)


def bilinear(image: NDArray[np.float64], at: NDArray[np.float64]) -> NDArray[np.float64]:
    x, y = at[:, 0] - 0.5, at[:, 1] - 0.5
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    fx, fy = (x - left)[:, None], (y - top)[:, None]
    upper = image[top, left] * (1 - fx) + image[top, left + 1] * fx
    lower = image[top + 1, left] * (1 - fx) + image[top + 1, left + 1] * fx
    return upper * (1 - fy) + lower * fy


def colour_difference(clip: SyntheticClip, a: int, b: int, camera: Camera | None = None) -> tuple[float, int]:
    """Mean absolute difference, 8-bit steps, between static pixels of frame a and where they are seen in frame b."""
    camera = camera or clip.camera
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = unit_rays(camera, u, v)
    if clip.depth_kind == "z":
        rays = rays / rays[..., 2:]
    keep = (clip.depth[a] > 0) & ~clip.dynamic[a]
    local = clip.depth[a][keep][:, None].astype(np.float64) * rays[keep]
    b_from_a = np.linalg.inv(clip.world_from_cam[b]) @ clip.world_from_cam[a]
    moved = local @ b_from_a[:3, :3].T + b_from_a[:3, 3]
    at = project(camera, moved)
    with np.errstate(invalid="ignore"):
        inside = (at >= 1).all(-1) & (at[:, 0] < camera.width - 1) & (at[:, 1] < camera.height - 1)
    at, moved = at[inside], moved[inside]
    seen = moved[:, 2] if clip.depth_kind == "z" else np.linalg.norm(moved, axis=-1)
    column, row = np.floor(at[:, 0]).astype(int), np.floor(at[:, 1]).astype(int)
    visible = (np.abs(clip.depth[b][row, column] / seen - 1) < 0.01) & ~clip.dynamic[b][row, column]
    source = clip.rgb[a][keep][inside][visible].astype(np.float64)
    target = bilinear(clip.rgb[b].astype(np.float64), at[visible])
    return float(np.abs(source - target).mean()), int(visible.sum())


@pytest.mark.parametrize("model", ["pinhole", "mei", "equirect"])
def test_colours_agree_at_reprojected_points(model: CameraModel) -> None:
    camera = sample_camera(model, 320, 160 if model == "equirect" else 240)
    poses = look_at(np.array([[3.9, 0.9, 1.4], [3.78, 0.95, 1.42]]), np.array([[3.0, 3.0, 0.9], [3.05, 3.0, 0.9]]))
    clip = render_clip(room_scene(), camera, handheld(poses, seed=4))
    difference, count = colour_difference(clip, 0, 1)
    assert count > 0.5 * camera.width * camera.height
    # A wrong pose, depth or camera shows at once: half a pixel of shift costs more than the whole difference.
    shifted = clip.rgb.copy()
    shifted[1] = np.roll(clip.rgb[1], 1, axis=1)
    shifted_clip = SyntheticClip(shifted, clip.depth, clip.dynamic, clip.world_from_cam, camera)
    assert difference < 6.0
    assert colour_difference(shifted_clip, 0, 1)[0] > 1.6 * difference
    if camera.params:
        longer = Camera(model, (camera.params[0] * 1.06, camera.params[1] * 1.06, *camera.params[2:]), 320, 240)
        assert colour_difference(clip, 0, 1, longer)[0] > 1.2 * difference


@pytest.mark.parametrize("kind", CLIP_KINDS)
def test_tiny_clips_do_what_their_name_says(kind: ClipKind) -> None:
    clip = tiny_clip(kind, num_frames=5, width=96, height=72)
    assert clip.rgb.shape == (5, 72, 96, 3)
    assert clip.depth.shape == clip.dynamic.shape == (5, 72, 96)
    centres = clip.world_from_cam[:, :3, 3]
    path = np.linalg.norm(np.diff(centres, axis=0), axis=1).sum()
    turn = np.abs(clip.world_from_cam[0, :3, :3] - clip.world_from_cam[-1, :3, :3]).max()
    assert (clip.depth > 0).all()
    assert clip.dynamic.any() == (kind == "dynamic")
    if kind == "static":
        assert (clip.rgb == clip.rgb[0]).all()
    assert (path > 0.5) == (kind not in ("static", "pure_rotation"))
    assert (turn > 0.05) == (kind in ("pure_rotation", "orbit", "dynamic"))
    if kind in ("forward", "sideways"):
        axis = 2 if kind == "forward" else 0
        along = (centres[-1] - centres[0]) @ clip.world_from_cam[0, :3, axis]
        assert along > 0.95 * path


def test_unknown_clip_is_refused() -> None:
    with pytest.raises(ConfigError, match="known: static"):
        tiny_clip("sliding")


def test_a_rig_moves_as_one_body() -> None:
    camera = sample_camera("pinhole", 64, 48)
    mount = np.eye(4)
    mount[0, 3] = 0.12
    world_from_rig = look_at(np.array([[4.0, 1.0, 1.4], [3.9, 1.1, 1.4]]), np.array([3.0, 3.0, 0.8]))
    left, right = render_rig(room_scene(), [camera, camera], [np.eye(4), mount], world_from_rig)
    np.testing.assert_allclose(np.linalg.inv(left.world_from_cam) @ right.world_from_cam, [mount, mount], atol=1e-12)
    assert (left.rgb != right.rgb).any()


def test_textures_do_not_shimmer() -> None:
    """Filtered textures keep their colour as the camera moves; picking single samples of a finer picture does not."""
    poses = look_at(np.array([[4.4, 1.0, 1.4], [4.34, 1.03, 1.41]]), np.array([2.5, 3.4, 0.7]))
    camera = Camera.pinhole_from_fov(60.0, 160, 120)
    filtered = render_clip(room_scene(), camera, poses)
    fine = render_clip(room_scene(), camera.resized(800, 600), poses)
    picked = SyntheticClip(fine.rgb[:, 2::5, 2::5], filtered.depth, filtered.dynamic, poses, camera)
    np.testing.assert_allclose(fine.depth[:, 2::5, 2::5], filtered.depth, rtol=1e-5)
    assert colour_difference(filtered, 0, 1)[0] < 0.8 * colour_difference(picked, 0, 1)[0]
