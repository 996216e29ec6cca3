"""Metric depth of keyframes as a prior of their inverse depths: the depth term of the paper's energy (section 3.2.3).

A map has a scale of its own, which the prior takes over wherever it is: the term tells the shape of what no parallax
shows, and holds the scale of one end of the video to that of the other. Metres are set when the map is finished.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from vipe_core.cameras.along import inverse_along
from vipe_core.priors.protocols import MetricDepth, Refiner
from vipe_core.slam.keyframes import KeyframeMap

# Cells that the scale is read from are thinned to about so many.
_SCALE_CELLS = 1 << 16


class DepthPrior:
    """What a network says of the inverse depths of a map's keyframes; each picture is shown to it once.

    Args:
        refiner: Knows the pictures of the map's features.
    """

    def __init__(self, metric: MetricDepth, refiner: Refiner, keyframes: KeyframeMap) -> None:
        self._metric = metric
        self._refiner = refiner
        self._keyframes = keyframes
        self._said: dict[int, NDArray[np.float32]] = {}

    def refresh(self) -> None:
        """Ask anew from now on: the camera is known better than when the pictures were shown."""
        self._said.clear()

    def inverse_depths(self, frames: Sequence[int]) -> NDArray[np.float32]:
        """(F, P) of keyframes along the rays of the camera, in units of the map; 0 where nothing is said."""
        said = np.stack([self._of(k) for k in frames])
        return (said * np.float32(self._units())).astype(np.float32)

    def expected(self, frames: Sequence[int]) -> NDArray[np.float32]:
        """(F, P) inverse depths of keyframes that nothing has measured: what is said, and its median where nothing is.

        In units of those that were asked for before; in metres where there are none.
        """
        units = np.float32(self._units())
        said = np.stack([self._of(k) for k in frames]) * units
        known = said > 0
        median = np.median(said[known]) if known.any() else np.float32(1)
        return np.where(known, said, median).astype(np.float32)

    def _units(self) -> float:
        """By what inverse metres become inverse units of the map: by the median keyframe cell that has both."""
        keyframes = self._keyframes
        numbers = [k for k in range(len(keyframes)) if keyframes.frame_index[k] in self._said]
        if not numbers:
            return 1.0
        step = max(1, len(numbers) * keyframes.grid.num_cells // _SCALE_CELLS)
        map_depths = np.concatenate([keyframes.depth(k)[::step] for k in numbers])
        said = np.concatenate([self._said[keyframes.frame_index[k]][::step] for k in numbers])
        known = said > 0
        return float(np.median(map_depths[known] / said[known])) if known.any() else 1.0

    def _of(self, k: int) -> NDArray[np.float32]:
        """(P,) inverse metres along the rays of keyframe `k`."""
        keyframes = self._keyframes
        index = keyframes.frame_index[k]
        if index not in self._said:
            rgb = self._refiner.picture(keyframes.features[k])
            height, width = rgb.shape[:2]
            size = self._metric.input_size(width, height)
            shown = rgb if size == (width, height) else cv2.resize(rgb, size, interpolation=cv2.INTER_LINEAR)
            estimate = self._metric.estimate(np.asarray(shown, np.uint8), keyframes.camera.resized(*size))
            self._said[index] = self._on_cells(estimate.depth_m)
        return self._said[index]

    def _on_cells(self, depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
        grid, camera = self._keyframes.grid, self._keyframes.camera
        rows = ((np.arange(grid.height) + 0.5) * depth_m.shape[0] / grid.height).astype(np.int64)
        columns = ((np.arange(grid.width) + 0.5) * depth_m.shape[1] / grid.width).astype(np.int64)
        # Not between pixels: between a thing and what is behind it, there is nothing.
        sampled = depth_m[np.ix_(rows, columns)].astype(np.float64)
        along = inverse_along(camera.resized(grid.width, grid.height), self._metric.depth_kind)
        known = np.isfinite(sampled) & (sampled > 0) & (along > 0)
        inverse = np.where(known, 1 / (np.where(known, sampled, 1.0) * np.where(known, along, 1.0)), 0.0)
        return inverse.reshape(-1).astype(np.float32)
