"""Stand-ins for depth networks: the true depth of a clip with stated errors, behind the engine's protocols.

They measure what the alignment makes of a model whose errors are known; they never depend on what is in a picture.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vipe_core.annotation import DepthKind
from vipe_core.cameras import Camera
from vipe_core.priors.protocols import MetricEstimate
from vipe_core.video.source import FrameSource

Array = NDArray[Any]


@dataclass(frozen=True, slots=True)
class Distortion:
    """Errors of a video depth model, in inverse depth relative to its median.

    Attributes:
        window_scale: Standard deviation of the logarithm of each window's scale.
        window_shift: Standard deviation of each window's shift.
        drift: Standard deviation of the change of scale and of shift from a frame to the next.
        smooth: Standard deviation of relative errors that neighbouring pixels and frames share.
        noise: Standard deviation of relative errors of single pixels.
        outliers: Share of the pixels that are off by up to a factor of 3.
        wrong: Share of the picture, at its left, that is too near by half.
        holes: Share of the picture in which the model says nothing.
    """

    window_scale: float = 0.5
    window_shift: float = 0.3
    drift: float = 0.01
    smooth: float = 0.03
    noise: float = 0.02
    outliers: float = 0.02
    wrong: float = 0.0
    holes: float = 0.0


class _Known:
    """The truth of the frames of a source at one size, found again by the pictures' bytes."""

    def __init__(self, source: FrameSource, depth: NDArray[np.floating[Any]], size: tuple[int, int]) -> None:
        self.size = size
        self._depth = depth
        self._index: dict[int, int] = {}
        with closing(source.frames(size=size)) as frames:
            for frame in frames:
                self._index[zlib.crc32(frame.rgb.tobytes())] = frame.index

    def index(self, rgb: NDArray[np.uint8]) -> int:
        return self._index[zlib.crc32(rgb.tobytes())]

    def depth(self, index: int) -> NDArray[np.float64]:
        """(h, w) true depth; 0 is sky."""
        exact = np.asarray(self._depth[index], np.float32)
        return np.asarray(cv2.resize(exact, self.size, interpolation=cv2.INTER_NEAREST), np.float64)


class DistortedVideoDepth:
    """Video depth with known errors.

    Args:
        source: The video, in which frames are looked up by their bytes: no two may be the same.
        depth: (N, h, w) true depth of its frames, 0 is sky.
        depth_kind: Of that depth.
        size: (width, height) of the model's pictures.
    """

    def __init__(
        self,
        source: FrameSource,
        depth: NDArray[np.floating[Any]],
        depth_kind: DepthKind,
        size: tuple[int, int],
        distortion: Distortion,
        *,
        window_frames: int = 32,
        overlap_frames: int = 8,
        seed: int = 0,
    ) -> None:
        self._known = _Known(source, depth, size)
        self._depth_kind: DepthKind = depth_kind
        self._window, self._overlap = window_frames, overlap_frames
        self._distortion, self._seed = distortion, seed
        seen = depth[depth > 0]
        self._median = float(np.median(1 / seen[:: max(1, len(seen) // 100_000)].astype(np.float64)))
        walk = np.random.default_rng(seed).standard_normal((2, len(depth))).cumsum(axis=1) * distortion.drift
        self._scale, self._shift = np.exp(walk[0]), walk[1] * self._median

    @property
    def depth_kind(self) -> DepthKind:
        return self._depth_kind

    @property
    def window_frames(self) -> int:
        return self._window

    @property
    def overlap_frames(self) -> int:
        return self._overlap

    def input_size(self, width: int, height: int) -> tuple[int, int]:
        return self._known.size

    def predict(self, frames: Sequence[NDArray[np.uint8]]) -> NDArray[np.float32]:
        indices = [self._known.index(rgb) for rgb in frames]
        chance = np.random.default_rng((self._seed, indices[0]))
        scale = math.exp(self._distortion.window_scale * chance.standard_normal())
        shift = self._distortion.window_shift * self._median * chance.standard_normal()
        return np.stack([(scale * self._one(index) + shift).astype(np.float32) for index in indices])

    def _one(self, index: int) -> Array:
        distortion, (width, height) = self._distortion, self._known.size
        depth = self._known.depth(index)
        inverse = np.where(depth > 0, 1 / np.maximum(depth, 1e-6), 0.0)
        # Errors that pixels share hang on the place in the picture and move through it slowly.
        v, u = np.mgrid[:height, :width]
        phase = np.random.default_rng(self._seed).uniform(0, 2 * math.pi, 3)
        waves = np.sin(6 * u / width + phase[0] + 0.05 * index) + np.sin(5 * v / height + phase[1] - 0.04 * index)
        error = distortion.smooth * waves
        chance = np.random.default_rng((self._seed, index, 1))
        error += distortion.noise * chance.standard_normal(depth.shape)
        off = chance.random(depth.shape) < distortion.outliers
        error[off] = chance.uniform(-0.67, 2.0, int(off.sum()))
        error[:, : round(distortion.wrong * width)] += 0.5
        out = self._scale[index] * inverse * (1 + error) + self._shift[index]
        out[: round(distortion.holes * height)] = np.nan
        return np.asarray(out)


class NoisyMetricDepth:
    """Metric depth with an error of scale per picture, some of them far off.

    Args:
        sigma: Standard deviation of the logarithm of each picture's scale.
        wrong: Share of the pictures whose scale is off by a factor of 3.
        bias: Factor on all depths.
    """

    def __init__(
        self,
        source: FrameSource,
        depth: NDArray[np.floating[Any]],
        depth_kind: DepthKind,
        size: tuple[int, int],
        *,
        sigma: float = 0.2,
        wrong: float = 0.1,
        bias: float = 1.0,
        seed: int = 0,
    ) -> None:
        self._known = _Known(source, depth, size)
        self._depth_kind: DepthKind = depth_kind
        chance = np.random.default_rng(seed)
        self._factor = bias * np.exp(sigma * chance.standard_normal(len(depth)))
        self._factor[chance.random(len(depth)) < wrong] *= 3.0

    @property
    def depth_kind(self) -> DepthKind:
        return self._depth_kind

    @property
    def shared_sigma_ratio(self) -> float:
        return 0.0

    def input_size(self, width: int, height: int) -> tuple[int, int]:
        return self._known.size

    def estimate(self, rgb: NDArray[np.uint8], camera: Camera) -> MetricEstimate:
        index = self._known.index(rgb)
        depth = (self._factor[index] * self._known.depth(index)).astype(np.float32)
        return MetricEstimate(depth, np.ones_like(depth))


class NearestCompletion:
    """Completion by the nearest known depth."""

    def complete(self, rgb: NDArray[np.uint8], depth: NDArray[np.float32], camera: Camera) -> NDArray[np.float32]:
        unknown = (depth <= 0).astype(np.uint8)
        _, labels = cv2.distanceTransformWithLabels(unknown, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
        values = np.zeros(int(labels.max()) + 1, np.float32)
        known = unknown == 0
        values[labels[known]] = depth[known]
        return np.asarray(values[labels], np.float32)
