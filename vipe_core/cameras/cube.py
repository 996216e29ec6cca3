"""A panorama as six pinhole cameras that look at the faces of a cube (paper section 3.2.6).

The faces share the panorama's centre and overlap: each sees a border beyond its edges, so that what leaves one face is
matched there until the next one has it. The front face looks where the middle of the panorama does.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vipe_core.cameras.camera import Camera

Array = NDArray[Any]

FACES = ("front", "right", "back", "left", "up", "down")

# Columns: where the right, the lower side and the axis of each face point to in the panorama.
_AXES = {
    "front": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "right": ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
    "back": ((-1, 0, 0), (0, 1, 0), (0, 0, -1)),
    "left": ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),
    "up": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "down": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
}
# Border on each side as a share of a face's width: fields of view of 97.6 degrees, two cells of the coarsest face.
_BORDER = 1 / 16
_MULTIPLE = 16


@dataclass(frozen=True)
class CubeFaces:
    """The six cameras.

    Attributes:
        camera: Of every face: a centred pinhole with square pixels.
        panorama_from_face: (6, 4, 4) float64 rotations in the order of `FACES`.
    """

    camera: Camera
    panorama_from_face: NDArray[np.float64]

    @classmethod
    def of_size(cls, size: int) -> CubeFaces:
        """Faces of `size` x `size` pixels."""
        focal_px = (0.5 - _BORDER) * size
        transforms = np.tile(np.eye(4), (len(FACES), 1, 1))
        for transform, name in zip(transforms, FACES, strict=True):
            transform[:3, :3] = np.array(_AXES[name], dtype=np.float64).T
        return cls(Camera("pinhole", (focal_px, focal_px, size / 2, size / 2), size, size), transforms)

    @classmethod
    def for_panorama(cls, width: int, area_px: int) -> CubeFaces:
        """Faces as wide as a quarter of the panorama, in whole multiples of 16 pixels, six of at most `area_px`."""
        side = min(width / 4, (area_px / len(FACES)) ** 0.5)
        return cls.of_size(_MULTIPLE * max(4, round(side / _MULTIPLE)))

    @property
    def size(self) -> int:
        return self.camera.width

    def panorama_px(self, panorama: Camera) -> NDArray[np.float64]:
        """(6, size, size, 2) index coordinates in the panorama of the pixels of the faces."""
        rays = np.einsum("fij,yxj->fyxi", self.panorama_from_face[:, :3, :3], self.camera.rays())
        px, _ = panorama.project(rays)
        return px

    def seen(self, rays: Array) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Where the faces see directions of the panorama.

        Args:
            rays: (..., 3) of any length, in the panorama's frame.

        Returns:
            px (6, ..., 2) index coordinates; weight (6, ...) of each face, which falls from 1 to 0 over the overlap,
            is 0 where a face does not see the direction, and sums to 1; and cosine (6, ...) between the direction and
            the face's axis: inverse depth over inverse distance is its inverse.
        """
        rays = np.asarray(rays, dtype=np.float64)
        local = np.einsum("fji,...j->f...i", self.panorama_from_face[:, :3, :3], rays)
        cosine = local[..., 2] / np.linalg.norm(rays, axis=-1)
        px, imaged = self.camera.project(local)
        away = np.abs(local[..., :2]).max(axis=-1) / np.where(imaged, local[..., 2], 1.0)
        # The last sample of a face lies half a pixel inside of its border.
        outermost = (self.size / 2 - 0.5) / self.camera.focal_px
        weight = np.where(imaged, np.clip((outermost - away) / (outermost - 1 / outermost), 0, 1), 0)
        return px, weight / weight.sum(axis=0), cosine
