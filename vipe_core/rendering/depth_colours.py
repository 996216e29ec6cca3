"""Depth and confidence as colours: one range for a whole clip, near is bright."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vipe_core.annotation import MOVING, SKY, UNOBSERVED
from vipe_core.formats.frames import spread
from vipe_core.formats.reading import Artifacts

Array = NDArray[Any]
Canvas = NDArray[np.uint8]

# None of these is on the scale of the depths.
_SKY = (30, 44, 74)
_UNKNOWN = (58, 62, 70)
_MOVING_OUTLINE = (70, 235, 255)
_FILLED = (34, 37, 44)
_SAMPLED_FRAMES = 32
_SAMPLED_PIXELS = 4_000
# The darkest end of the map is left out, so that what is far differs from black.
_DARKEST = 0.08
# Between linear in inverse depth (all of the far end in one colour) and linear in depth.
_GAMMA = 0.6


@dataclass(frozen=True, slots=True)
class DepthColours:
    """A colour for each depth (inferno over a power of inverse depth, perceptually even), the same in all frames.

    Attributes:
        low, high: Inverse depths of the darkest and the brightest colour.
    """

    low: float
    high: float

    @classmethod
    def of(cls, artifacts: Artifacts) -> DepthColours:
        """The range of the whole clip, without its outer two per cent.

        Raises:
            FormatError: The sequence has no depth.
        """
        values: list[Array] = []
        with artifacts.open_depth() as depth:
            kinds = artifacts.open_kind() if artifacts.has_confidence else None
            try:
                for index in sorted(spread(len(depth), _SAMPLED_FRAMES)):
                    here = depth.read(index)
                    known = np.isfinite(here) & (here > 0)
                    if kinds is not None:
                        known &= ~np.isin(kinds.read(index), (SKY, UNOBSERVED))
                    inverse = 1 / here[known]
                    values.append(inverse[:: max(1, len(inverse) // _SAMPLED_PIXELS)])
            finally:
                if kinds is not None:
                    kinds.close()
        return cls.covering(np.concatenate(values))

    @classmethod
    def covering(cls, inverse_depths: Array) -> DepthColours:
        """The range of these values, without the outer two per cent."""
        if not len(inverse_depths):
            return cls(0.0, 1.0)
        low, high = (float(value) for value in np.percentile(inverse_depths, (2.0, 98.0)))
        return cls(low, max(high, low * 1.001))

    def paint(self, depth: Array, *, kind: Array | None = None, moving: Array | None = None) -> Canvas:
        """(H, W, 3) uint8 RGB. Sky is blue and what nobody knows is grey; what moves has an outline.

        Args:
            depth: (H, W); not positive is no value.
            kind: (H, W) classes of `annotation.DEPTH_KINDS`.
            moving: (H, W) bool.
        """
        known = np.isfinite(depth) & (depth > 0)
        inverse = np.where(known, 1 / np.where(known, depth, 1), self.low)
        share = np.clip((inverse - self.low) / (self.high - self.low), 0, 1) ** _GAMMA
        level = np.rint(255 * (_DARKEST + (1 - _DARKEST) * share)).astype(np.uint8)
        picture = np.ascontiguousarray(cv2.applyColorMap(level, cv2.COLORMAP_INFERNO)[..., ::-1])
        picture[~known] = _UNKNOWN
        if kind is not None:
            picture[kind == SKY] = _SKY
            picture[kind == UNOBSERVED] = _UNKNOWN
        if moving is None and kind is not None:
            moving = kind == MOVING
        if moving is not None and moving.any():
            outlines, _ = cv2.findContours(moving.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
            width = max(1, round(depth.shape[1] / 480))
            cv2.drawContours(picture, outlines, -1, _MOVING_OUTLINE, width, cv2.LINE_AA)
        return picture


def paint_confidence(confidence: Array) -> Canvas:
    """(H, W, 3) uint8 RGB: violet is doubtful, yellow is sure (viridis), grey was filled in."""
    level = np.rint(255 * np.clip(confidence, 0, 1)).astype(np.uint8)
    picture = np.ascontiguousarray(cv2.applyColorMap(level, cv2.COLORMAP_VIRIDIS)[..., ::-1])
    picture[confidence <= 0] = _FILLED
    return picture
