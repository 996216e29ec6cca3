"""Where the current poses and depths put the cells of one keyframe in another: guesses, distances, depth transfer."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from vipe_core.ba.problem import Grid
from vipe_core.cameras import CameraModel
from vipe_core.cameras.projection import project, unproject
from vipe_core.geometry.arrays import relative
from vipe_core.slam.keyframes import KeyframeMap

Array = NDArray[Any]

MIN_DEPTH_RATIO = 0.1
"""A point nearer to the target camera than this share of its depth in the source has no usable image there."""


@dataclass(frozen=True, slots=True)
class Induced:
    """Cells of one or more sources seen in their targets.

    Attributes:
        target_px: (..., P, 2) float32 index coordinates; NaN behind the camera.
        inverse_depth: (..., P) float32 inverse depth of the same points along the target's rays; 0 behind the camera.
        displacement_px: (..., P) float32 distance from the source cell; NaN behind the camera.
        visible: (..., P) bool, in front of the camera and inside the image.
    """

    target_px: NDArray[np.float32]
    inverse_depth: NDArray[np.float32]
    displacement_px: NDArray[np.float32]
    visible: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Fan:
    """Per pair of keyframes: (E,) mean displacement of visible cells in pixels, and the share of visible cells."""

    motion_px: NDArray[np.float64]
    overlap: NDArray[np.float64]


class Reprojector:
    """Reprojection of grid cells with one camera model."""

    def __init__(self, model: CameraModel, grid: Grid) -> None:
        self.model: CameraModel = model
        self.grid = grid
        self._px = grid.sample_px()
        self._size = torch.tensor([grid.width * grid.stride - 1, grid.height * grid.stride - 1], dtype=torch.float64)

    def rays(self, intrinsics: Array, px: Array | None = None) -> NDArray[np.float64]:
        """(P, 3) rays of the cells, or of index coordinates `px` (P, 2)."""
        params = torch.from_numpy(np.asarray(intrinsics, dtype=np.float64))
        at = self._px if px is None else torch.from_numpy(np.asarray(px, dtype=np.float64))
        return np.asarray(unproject(self.model, params, at).numpy())

    def induced(
        self,
        intrinsics: Array,
        target_from_source: Array,
        inverse_depth: Array,
        cells: Array | None = None,
        into: Array | None = None,
    ) -> Induced:
        """Cells with inverse depths seen through relative poses.

        Args:
            intrinsics: (K,) index parameters.
            target_from_source: (..., 4, 4).
            inverse_depth: (..., P) of the source cells.
            cells: Numbers of the cells that `inverse_depth` belongs to; all of the grid if None.
            into: (K,) index parameters of the target camera, where that is another one.
        """
        params = torch.from_numpy(np.asarray(intrinsics, dtype=np.float64))
        pose = torch.from_numpy(np.asarray(target_from_source, dtype=np.float64))
        depth = torch.from_numpy(np.asarray(inverse_depth, dtype=np.float64))
        px = self._px if cells is None else self._px[torch.from_numpy(np.asarray(cells, dtype=np.int64))]
        rays = unproject(self.model, params, px)
        points = rays @ pose[..., :3, :3].mT + pose[..., None, :3, 3] * depth[..., None]
        target_params = params if into is None else torch.from_numpy(np.asarray(into, dtype=np.float64))
        target_px, valid = project(self.model, target_params, points)
        # The homogeneous scale starts at |ray|; what is left of it is the ratio of the depths.
        length = points[..., 2] if self.model == "pinhole" else points.norm(dim=-1)
        valid = valid & (length > MIN_DEPTH_RATIO)
        inside = ((target_px >= 0) & (target_px <= self._size)).all(-1)
        nan = torch.full_like(target_px, torch.nan)
        target_px = torch.where(valid[..., None], target_px, nan)
        displacement = (target_px - px).norm(dim=-1)
        seen = torch.where(valid, depth / torch.where(valid, length, torch.ones_like(length)), torch.zeros_like(length))
        return Induced(
            target_px.numpy().astype(np.float32),
            seen.numpy().astype(np.float32),
            displacement.numpy().astype(np.float32),
            (valid & inside).numpy(),
        )

    def parallax_deg(self, intrinsics: Array, target_from_source: Array, inverse_depth: Array) -> NDArray[np.float64]:
        """(P,) angle at each point between its rays to the two camera centres, degrees."""
        params = torch.from_numpy(np.asarray(intrinsics, dtype=np.float64))
        pose = np.asarray(target_from_source, dtype=np.float64)
        rays = unproject(self.model, params, self._px).numpy()
        # Both directions in the source frame, scaled by the inverse depth so that infinity stays finite.
        centre = -pose[:3, :3].T @ pose[:3, 3]
        other = rays - np.asarray(inverse_depth, dtype=np.float64)[:, None] * centre
        across = np.linalg.norm(np.cross(rays, other), axis=1)
        return np.asarray(np.degrees(np.arctan2(across, (rays * other).sum(axis=1))))

    def edge(self, keyframes: KeyframeMap, i: int, j: int) -> Induced:
        """The cells of keyframe `i` in keyframe `j`."""
        target_from_source = relative(keyframes.pose(j), keyframes.pose(i))
        into = keyframes.intrinsics_at(j)
        return self.induced(keyframes.intrinsics_at(i), target_from_source, keyframes.depth(i), into=into)

    def fan(self, keyframes: KeyframeMap, sources: Sequence[int], targets: Sequence[int], subsample: int) -> Fan:
        """Displacement and overlap of many pairs, on every `subsample`-th row and column of the grid."""
        rows = np.arange(subsample // 2, self.grid.height, subsample)
        columns = np.arange(subsample // 2, self.grid.width, subsample)
        cells = (rows[:, None] * self.grid.width + columns).reshape(-1)
        target_from_source = relative(
            np.stack([keyframes.pose(j) for j in targets]), np.stack([keyframes.pose(i) for i in sources])
        )
        depth = np.stack([keyframes.depth(i)[cells] for i in sources])
        count, total = np.empty(len(depth)), np.empty(len(depth))
        for rows_of, seen_from, seen_in in _by_cameras(keyframes, sources, targets):
            induced = self.induced(seen_from, target_from_source[rows_of], depth[rows_of], cells, seen_in)
            count[rows_of] = induced.visible.sum(axis=-1)
            total[rows_of] = np.where(induced.visible, induced.displacement_px, 0).sum(axis=-1, dtype=np.float64)
        motion = np.where(count > 0, total / np.maximum(count, 1), np.inf)
        return Fan(motion, count / len(cells))


def _by_cameras(
    keyframes: KeyframeMap, sources: Sequence[int], targets: Sequence[int]
) -> Iterator[tuple[Array, Array, Array]]:
    """Rows of pairs whose sources have one camera and whose targets have one, with the intrinsics of both."""
    if keyframes.intrinsics.ndim == 1:
        yield np.arange(len(sources)), keyframes.intrinsics, keyframes.intrinsics
        return
    views = keyframes.num_views
    pair = np.array(sources) % views * views + np.array(targets) % views
    for both in np.unique(pair).tolist():
        rows = np.flatnonzero(pair == both)
        yield rows, keyframes.intrinsics_of(both // views), keyframes.intrinsics_of(both % views)


def splat_inverse_depth(reprojector: Reprojector, keyframes: KeyframeMap, i: int, j: int) -> NDArray[np.float32]:
    """(P,) inverse depth of keyframe `j` as keyframe `i` predicts it.

    Each cell takes the nearest point that lands in it; cells without one take the mean of their neighbours, spreading
    inwards from what is known, and the median of the source where nothing lands at all.
    """
    grid = keyframes.grid
    induced = reprojector.edge(keyframes, i, j)
    fallback = np.float32(np.median(keyframes.depth(i)))
    if not induced.visible.any():
        return np.full(grid.num_cells, fallback, dtype=np.float32)
    cell = np.rint((induced.target_px[induced.visible] - grid.offset) / grid.stride).astype(np.int64)
    cell = np.clip(cell, 0, (grid.width - 1, grid.height - 1))
    image = np.zeros((grid.height, grid.width), dtype=np.float32)
    np.maximum.at(image, (cell[:, 1], cell[:, 0]), induced.inverse_depth[induced.visible])
    known = (image > 0).astype(np.float32)
    filled = np.full_like(image, fallback)
    for sigma in (8.0, 2.0):
        mass = cv2.GaussianBlur(known, (0, 0), sigma)
        total = cv2.GaussianBlur(image, (0, 0), sigma)
        filled = np.where(mass > 0.02, total / np.maximum(mass, 1e-6), filled)
    return np.where(known > 0, image, filled).astype(np.float32).reshape(-1)
