"""Depth of one frame from a few others: plane sweep at a quarter of the working size, refined at a half."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vipe_core.depth.geometry import Prior, View, relative
from vipe_core.depth.kernels import add_prior, aggregate, sweep_cost, upsample, winner
from vipe_core.depth.types import DepthSettings, SceneMap

Array = NDArray[Any]

_UPSAMPLE_EDGE = 8.0
_UPSAMPLE_SAME = 0.1


@dataclass(frozen=True, slots=True)
class RawDepth:
    """What one frame says by itself.

    Attributes:
        inverse_depth: (h, w) float32 at half of the working size.
        score: (h, w) float32 correlation at the answer, 0..1; 0 everywhere without sources.
        measured: Whether any source was there.
    """

    inverse_depth: NDArray[np.float32]
    score: NDArray[np.float32]
    measured: bool


class PlaneSweep:
    """Coarse-to-fine sweep for one camera."""

    def __init__(self, scene: SceneMap, settings: DepthSettings) -> None:
        self._scene = scene
        self._settings = settings
        width, height = scene.camera.width, scene.camera.height
        self.coarse = View.of(scene.camera.resized(width // 4, height // 4))
        self.fine = View.of(scene.camera.resized(width // 2, height // 2))

    def depth(self, frame: int, half: Array, sources: dict[int, Array], prior: Prior) -> RawDepth:
        """Inverse depth of a frame.

        Args:
            frame: Index.
            half: (h, w) uint8 gray at half of the working size.
            sources: Frame index -> gray at the same size.
            prior: What bundle adjustment says about this frame.
        """
        height, width = half.shape
        if not sources:
            start = cv2.resize(prior.inverse_depth, (width, height), interpolation=cv2.INTER_LINEAR)
            return RawDepth(np.asarray(start, np.float32), np.zeros_like(half, np.float32), False)
        settings = self._settings
        motion = [relative(self._scene.world_from_cam, frame, j) for j in sources]
        rotations = np.array([m[:3, :3] for m in motion], np.float32)
        translations = np.array([m[:3, 3] for m in motion], np.float32)

        size = (width // 2, height // 2)
        gray = _quarter(half)
        planes = np.linspace(prior.low, prior.high, settings.planes, dtype=np.float32)
        step = float(planes[1] - planes[0])
        cost = sweep_cost(
            gray,
            self.coarse.rays,
            np.zeros_like(gray),
            planes,
            np.stack([_quarter(image) for image in sources.values()]),
            rotations,
            translations,
            self.coarse.model,
            self.coarse.params,
            settings.coarse_radius,
            settings.noise,
        )
        guess = cv2.resize(prior.inverse_depth, size, interpolation=cv2.INTER_LINEAR)
        trust = cv2.resize(prior.confidence, size, interpolation=cv2.INTER_LINEAR)
        matching = cost.copy()
        add_prior(cost, (guess - planes[0]) / step, trust, settings.prior_gain, settings.prior_reach)
        position, raw = winner(self._aggregated(cost, gray), matching)
        coarse = planes[0] + position * step

        fine_gray = half.astype(np.float32)
        depth, _ = upsample(coarse, np.clip(1 - raw, 0, 1), gray, half, _UPSAMPLE_EDGE, _UPSAMPLE_SAME)
        base = 1 / depth
        offsets = np.linspace(-1, 1, settings.fine_planes, dtype=np.float32) * np.float32(settings.fine_reach * step)
        cost = sweep_cost(
            fine_gray,
            self.fine.rays,
            base,
            offsets,
            np.stack([image.astype(np.float32) for image in sources.values()]),
            rotations,
            translations,
            self.fine.model,
            self.fine.params,
            settings.fine_radius,
            settings.noise,
        )
        position, raw = winner(self._aggregated(cost, fine_gray), cost)
        found = base + offsets[0] + position * float(offsets[1] - offsets[0])
        found = np.clip(found, 0.2 * prior.low, 2 * prior.high).astype(np.float32)
        return RawDepth(found, np.clip(1 - raw, 0, 1).astype(np.float32), True)

    def _aggregated(self, cost: Array, gray: Array) -> Array:
        s = self._settings
        return aggregate(cost, gray, s.smooth_small, s.smooth_large, s.smooth_edge)


def _quarter(half: Array) -> NDArray[np.float32]:
    height, width = half.shape
    return np.asarray(cv2.resize(half, (width // 2, height // 2), interpolation=cv2.INTER_AREA), np.float32)
