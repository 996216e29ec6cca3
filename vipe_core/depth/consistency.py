"""What of a depth map other frames agree with, and how much that is worth."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vipe_core.depth.geometry import Prior, View
from vipe_core.depth.kernels import check
from vipe_core.depth.moving import unrefuted
from vipe_core.depth.sweep import RawDepth
from vipe_core.depth.types import DepthSettings

Array = NDArray[Any]

# A correlation of the first says nothing, of the second as much as it can.
_MIN_SCORE, _SURE_SCORE = 0.2, 0.7
# Of what no other frame contradicts: with one that agrees.
_HALF_SCORE = 0.5
# A margin over all other depths of the second says as much as it can. An answer without any rests on its neighbours.
_LEAST_DISTINCT, _SURE_MARGIN = 0.1, 0.2
# Of the frames that see a pixel, this share must agree, and at least so many; one for what correlates very well.
_MIN_SHARE, _MIN_VOTES = 0.5, 2
# What seems to move by itself must convince so many.
_SURE_VOTES = 3
# Belief in what nobody could be asked about, beside the same that all agree on; and the least belief that counts.
_LONE_BELIEF, _MIN_BELIEF = 0.3, 0.05
# Differences in inverse depth up to this share of a step of the coarse sweep are its noise, however far things are.
_SLACK_STEPS = 0.2
# Fewer connected pixels of one surface than this are agreement by chance; depths that differ more are two surfaces.
_SPECK_PX, _SPECK_STEP = 60, 0.03
_LEVELS_PER_STEP = 10


@dataclass(frozen=True, slots=True)
class Confirmed:
    """A depth map after the other frames were asked.

    Attributes:
        inverse_depth: (h, w) float32, the mean of those who agree.
        belief: (h, w) float32 in 0..1; 0 where too few agree.
        weight: (h, w) float32 as a measurement: the belief squared, and a little where nobody could be asked.
        moving: (h, w) bool, what seems to move after the other frames were asked.
    """

    inverse_depth: NDArray[np.float32]
    belief: NDArray[np.float32]
    weight: NDArray[np.float32]
    moving: NDArray[np.bool_]


def confirm(
    raw: RawDepth,
    others: Iterable[tuple[NDArray[np.float64], RawDepth]],
    view: View,
    prior: Prior,
    moving: NDArray[np.bool_],
    settings: DepthSettings,
) -> Confirmed:
    """Asks other frames about the depth of one.

    Args:
        raw: Of the frame.
        others: (4, 4) other_from_frame and depth of the frames to ask.
        view: Camera of the depth maps.
        prior: Of the frame.
        moving: (h, w) bool, what seems to move by itself.
    """
    value = raw.inverse_depth
    asked, hidden, votes, ratios = (np.zeros_like(value) for _ in range(4))
    slack = _SLACK_STEPS * (prior.high - prior.low) / settings.planes
    for motion, other in others:
        check(
            value,
            view.rays,
            other.inverse_depth,
            motion[:3, :3].astype(np.float32),
            motion[:3, 3].astype(np.float32),
            view.model,
            view.params,
            settings.check_tolerance,
            slack,
            asked,
            hidden,
            votes,
            ratios,
        )
    share = votes / np.maximum(asked - hidden, 1)
    score = np.clip((raw.score - _MIN_SCORE) / (_SURE_SCORE - _MIN_SCORE), 0, 1)
    distinct = np.clip(raw.margin / _SURE_MARGIN, 0, 1)
    belief = share * score * np.maximum(distinct, _LEAST_DISTINCT)
    agreed = (asked > 0) & (share >= _MIN_SHARE) & (belief >= _MIN_BELIEF)
    moving = unrefuted(moving, agreed & (votes >= _SURE_VOTES))
    believed = agreed & (votes >= np.where(moving, _SURE_VOTES, np.where(raw.score > _SURE_SCORE, 1, _MIN_VOTES)))
    belief = np.where(_without_specks(value, believed), belief, 0).astype(np.float32)
    # Nobody can be asked about what things hide from all others but those that agree. Nor about an answer that is far
    # too near: it counts for nothing without a margin, or outside of the range that is searched.
    enough = raw.score > np.where(votes > 0, _HALF_SCORE, _SURE_SCORE)
    alone = (asked == 0) | ((votes == asked - hidden) & enough)
    alone &= ~moving & (value >= prior.low) & (value <= prior.high)
    weight = np.where(alone & (belief == 0), _LONE_BELIEF * score * distinct, belief) ** 2
    return Confirmed((value * (1 + ratios) / (1 + votes)).astype(np.float32), belief, weight.astype(np.float32), moving)


def _without_specks(inverse_depth: Array, kept: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """`kept` without the surfaces of few pixels."""
    middle = max(float(np.median(inverse_depth)), 1e-12)
    level = np.log(np.maximum(inverse_depth / middle, 1e-9)) * (_LEVELS_PER_STEP / _SPECK_STEP)
    nothing = -32768
    image = np.where(kept, np.clip(np.round(level), -32000, 32000), nothing).astype(np.int16)
    cv2.filterSpeckles(image, nothing, _SPECK_PX, _LEVELS_PER_STEP)
    return np.asarray(image != nothing)
