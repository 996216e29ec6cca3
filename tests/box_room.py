"""A textured box room with a smaller box in it, ray cast exactly: images, depth and flow for tests that need truth."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

_ROOM = np.array([4.0, 2.5, 5.0])
_BOX_CENTRE, _BOX = np.array([0.6, 0.9, 1.8]), np.array([0.7, 1.0, 0.6])
_TEXTURE_PX, _TEXELS_PER_UNIT = 2048, 150.0


def _textures() -> list[Array]:
    rng = np.random.default_rng(7)
    out = []
    for _ in range(12):
        total = np.zeros((_TEXTURE_PX, _TEXTURE_PX), np.float32)
        for cells, gain in ((16, 1.0), (64, 1.0), (200, 1.2), (500, 0.8)):
            noise = rng.normal(size=(cells, cells)).astype(np.float32)
            total += gain * cv2.resize(noise, (_TEXTURE_PX, _TEXTURE_PX), interpolation=cv2.INTER_CUBIC)
        out.append(np.clip(128 + 32 * total, 0, 255).astype(np.float32))
    return out


class BoxRoom:
    """Renders pinhole views; the world has OpenCV axes and the camera starts near (0, 0, -3), looking along +z."""

    def __init__(self, width: int = 320, height: int = 240, fov_x_deg: float = 60.0, contrast: float = 1.0) -> None:
        self.width, self.height = width, height
        self.focal = width / 2 / np.tan(np.radians(fov_x_deg) / 2)
        self._textures = [128 + contrast * (t - 128) for t in _textures()]

    def rays(self, scale: int = 1) -> Array:
        v, u = np.mgrid[: self.height * scale, : self.width * scale] + 0.5
        x = (u / scale - self.width / 2) / self.focal
        y = (v / scale - self.height / 2) / self.focal
        return np.stack([x, y, np.ones_like(x)], -1)

    def _cast(self, world_from_cam: Array, scale: int) -> tuple[Array, Array]:
        d = self.rays(scale) @ world_from_cam[:3, :3].T
        o = world_from_cam[:3, 3]
        d = np.where(np.abs(d) < 1e-9, 1e-9, d)
        wall_t = (np.sign(d) * _ROOM - o) / d
        axis = wall_t.argmin(-1)
        t = np.take_along_axis(wall_t, axis[..., None], -1)[..., 0]
        face = 2 * axis + (np.take_along_axis(d, axis[..., None], -1)[..., 0] > 0)
        a, b = (_BOX_CENTRE - _BOX - o) / d, (_BOX_CENTRE + _BOX - o) / d
        near, far = np.minimum(a, b), np.maximum(a, b)
        enter = near.max(-1)
        hit = (enter < far.min(-1)) & (enter > 0)
        axis = np.where(hit, near.argmax(-1), axis)
        t = np.where(hit, enter, t)
        face = np.where(hit, 6 + 2 * axis + (np.take_along_axis(d, axis[..., None], -1)[..., 0] > 0), face)
        point = o + t[..., None] * d
        image = np.zeros(t.shape, np.float32)
        for f, texture in enumerate(self._textures):
            keep = [k for k in range(3) if k != (f % 6) // 2]
            uv = (point[..., keep] * _TEXELS_PER_UNIT + _TEXTURE_PX / 2 + 100).astype(np.float32)
            colour = cv2.remap(texture, uv[..., 0], uv[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
            image = np.where(face == f, colour, image)
        return image, t

    def render(self, world_from_cam: Array) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
        """(h, w, 3) uint8 anti-aliased picture and (h, w) z depth at the pixel centres."""
        fine, _ = self._cast(world_from_cam, 2)
        image = cv2.resize(fine, (self.width, self.height), interpolation=cv2.INTER_AREA)
        _, depth = self._cast(world_from_cam, 1)
        return np.repeat(np.rint(image).astype(np.uint8)[..., None], 3, -1), depth

    def flow_px(self, source: Array, target: Array, points_px: Array) -> tuple[Array, Array]:
        """Where index coordinates (n, 2) of `source` are seen in `target`, and whether they are visible there."""
        ray = np.concatenate(
            [(points_px + 0.5 - [self.width / 2, self.height / 2]) / self.focal, np.ones((len(points_px), 1))], 1
        )
        depth = self._depth_at(source, ray)
        local = (ray * depth[:, None]) @ (np.linalg.inv(target)[:3, :3] @ source[:3, :3]).T
        local += (np.linalg.inv(target) @ source)[:3, 3]
        seen = local[:, :2] / local[:, 2:] * self.focal + [self.width / 2, self.height / 2] - 0.5
        inside = ((seen >= 0) & (seen <= [self.width - 1, self.height - 1])).all(1) & (local[:, 2] > 0)
        visible = self._depth_at(target, local / local[:, 2:])
        return seen, inside & (np.abs(visible / local[:, 2] - 1) < 0.01)

    def _depth_at(self, world_from_cam: Array, ray: Array) -> Array:
        d = ray @ world_from_cam[:3, :3].T
        o = world_from_cam[:3, 3]
        d = np.where(np.abs(d) < 1e-9, 1e-9, d)
        t = ((np.sign(d) * _ROOM - o) / d).min(-1)
        a, b = (_BOX_CENTRE - _BOX - o) / d, (_BOX_CENTRE + _BOX - o) / d
        enter = np.minimum(a, b).max(-1)
        return np.where((enter < np.maximum(a, b).min(-1)) & (enter > 0), enter, t)


def look(position: tuple[float, float, float], yaw_deg: float = 0.0, pitch_deg: float = 0.0) -> Array:
    """(4, 4) world_from_cam at `position`, turned about the vertical axis and then tilted."""
    y, p = np.radians([yaw_deg, pitch_deg])
    turn = np.array([[np.cos(y), 0, np.sin(y)], [0, 1, 0], [-np.sin(y), 0, np.cos(y)]])
    tilt = np.array([[1, 0, 0], [0, np.cos(p), -np.sin(p)], [0, np.sin(p), np.cos(p)]])
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = turn @ tilt, position
    return out
