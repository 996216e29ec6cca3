"""Which solids may stand between the lamp and a point: lists per direction from the lamp, made once per scene."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vipe_core.evaluation.synthetic.cast import tile_candidates
from vipe_core.evaluation.synthetic.scene import PackedScene, Scene

_CELLS = 12  # per edge of a cube around the lamp


@dataclass(frozen=True, slots=True)
class ShadowCells:
    """Possible occluders by direction.

    Attributes:
        per_edge: Cells along each edge of the cube around the lamp; 0 for the sun, which has one list for all.
        candidates: (6 * per_edge**2 or 1, P) int64 primitives.
        counts: (6 * per_edge**2 or 1,) int64 how many of each row count.
    """

    per_edge: int
    candidates: NDArray[np.int64]
    counts: NDArray[np.int64]

    @classmethod
    def of(cls, scene: Scene, packed: PackedScene) -> ShadowCells:
        """Static solids only: what moves casts no shadow, and a room is seen from inside."""
        solid = np.flatnonzero((packed.kind != 2) & ~packed.dynamic)
        if scene.light.is_sun:
            return cls(0, solid[None].copy(), np.array([len(solid)], dtype=np.int64))
        axis, half_angle = _cube_cells(_CELLS)
        local = np.zeros((len(axis), max(1, len(solid))), np.int64)
        counts = np.zeros(len(axis), np.int64)
        offset = packed.centre[solid] - np.array(scene.light.position)
        tile_candidates(axis, half_angle, packed.kind[solid], offset, packed.bound[solid], local, counts)
        # Unused slots hold nothing that is read.
        candidates = solid[np.clip(local, 0, max(0, len(solid) - 1))] if len(solid) else local
        return cls(_CELLS, np.ascontiguousarray(candidates), counts)


def _cube_cells(per_edge: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Axis (C, 3) and half angle (C,) of the cones around the cells of a cube; the order of `cast._lamp_cell`."""
    edges = np.linspace(-1.0, 1.0, per_edge + 1)
    low_b, low_a = np.meshgrid(edges[:-1], edges[:-1], indexing="ij")
    step = edges[1] - edges[0]
    axes, angles = [], []
    for face in range(6):
        main, first, second = face // 2, (face // 2 + 1) % 3, (face // 2 + 2) % 3
        corners = np.zeros((4, per_edge * per_edge, 3))
        for k, (da, db) in enumerate(((0.0, 0.0), (step, 0.0), (0.0, step), (step, step))):
            corners[k, :, main] = 1.0 if face % 2 else -1.0
            corners[k, :, first] = (low_a + da).ravel()
            corners[k, :, second] = (low_b + db).ravel()
        corners /= np.linalg.norm(corners, axis=-1, keepdims=True)
        axis = corners.sum(axis=0)
        axis /= np.linalg.norm(axis, axis=-1, keepdims=True)
        cosine = np.clip(np.einsum("kcx,cx->kc", corners, axis), -1.0, 1.0)
        axes.append(axis)
        angles.append(np.arccos(cosine).max(axis=0) + 1e-6)
    return np.concatenate(axes), np.concatenate(angles)
