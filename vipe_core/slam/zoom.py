"""Whether the focal length changes within a shot.

The map has one focal length. Each pair of keyframes two apart is fitted once more by itself, without the map, with a
second focal length that is s times the first:

    a camera that turns and zooms: what it sees moves by rotation and s alone, to the noise of matching. This needs no
    parallax, and takes s for what it is where a map would walk towards a flat scene instead;
    a camera that travels: the epipolar geometry of two pictures with s free. Where it travels along its axis, zoom and
    motion look alike: s is then unsure, and a prior keeps it at 1.

The products of s along the shot are the focal length over time. Errors of a pair do not add up in one direction; those
of the lens, which the camera model leaves out, might, and set the least change that is told from none.
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

from vipe_core.cameras import Camera
from vipe_core.cameras.epipolar import RaySlopes, essential_matrix, sampson_distances
from vipe_core.geometry.arrays import relative
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
# Errors of flow are correlated: formal sigmas are too small by about this factor.
_INFLATION = 3.0
# A rotation explains a pair when the median residual is below this, pixels of a working image that is 640 wide.
_TURNED_PX = 0.5
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


def find_zoom(keyframes: KeyframeMap, graph: Graph, scale_px: float) -> Zoom:
    """The change of the focal length over a shot.

    Args:
        scale_px: Pixels of the working image per pixel of one that is 640 wide.
    """
    logs, variances = [0.0], [0.0]
    for i, j in _chain(len(keyframes), graph):
        found = _pair(keyframes, graph, i, j, scale_px)
        if found is not None:
            logs.append(logs[-1] + found[0])
            variances.append(variances[-1] + found[1] ** 2)
            logger.debug("keyframes %d-%d: log zoom %.4f, sigma %.4f", i, j, *found)
    first, last = sorted((int(np.argmin(logs)), int(np.argmax(logs))))
    if first == last:
        return NO_ZOOM
    return Zoom(math.exp(abs(logs[last] - logs[first])), math.sqrt(variances[last] - variances[first]))


def _chain(count: int, graph: Graph) -> Iterator[tuple[int, int]]:
    """Edges from the first keyframe to the last, two keyframes long where there are such."""
    at = 0
    while at < count - 1:
        to = next((at + step for step in (_STEP, 1, 3, 4) if (at, at + step) in graph), None)
        if to is not None:
            yield at, to
        at = at + 1 if to is None else to


def _pair(keyframes: KeyframeMap, graph: Graph, i: int, j: int, scale_px: float) -> tuple[float, float] | None:
    """log s between two keyframes and its 1-sigma; None where too little is measured."""
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

    def turned(values: Array) -> Array:
        rotation = cv2.Rodrigues(values[:3])[0] @ start[:3, :3]
        # The focal length itself is free as well: the map's is that of no frame in particular.
        rays = camera.zoomed(math.exp(values[4])).unproject(source_px)
        px, imaged = camera.zoomed(math.exp(values[3] + values[4])).project(rays @ rotation.T)
        return np.where(imaged[:, None], px - target_px, scales[0])

    values, information, residual = _fit(turned, 5, scales)
    if np.median(np.linalg.norm(residual, axis=1)) < max(_TURNED_PX * scale_px, 0.25):
        return _estimate(values[3], information, residual)
    _, _, held = _fit(_Epipolar(camera, source_px, target_px, start, free=False), 6, scales)
    values, information, residual = _fit(_Epipolar(camera, source_px, target_px, start, free=True), 6, scales)
    gain = 1 - _cost(residual, scales[-1]) / max(_cost(held, scales[-1]), 1e-12)
    logger.debug("%d-%d: %.4f, gain %.3f, %.3f px", i, j, values[3], gain, float(np.median(np.abs(residual))))
    return _estimate(values[3], information, residual) if gain > _MIN_GAIN else None


def _cost(residual: Array, scale: float) -> float:
    square = np.square(residual / scale).sum(axis=1)
    return float((square / (1 + square)).mean())


class _Epipolar:
    """Residuals of a pair's epipolar geometry by (rotation, log s, direction), the changes from a start."""

    def __init__(self, camera: Camera, source_px: Array, target_px: Array, start: Array, *, free: bool) -> None:
        self._camera, self._target_px, self._start, self._free = camera, target_px, start, free
        self._first = RaySlopes.of(camera, source_px)
        self._seen: dict[float, RaySlopes] = {}
        norm = float(np.linalg.norm(start[:3, 3]))
        self._direction = start[:3, 3] / norm if norm > 1e-9 else np.array([0.0, 0.0, 1.0])
        self._aside = np.linalg.svd(self._direction[None])[2][1:]

    def __call__(self, values: Array) -> Array:
        pose = np.eye(4)
        pose[:3, :3] = cv2.Rodrigues(values[:3])[0] @ self._start[:3, :3]
        pose[:3, 3] = self._direction + values[4:6] @ self._aside
        pose[:3, 3] /= np.linalg.norm(pose[:3, 3])
        second = self._second(float(values[3]) if self._free else 0.0)
        return sampson_distances(essential_matrix(pose), self._first, second)[:, None]

    def _second(self, log_s: float) -> RaySlopes:
        """Most calls change something else than s."""
        if log_s not in self._seen:
            if len(self._seen) > 2:
                self._seen.clear()
            self._seen[log_s] = RaySlopes.of(self._camera.zoomed(math.exp(log_s)), self._target_px)
        return self._seen[log_s]


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
