"""Clips in memory, for tests and experiments: frames, exact depth, masks, poses and the camera as arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from vipe_core.annotation import DepthKind, depth_kind_of
from vipe_core.cameras import Camera, CameraModel
from vipe_core.errors import ConfigError
from vipe_core.evaluation.synthetic.paths import arc, handheld, look_at, through
from vipe_core.evaluation.synthetic.render import render_frames
from vipe_core.evaluation.synthetic.scene import Scene
from vipe_core.evaluation.synthetic.scenes import moving_ball_scene, room_scene
from vipe_core.video.encode import VideoWriter

ClipKind = Literal["static", "pure_rotation", "forward", "sideways", "orbit", "dynamic"]
CLIP_KINDS: tuple[ClipKind, ...] = ("static", "pure_rotation", "forward", "sideways", "orbit", "dynamic")


@dataclass(frozen=True, slots=True)
class SyntheticClip:
    """A rendered clip with its truth.

    Attributes:
        rgb: (N, H, W, 3) uint8.
        depth: (N, H, W) float32 metres of kind `depth_kind`; 0 is sky.
        dynamic: (N, H, W) bool, pixels of moving things.
        world_from_cam: (N, 4, 4) float64, OpenCV axes; the world has z up and metres.
    """

    rgb: NDArray[np.uint8]
    depth: NDArray[np.float32]
    dynamic: NDArray[np.bool_]
    world_from_cam: NDArray[np.float64]
    camera: Camera
    fps: float = 24.0

    @property
    def depth_kind(self) -> DepthKind:
        return depth_kind_of(self.camera)

    def write_video(self, path: Path) -> Path:
        """Its pictures as a video file."""
        with VideoWriter(path, self.fps) as writer:
            for rgb in self.rgb:
                writer.write(rgb)
        return path


def render_clip(
    scene: Scene,
    camera: Camera,
    world_from_cam: NDArray[np.float64],
    *,
    fps: float = 24.0,
    noise: float = 0.0,
    seed: int = 0,
) -> SyntheticClip:
    """Renders all frames into memory; arguments as `render_frames`."""
    poses = np.array(world_from_cam, dtype=np.float64)
    frames = list(render_frames(scene, camera, poses, fps=fps, noise=noise, seed=seed))
    return SyntheticClip(
        rgb=np.stack([f.rgb for f in frames]),
        depth=np.stack([f.depth for f in frames]),
        dynamic=np.stack([f.dynamic for f in frames]),
        world_from_cam=poses,
        camera=camera,
        fps=fps,
    )


def render_rig(
    scene: Scene,
    cameras: Sequence[Camera],
    rig_from_cam: Sequence[NDArray[np.float64]],
    world_from_rig: NDArray[np.float64],
    *,
    fps: float = 24.0,
    noise: float = 0.0,
    seed: int = 0,
) -> list[SyntheticClip]:
    """One clip per camera of a rig that moves as `world_from_rig` (N, 4, 4); `rig_from_cam` are (4, 4)."""
    return [
        render_clip(scene, camera, world_from_rig @ mount, fps=fps, noise=noise, seed=seed + k)
        for k, (camera, mount) in enumerate(zip(cameras, rig_from_cam, strict=True))
    ]


def sample_camera(model: CameraModel, width: int, height: int) -> Camera:
    """A typical camera of each model: pinhole with 62 degrees, mei with about 115 degrees, the full panorama, an action
    camera's barrel distortion (opencv, 86 degrees) and a fisheye of 149 degrees."""
    if model == "pinhole":
        return Camera.pinhole_from_fov(62.0, width, height)
    if model == "mei":
        focal_px = 0.70 * width
        return Camera("mei", (focal_px, focal_px, width / 2, height / 2, 0.66), width, height)
    if model == "opencv":
        lens = (
            0.66 * width,
            0.66 * width,
            0.51 * width,
            0.49 * height,
            -0.28,
            0.09,
            4e-4,
            -3e-4,
            -0.014,
            0.0,
            0.0,
            0.0,
        )
        return Camera("opencv", lens, width, height)
    if model == "opencv_fisheye":
        focal_px = 0.38 * width
        fisheye = (focal_px, focal_px, 0.49 * width, 0.51 * height, 0.02, -0.008, 0.001, -1e-4)
        return Camera("opencv_fisheye", fisheye, width, height)
    return Camera("equirect", (), width, height)


def tiny_clip(
    kind: ClipKind,
    num_frames: int = 24,
    width: int = 320,
    height: int = 240,
    *,
    model: CameraModel = "pinhole",
    noise: float = 0.0,
    seed: int = 0,
) -> SyntheticClip:
    """A small clip of the room for tests.

    Args:
        kind: `static` does not move (and nothing in view does), `pure_rotation` turns on the spot, `forward` and
            `sideways` move 0.9 m, `orbit` turns 40 degrees around the table, `dynamic` is an orbit with moving things.
        noise: Sensor noise in 8-bit steps; `static` repeats one picture exactly without it.

    Raises:
        ConfigError: Unknown kind.
    """
    if kind not in CLIP_KINDS:
        raise ConfigError(f"unknown clip kind {kind!r}; known: {', '.join(CLIP_KINDS)}")
    n = num_frames
    table = np.array([3.0, 2.5, 0.7])
    scene = room_scene()
    if kind == "static":
        poses = look_at(through([(4.6, 0.9, 1.5)], n), table)
    elif kind == "pure_rotation":
        poses = look_at(through([(4.6, 0.9, 1.5)], n), through([(2.4, 3.6, 0.9), (3.0, 4.2, 1.1), (4.4, 3.9, 1.2)], n))
    elif kind == "forward":
        eye = through([(4.4, 1.0, 1.35), (3.75, 1.62, 1.3)], n)
        poses = look_at(eye, eye + np.array([-1.0, 0.95, -0.25]))
    elif kind == "sideways":
        eye = through([(2.5, 0.9, 1.3), (3.4, 0.9, 1.3)], n)
        poses = look_at(eye, eye + np.array([0.0, 1.0, -0.2]))
    else:
        if kind == "dynamic":
            scene = moving_ball_scene()
        poses = look_at(arc((3.0, 2.5, 1.45), 1.9, -75.0, -35.0, n), table)
    if kind in ("orbit", "dynamic"):
        poses = handheld(poses, shift_m=0.004, angle_deg=0.2, seed=seed)
    return render_clip(scene, sample_camera(model, width, height), poses, noise=noise, seed=seed)
