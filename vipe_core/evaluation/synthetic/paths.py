"""Camera paths: smooth curves through given points, poses that look at something, and the shake of a hand."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from vipe_core.evaluation.synthetic.scene import Vec3


def look_at(eye: NDArray[np.float64], target: NDArray[np.float64]) -> NDArray[np.float64]:
    """world_from_cam (..., 4, 4) of upright cameras at `eye` (..., 3) that look at `target` (..., 3), z up."""
    eye, target = np.broadcast_arrays(np.asarray(eye, np.float64), np.asarray(target, np.float64))
    forward = target - eye
    forward /= np.linalg.norm(forward, axis=-1, keepdims=True)
    right = np.cross(forward, np.array([0.0, 0.0, 1.0]))
    right /= np.linalg.norm(right, axis=-1, keepdims=True)
    pose = np.zeros((*eye.shape[:-1], 4, 4))
    pose[..., :3, 0] = right
    pose[..., :3, 1] = np.cross(forward, right)
    pose[..., :3, 2] = forward
    pose[..., :3, 3] = eye
    pose[..., 3, 3] = 1.0
    return pose


def through(points: Sequence[Vec3], num: int) -> NDArray[np.float64]:
    """(num, 3) points of a smooth curve through `points`, at even parameters."""
    if len(points) == 1:
        return np.repeat(np.array(points, dtype=np.float64), num, axis=0)
    knots = np.linspace(0.0, 1.0, len(points))
    curve: NDArray[np.float64] = CubicSpline(knots, np.array(points, dtype=np.float64))(np.linspace(0.0, 1.0, num))
    return curve


def arc(centre: Vec3, radius: float, start_deg: float, stop_deg: float, num: int) -> NDArray[np.float64]:
    """(num, 3) points of a horizontal arc."""
    angle = np.radians(np.linspace(start_deg, stop_deg, num))
    return np.array(centre) + radius * np.stack([np.cos(angle), np.sin(angle), np.zeros(num)], axis=-1)


def handheld(
    world_from_cam: NDArray[np.float64],
    *,
    shift_m: float = 0.01,
    angle_deg: float = 0.5,
    fps: float = 24.0,
    seed: int = 0,
) -> NDArray[np.float64]:
    """The poses with the shake of a hand: a sum of slow waves (0.3 to 3 Hz) in all six directions.

    Args:
        shift_m: RMS of the shift per axis, metres.
        angle_deg: RMS of the rotation per axis, degrees.
    """
    rng = np.random.default_rng(seed)
    time = np.arange(len(world_from_cam)) / fps
    frequency = np.geomspace(0.3, 3.0, 6)
    amplitude = frequency**-0.7
    amplitude *= math.sqrt(2.0) / np.linalg.norm(amplitude)
    phase = rng.uniform(0, 2 * math.pi, (6, len(frequency)))
    waves = (amplitude * np.sin(2 * math.pi * frequency * time[:, None, None] + phase)).sum(axis=-1)
    shaken = np.array(world_from_cam, dtype=np.float64)
    shaken[:, :3, 3] += shift_m * waves[:, :3]
    turns = Rotation.from_rotvec(math.radians(angle_deg) * waves[:, 3:]).as_matrix()
    shaken[:, :3, :3] = shaken[:, :3, :3] @ turns
    return shaken
