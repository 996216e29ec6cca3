"""Whether the focal length changes within a shot.

The map has one focal length. Two questions tell whether that was right:

    a camera that turns and zooms: pairs of keyframes two apart are fitted by themselves, without the map, by a rotation
    and a second focal length that is s times the first. Where that explains a pair to the noise of matching, it needs
    no parallax, and takes s for what it is where a map would walk towards a flat scene instead. The products of s along
    the shot are the focal length over time;
    a camera that travels: the whole map is adjusted once more with a focal length for every keyframe. Pairs alone would
    not do: two pictures whose optical axes meet, as those of a camera that circles around something, leave both focal
    lengths open (Kahl and Triggs, CVPR 1999). The adjustment is a test, and the map stays as it is.

A change must be larger than errors of lenses make one look, and explain what one focal length cannot.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vipe_core.geometry.arrays import relative
from vipe_core.slam.adjustment import Adjuster, Step
from vipe_core.slam.graph import Graph
from vipe_core.slam.keyframes import KeyframeMap
from vipe_core.statistics import MAD_TO_SIGMA

logger = logging.getLogger(__name__)

Array = NDArray[Any]

_STEP = 2
_MIN_POINTS = 60
_MAX_POINTS = 400
_MIN_WEIGHT = 0.05
# Pairs are told to keep their focal length with this sigma of log s: a second of fast zoom between two keyframes.
_PRIOR_SIGMA = 0.3
# Robust kernel, pixels of a working image that is 640 wide: from wide to narrow.
_SCALES_PX = (8.0, 2.0, 1.0)
_ITERATIONS = 5
_TRIES = 4
_DIFFERENCE = 1e-5
# Errors of flow are correlated: formal sigmas are too small by about this factor. What is wrong with the lens is wrong
# with all pictures alike, and no part of a ratio.
_INFLATION = 3.0
# A rotation explains a pair when the median residual is below this, pixels of a working image that is 640 wide.
_TURNED_PX = 0.5
# Share of the pairs that must be explained so for the camera to be one that turns.
_MOST = 0.5
# The map is adjusted in stretches of this many keyframes, which share some with the next one.
_STRETCH, _SHARED = 24, 6
# A zoom starts the adjustment far from the end, and one that is none ends at once.
_WIDE = (Step("geman_mcclure", 4.0, 12, 1e-3),)
_NARROW = (Step("geman_mcclure", 4.0, 12, 1e-3), Step("geman_mcclure", 1.0, 40, 1e-3))
# Least change of the focal length over a shot, and how many sigmas it must be away from none.
MIN_RATIO = 1.12
_MIN_SIGMAS = 4.0
# Share of what an unchanging focal length leaves that another one must explain.
_MIN_GAIN = 0.15


@dataclass(frozen=True, slots=True)
class Zoom:
    """What is known of the focal length over a shot.

    Attributes:
        ratio: Longest focal length over the shortest, as far as the pairs tell.
        sigma: 1-sigma of its logarithm.
    """

    ratio: float
    sigma: float

    @property
    def changes(self) -> bool:
        """Whether the focal length changes for sure, and visibly."""
        return self.ratio > MIN_RATIO and math.log(self.ratio) > _MIN_SIGMAS * self.sigma


NO_ZOOM = Zoom(1.0, math.nan)


def find_zoom(keyframes: KeyframeMap, graph: Graph, adjuster: Adjuster, scale_px: float) -> Zoom:
    """The change of the focal length over a shot.

    Args:
        scale_px: Pixels of the working image per pixel of one that is 640 wide.
    """
    pairs = list(_chain(len(keyframes), graph))
    if not pairs:
        return NO_ZOOM
    turned = [found for i, j in pairs if (found := _turned(keyframes, graph, i, j, scale_px)) is not None]
    if len(turned) < _MOST * len(pairs):
        return _of_travel(keyframes, graph, adjuster)
    logs = np.cumsum([0.0, *(log_s for log_s, _ in turned)])
    variances = np.cumsum([0.0, *(sigma**2 for _, sigma in turned)])
    return _between(logs, variances)


def _between(logs: Array, variances: Array) -> Zoom:
    """From running sums of log s and of their variances."""
    first, last = sorted((int(np.argmin(logs)), int(np.argmax(logs))))
    if first == last:
        return NO_ZOOM
    return Zoom(math.exp(abs(logs[last] - logs[first])), math.sqrt(variances[last] - variances[first]))


def _of_travel(keyframes: KeyframeMap, graph: Graph, adjuster: Adjuster) -> Zoom:
    """By adjustments with a focal length for every keyframe, stretch by stretch."""
    count = len(keyframes)
    logs, sigmas = np.zeros(count), np.zeros(count)
    gains: list[float] = []
    start = 0
    while True:
        frames = list(range(start, min(start + _STRETCH, count)))
        found = adjuster.probe_focals(keyframes, graph, frames, _WIDE)
        if found is None:
            return NO_ZOOM
        if math.exp(np.ptp(found.logs)) > MIN_RATIO:
            held = adjuster.probe_focals(keyframes, graph, frames, _NARROW, shared=True)
            found = adjuster.probe_focals(keyframes, graph, frames, _NARROW) or found
            gains.append(0.0 if held is None else 1 - found.cost / max(held.cost, 1e-12))
        # Each stretch has the focal length of its own start for a unit: they agree where they overlap.
        both = slice(start, start + _SHARED)
        offset = float(np.median(logs[both] - found.logs[:_SHARED])) if start else 0.0
        logs[frames], sigmas[frames] = found.logs + offset, found.sigmas
        if frames[-1] == count - 1:
            break
        start += _STRETCH - _SHARED
    shortest, longest = int(np.argmin(logs)), int(np.argmax(logs))
    ratio = math.exp(logs[longest] - logs[shortest])
    sigma = _INFLATION * math.hypot(sigmas[longest], sigmas[shortest])
    logger.debug("focal lengths of keyframes: %s, gains %s", np.round(np.exp(logs - logs[0]), 3), np.round(gains, 3))
    if ratio > MIN_RATIO and max(gains, default=0.0) < _MIN_GAIN:
        return NO_ZOOM
    return Zoom(ratio, sigma)


def _chain(count: int, graph: Graph) -> Iterator[tuple[int, int]]:
    """Edges from the first keyframe to the last, two keyframes long where there are such."""
    at = 0
    while at < count - 1:
        to = next((at + step for step in (_STEP, 1, 3, 4) if (at, at + step) in graph), None)
        if to is not None:
            yield at, to
        at = at + 1 if to is None else to


def _turned(keyframes: KeyframeMap, graph: Graph, i: int, j: int, scale_px: float) -> tuple[float, float] | None:
    """log s between two keyframes and its 1-sigma; None where no rotation explains them, or little is measured."""
    match = graph[i, j]
    kept = np.flatnonzero((match.weight.max(axis=1) > _MIN_WEIGHT) & keyframes.static(i))
    if len(kept) < _MIN_POINTS:
        kept = np.flatnonzero(match.weight.max(axis=1) > _MIN_WEIGHT)
    if len(kept) < _MIN_POINTS:
        return None
    kept = kept[np.linspace(0, len(kept) - 1, min(len(kept), _MAX_POINTS)).astype(np.int64)]
    source_px = keyframes.grid.sample_px().numpy()[kept].astype(np.float64)
    target_px = match.target_px[kept].astype(np.float64)
    camera = keyframes.camera
    start = relative(keyframes.pose(j), keyframes.pose(i))
    scales = [max(scale * scale_px, 0.5) for scale in _SCALES_PX]

    def error(values: Array) -> Array:
        rotation = cv2.Rodrigues(values[:3])[0] @ start[:3, :3]
        # The focal length itself is free as well: the map's is that of no frame in particular.
        rays = camera.zoomed(math.exp(values[4])).unproject(source_px)
        px, imaged = camera.zoomed(math.exp(values[3] + values[4])).project(rays @ rotation.T)
        return np.where(imaged[:, None], px - target_px, scales[0])

    values, information, residual = _fit(error, 5, scales)
    if np.median(np.linalg.norm(residual, axis=1)) >= max(_TURNED_PX * scale_px, 0.25):
        return None
    return _estimate(values[3], information, residual)


def _cost(residual: Array, scale: float) -> float:
    square = np.square(residual / scale).sum(axis=1)
    return float((square / (1 + square)).mean())


def _fit(error: Callable[[Array], Array], size: int, scales: list[float]) -> tuple[Array, Array, Array]:
    """Robust Levenberg-Marquardt from 0; value 3 is log s.

    Returns:
        The values, their information matrix for residuals of variance 1, and the residuals (n, d).
    """
    values = np.zeros(size)
    information = np.eye(size)
    residual = error(values)
    for scale in scales:
        damping = 1e-6
        cost = _cost(residual, scale)
        for _ in range(_ITERATIONS):
            columns = [(error(values + _DIFFERENCE * unit) - residual) / _DIFFERENCE for unit in np.eye(size)]
            kernel = 1 / np.square(1 + np.square(residual / scale).sum(axis=1))
            jacobian = np.stack(columns, axis=-1)
            information = np.einsum("n,nda,ndb->ab", kernel, jacobian, jacobian)
            gradient = np.einsum("n,nda,nd->a", kernel, jacobian, residual)
            # In units of the kernel, so that the prior is weak but there where nothing else tells s.
            gradient[3] += (scale / _PRIOR_SIGMA) ** 2 * values[3]
            for _ in range(_TRIES):
                damped = information + np.diag(damping * np.diag(information) + 1e-9)
                damped[3, 3] += (scale / _PRIOR_SIGMA) ** 2
                step = np.clip(np.linalg.solve(damped, gradient), -0.2, 0.2)
                tried = error(values - step)
                if _cost(tried, scale) <= cost:
                    break
                damping = max(10 * damping, 1e-3)
            else:
                break
            values, residual, cost, damping = values - step, tried, _cost(tried, scale), damping / 10
            if np.abs(step).max() < 1e-5:
                break
    return values, information, residual


def _estimate(log_s: float, information: Array, residual: Array) -> tuple[float, float]:
    """log s with its prior, and its 1-sigma: the formal one is too small because errors of flow are correlated."""
    noise = MAD_TO_SIGMA * float(np.median(np.abs(residual)))
    variance = np.linalg.pinv(information, hermitian=True)[3, 3] * (_INFLATION * max(noise, 0.02)) ** 2
    # What Gauss-Newton found has hardly seen the prior: here it counts.
    share = _PRIOR_SIGMA**2 / (_PRIOR_SIGMA**2 + variance)
    return float(share * log_s), float(math.sqrt(share * variance))
