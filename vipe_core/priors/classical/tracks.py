"""Sparse corner tracks: Shi-Tomasi corners, pyramidal Lucas-Kanade both ways, splatted to the grid.

Lucas-Kanade has no smoothness term, so it corrects the small bias that a variational flow has.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from vipe_core.priors.classical.features import (
    STRIDE,
    Array,
    FlowFeatures,
    cell_centres_px,
    larger,
    length_px,
    sample_px,
)
from vipe_core.priors.classical.lucas_kanade import lucas_kanade
from vipe_core.priors.protocols import Match

_LEVELS = 1


class LkTracker:
    """`SparseTracker` on the features of `DisFlowMatcher`.

    Args:
        window_px: Side of the Lucas-Kanade window.
        max_fb_px: Tracks that do not come back within this distance are dropped.
        max_correction_px: Tracks that leave the dense flow by more than this are dropped: there the dense flow (and so
            its gradient between corner and cell centre) is wrong, or the track jumped.
        weight: Inverse variance of a perfect track, 1/px^2, relative to 1 for a perfect dense measurement.
    """

    def __init__(
        self,
        window_px: int = 11,
        max_fb_px: float = 0.5,
        max_correction_px: float = 2.0,
        weight: float = 4.0,
    ) -> None:
        self._window = (window_px, window_px)
        self._max_fb_px = max_fb_px
        self._max_correction_px = max_correction_px
        self._weight = weight

    def match(self, source: FlowFeatures, target: FlowFeatures, dense: Match) -> Match:
        """Measurements at the cells that hold a track; see `SparseTracker.match`.

        A corner is not at the centre of its cell, and the flow has a gradient. The measurement at a cell is therefore
        the dense flow there plus what the tracks found beyond the dense flow at the corners themselves.
        """
        num_cells = source.grid.num_cells
        centres = cell_centres_px(source.grid)
        displacement = dense.target_px - centres
        corners, flow, smooth = self._corners_with_flow(source, displacement, larger(dense.weight) > 0)
        if not len(corners):
            return Match(dense.target_px.copy(), np.zeros((num_cells, 2), np.float32), 0.0)
        forward, kept_forward = lucas_kanade(source.gray, target.gray, corners, corners + flow, self._window, _LEVELS)
        back, kept_back = lucas_kanade(target.gray, source.gray, forward, corners, self._window, _LEVELS)
        error = length_px(back - corners)
        correction = forward - corners - flow
        height, width = target.gray.shape
        kept = kept_forward & kept_back & (error < self._max_fb_px)
        kept &= (larger(np.abs(correction)) < self._max_correction_px) & smooth
        kept &= ((forward >= 0) & (forward <= (width - 1, height - 1))).all(axis=1)
        if target.usable is not None:
            kept &= sample_px(target.usable.astype(np.float32), forward) > 0.5
        consistent = float(kept.mean())

        quality = np.where(kept, np.exp(-np.square(error / self._max_fb_px)), 0.0)
        cell = np.rint((corners - source.grid.offset) / STRIDE).astype(np.int64)
        cell = np.clip(cell, 0, (source.grid.width - 1, source.grid.height - 1))
        index = cell[:, 1] * source.grid.width + cell[:, 0]
        total = np.bincount(index, quality, num_cells)
        share = quality / np.maximum(total[index], 1e-9)
        offset = np.stack([np.bincount(index, share * correction[:, k], num_cells) for k in (0, 1)], axis=-1)
        weight = np.bincount(index, share * quality, num_cells) * self._weight
        usable = (total > 1e-6) & source.usable_cells
        target_px = dense.target_px + np.where(usable[:, None], offset, 0)
        weights = np.repeat(np.where(usable, weight, 0)[:, None], 2, axis=1)
        return Match(target_px.astype(np.float32), weights.astype(np.float32), consistent)

    def _corners_with_flow(
        self, source: FlowFeatures, displacement: Array, known: Array
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
        """Corners (n, 2), the dense displacement there, and whether the flow around them is smooth enough to use."""
        grid = source.grid
        corners = source.corners_px
        if not len(corners):
            return corners, np.zeros((0, 2), np.float32), np.zeros(0, bool)
        field = np.ascontiguousarray(displacement, np.float32).reshape(grid.height, grid.width, 2)
        at_cells = (corners - grid.offset) / grid.stride
        flow = sample_px(field, at_cells)
        # Between cells that move differently (an edge of an object) the interpolated flow belongs to neither side.
        kernel = np.ones((3, 3), np.uint8)
        spread = np.stack([cv2.dilate(field[..., k], kernel) - cv2.erode(field[..., k], kernel) for k in (0, 1)], -1)
        limit = 1.5 + 0.1 * length_px(field)
        calm = (larger(spread) < limit) & known.reshape(grid.height, grid.width)
        return corners, flow, sample_px(calm.astype(np.float32), at_cells) > 0.5
