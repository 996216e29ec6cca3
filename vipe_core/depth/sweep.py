"""Depth of one frame from a few others: plane sweep at a quarter of the working size, refined at a half."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vipe_core.depth.aggregation import add_prior, aggregate, winner
from vipe_core.depth.geometry import Prior, View
from vipe_core.depth.kernels import sweep_cost
from vipe_core.depth.seam import Seam
from vipe_core.depth.types import DepthSettings, SceneMap
from vipe_core.depth.upsampling import upsample
from vipe_core.geometry.arrays import inverse

Array = NDArray[Any]

_UPSAMPLE_EDGE = 8.0
_UPSAMPLE_SAME = 0.1


# The hypotheses go on beyond the range of the prior: this many even steps further away, and by growing steps up to so
# many times nearer, for things that adjustment could not place.
_FARTHER_STEPS = 4
_NEARER, _STEP_GROWTH = 2.5, 1.06
# The coarse windows carry the depth of a thing so many pixels (at half of the working size) beyond its border. What is
# further behind than this share is another surface; it must correlate better by so much.
_RIM_PX, _OTHER_SURFACE, _BETTER = 4, 0.1, 0.02
_TRIAL = np.linspace(-1, 1, 5, dtype=np.float32)


@dataclass(frozen=True, slots=True)
class RawDepth:
    """What one frame says by itself.

    Attributes:
        inverse_depth: (h, w) float32 at half of the working size.
        score: (h, w) float32 correlation at the answer, 0..1; 0 everywhere without sources.
        margin: (h, w) float32 how much better the answer correlates than any other, 0..2.
        measured: Whether any source was there.
    """

    inverse_depth: NDArray[np.float32]
    score: NDArray[np.float32]
    margin: NDArray[np.float32]
    measured: bool

    def around(self, seam: Seam) -> RawDepth:
        value, score, margin = (seam.around(part) for part in (self.inverse_depth, self.score, self.margin))
        return RawDepth(value, score, margin, self.measured)


class PlaneSweep:
    """Coarse-to-fine sweep for one camera."""

    def __init__(self, scene: SceneMap, settings: DepthSettings) -> None:
        self._scene = scene
        self._settings = settings
        width, height = scene.camera.width, scene.camera.height
        self.seam = Seam(scene.camera)
        self.coarse = View.of(scene.camera.resized(width // 4, height // 4), self.seam)
        self.fine = View.of(scene.camera.resized(width // 2, height // 2), self.seam)

    def depth(
        self, frame: int, half: Array, sources: dict[int, tuple[NDArray[np.uint8], NDArray[np.bool_]]], prior: Prior
    ) -> RawDepth:
        """Inverse depth of a frame.

        Args:
            frame: Index.
            half: (h, w) uint8 gray at half of the working size.
            sources: Frame index -> gray at the same size, and where it must not be used.
            prior: What bundle adjustment says about this frame.
        """
        if not sources:
            width, height = half.shape[::-1]
            start = cv2.resize(prior.inverse_depth, (width, height), interpolation=cv2.INTER_LINEAR)
            nothing = np.zeros_like(half, np.float32)
            return RawDepth(np.asarray(start, np.float32), nothing, nothing, False)
        settings, seam = self._settings, self.seam
        half, inverse_depth = seam.around(half), seam.around(prior.inverse_depth)
        height, width = half.shape
        poses = self._scene.world_from_cam
        motion = (inverse(poses[list(sources)]) @ poses[frame]).astype(np.float32)
        rotations, translations = np.ascontiguousarray(motion[:, :3, :3]), np.ascontiguousarray(motion[:, :3, 3])

        def cost_of(view: View, gray: Array, base: Array, step: Array, offsets: Array, images: Array, r: int) -> Array:
            return np.asarray(
                sweep_cost(
                    gray,
                    view.rays,
                    base,
                    step,
                    offsets,
                    images,
                    rotations,
                    translations,
                    view.model,
                    view.params,
                    r,
                    settings.support_stride,
                    settings.support_stride * view.stretch,
                    settings.support_edge,
                    settings.noise,
                )
            )

        size = (width // 2, height // 2)
        gray = _quarter(half)
        planes = hypotheses(prior.low, prior.high, settings.planes)
        images = np.stack([_usable(image, masked) for image, masked in sources.values()])
        small = np.stack([_quarter(image) for image in images])
        cost = cost_of(
            self.coarse, gray, np.zeros_like(gray), np.ones_like(gray), planes, small, settings.coarse_radius
        )
        guess = cv2.resize(inverse_depth, size, interpolation=cv2.INTER_LINEAR)
        trust = cv2.resize(seam.around(prior.confidence), size, interpolation=cv2.INTER_LINEAR)
        matching = cost.copy()
        numbers = np.arange(len(planes), dtype=np.float32)
        position = np.interp(guess, planes, numbers).astype(np.float32)
        add_prior(cost, position, trust, settings.prior_gain, settings.prior_reach)
        plane, raw, margin = winner(self._aggregated(cost, gray), matching)
        coarse = np.interp(plane, numbers, planes).astype(np.float32)
        reach = settings.fine_reach * np.interp(plane, numbers, np.gradient(planes)).astype(np.float32)

        fine_gray = half.astype(np.float32)
        coarse = np.maximum(coarse, np.float32(0.05 * prior.low))
        depth, _ = upsample(coarse, np.clip(1 - raw, 0, 1), gray, half, _UPSAMPLE_EDGE, _UPSAMPLE_SAME)
        step = cv2.resize(reach, (width, height), interpolation=cv2.INTER_LINEAR)
        base = trimmed(
            1 / depth, lambda d: cost_of(self.fine, fine_gray, d, step, _TRIAL, images, settings.fine_radius)
        )
        offsets = np.linspace(-1, 1, settings.fine_planes, dtype=np.float32)
        cost = cost_of(self.fine, fine_gray, base, step, offsets, images, settings.fine_radius)
        position, raw, _ = winner(self._aggregated(cost, fine_gray), cost)
        found = base + step * (offsets[0] + position * (offsets[1] - offsets[0]))
        found = np.maximum(found, 0.05 * prior.low).astype(np.float32)
        sure = cv2.resize(margin, (width, height), interpolation=cv2.INTER_LINEAR)
        score = np.clip(1 - raw, 0, 1).astype(np.float32)
        # The nearest of all hypotheses wins where none is right.
        at_end = (plane > len(planes) - 2).astype(np.uint8)
        score[cv2.resize(at_end, (width, height), interpolation=cv2.INTER_NEAREST) > 0] = 0
        return RawDepth(seam.joined(found), seam.inside(score), seam.inside(np.asarray(sure, np.float32)), True)

    def _aggregated(self, cost: Array, gray: Array) -> Array:
        s = self._settings
        return np.asarray(aggregate(cost, gray, s.smooth_small, s.smooth_large, s.smooth_edge))


def trimmed(inverse_depth: Array, cost_at: Callable[[Array], Array]) -> NDArray[np.float32]:
    """Things without the rim that the coarse windows gave them: what lies behind, beside them, is tried there.

    Args:
        inverse_depth: (h, w).
        cost_at: Matching costs (h, w, D) of hypotheses around an inverse depth (h, w).
    """
    side = 2 * _RIM_PX + 1
    behind = cv2.erode(inverse_depth, np.ones((side, side), np.uint8))
    rim = behind < (1 - _OTHER_SURFACE) * inverse_depth
    if not rim.any():
        return np.asarray(inverse_depth, np.float32)
    here, there = (cost_at(d).min(axis=2) for d in (inverse_depth, np.where(rim, behind, inverse_depth)))
    better = cv2.blur(np.where(rim, here - there, 0).astype(np.float32), (3, 3)) > _BETTER
    return np.where(rim & better, behind, inverse_depth).astype(np.float32)


def hypotheses(low: float, high: float, count: int) -> NDArray[np.float32]:
    """Increasing inverse depths: `count` even steps from `low` to `high`, some beyond on the far side (not below 0),
    and growing steps on the near side."""
    step = (high - low) / (count - 1)
    further = min(_FARTHER_STEPS, int(low / step))
    even = low + step * np.arange(-further, count)
    nearer = [high]
    while nearer[-1] < _NEARER * high:
        step *= _STEP_GROWTH
        nearer.append(nearer[-1] + step)
    return np.concatenate([even, nearer[1:]]).astype(np.float32)


def _usable(image: NDArray[np.uint8], masked: NDArray[np.bool_]) -> NDArray[np.float32]:
    return np.where(masked, np.float32(np.nan), image.astype(np.float32))


def _quarter(half: Array) -> NDArray[np.float32]:
    height, width = half.shape
    return np.asarray(cv2.resize(half, (width // 2, height // 2), interpolation=cv2.INTER_AREA), np.float32)
