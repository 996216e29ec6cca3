"""One camera out of what independent witnesses claim about the focal length.

Claims are Gaussians in log(f). Those that agree are multiplied, together with a wide default. A claim that the others
contradict by more than the sigmas allow is not averaged away: it becomes a rival, from which the map is started too,
and the measurements decide (`IntrinsicsEstimate.rivals_px`).
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from vipe_core.ba.problem import Grid
from vipe_core.cameras import Camera
from vipe_core.priors.protocols import IntrinsicsEstimate, WorkingFrame

logger = logging.getLogger(__name__)

# Two claims contradict each other when they are farther apart than so many of their joint sigmas.
_CONTRADICTION = 2.0


@dataclass(frozen=True, slots=True)
class FocalClaim:
    """What one witness says.

    Attributes:
        witness: Its name, for the log.
        log_focal: log of the focal length, working pixels.
        sigma: Standard deviation of it.
        support: Pairs or frames behind it.
    """

    witness: str
    log_focal: float
    sigma: float
    support: int


class FocalWitness(Protocol):
    """Knows something about the focal length from a kind of evidence of its own."""

    def claim(self, frames: Sequence[WorkingFrame]) -> FocalClaim | None:
        """What the frames (in time order, at least one) say; None where they say nothing."""


class CombinedFocalInit:
    """`IntrinsicsInit` without a network: independent witnesses and a default.

    Wants the frames in time order, up to about 200, evenly spread or consecutive.

    Args:
        witnesses: Asked in this order.
        default_fov_deg: Horizontal field of view where nothing can be said.
        default_log_sigma: Standard deviation of log(f) of that default.
    """

    def __init__(
        self,
        witnesses: Sequence[FocalWitness],
        default_fov_deg: float = 60.0,
        default_log_sigma: float = 0.3,
    ) -> None:
        self._witnesses = tuple(witnesses)
        self._default_fov_deg = default_fov_deg
        self._default_log_sigma = default_log_sigma

    def estimate(self, frames: Sequence[WorkingFrame], grid: Grid) -> IntrinsicsEstimate:
        """A centred pinhole with square pixels; the default with a wide sigma when nobody knows anything."""
        height, width = frames[0].gray.shape
        claims = [claim for witness in self._witnesses if (claim := witness.claim(frames)) is not None]
        default = math.log(width / 2 / math.tan(math.radians(self._default_fov_deg) / 2))
        log_focal, sigma, rivals = combine(claims, default, self._default_log_sigma)
        for claim in claims:
            logger.debug("%s: focal %.1f px, sigma %.3f", claim.witness, math.exp(claim.log_focal), claim.sigma)
        focal = math.exp(log_focal)
        rivals_px = tuple(math.exp(rival) for rival in rivals)
        logger.debug("focal %.1f px, sigma %.3f, rivals %s", focal, sigma, rivals_px)
        camera = Camera("pinhole", (focal, focal, width / 2, height / 2), width, height)
        return IntrinsicsEstimate(camera, sigma, sum(claim.support for claim in claims), rivals_px)


def combine(
    claims: Sequence[FocalClaim], default_log_focal: float, default_sigma: float
) -> tuple[float, float, tuple[float, ...]]:
    """Blend what agrees with the surest claim; what contradicts it becomes a rival and widens the sigma up to it.

    Returns:
        log(f), its standard deviation, and log(f) of the rivals.
    """
    if not claims:
        return default_log_focal, default_sigma, ()
    surest = min(claims, key=lambda claim: claim.sigma)
    agreeing: list[FocalClaim] = []
    rivals: list[FocalClaim] = []
    for claim in claims:
        apart = abs(claim.log_focal - surest.log_focal)
        (rivals if apart > _CONTRADICTION * math.hypot(claim.sigma, surest.sigma) else agreeing).append(claim)
    information = [1 / default_sigma**2, *(1 / claim.sigma**2 for claim in agreeing)]
    values = [default_log_focal, *(claim.log_focal for claim in agreeing)]
    total = sum(information)
    mean = sum(value * weight for value, weight in zip(values, information, strict=True)) / total
    sigma = max([1 / math.sqrt(total), *(abs(rival.log_focal - mean) for rival in rivals)])
    return mean, sigma, tuple(rival.log_focal for rival in rivals)
