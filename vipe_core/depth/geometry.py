"""Cameras at the resolutions of the sweep, the choice of source frames, and the prior that bundle adjustment left."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vipe_core.cameras import MODEL_CODE, Camera
from vipe_core.depth.seam import Seam
from vipe_core.depth.types import DepthSettings, SceneMap
from vipe_core.geometry.arrays import inverse

Array = NDArray[Any]

_CONFIDENT = 0.3
_MIN_SAMPLES = 40
# Windows of a panorama widen towards the poles up to so many times; the last seven degrees show little anyway.
_MAX_STRETCH = 8


@dataclass(frozen=True)
class View:
    """A camera at one resolution, as the kernels take it.

    Attributes:
        camera: At this resolution.
        model: Code of its model.
        params: (5,) float32 index parameters, padded with zeros.
        rays: (h, w, 3) float32; of a panorama beyond both ends of the picture, by its seam.
        stretch: (h,) int64, how many pixels of a row are as wide as one is high; 1 but for a panorama.
    """

    camera: Camera
    model: int
    params: NDArray[np.float32]
    rays: NDArray[np.float32]
    stretch: NDArray[np.int64]

    @classmethod
    def of(cls, camera: Camera, seam: Seam | None = None) -> View:
        params = np.zeros(5, np.float32)
        index_params = camera.index_params()
        params[: len(index_params)] = index_params
        rays = camera.rays().astype(np.float32)
        if seam is not None:
            rays = seam.around(rays)
        stretch = np.ones(camera.height, np.int64)
        if camera.model == "equirect":
            beside_pole = np.sin((np.arange(camera.height) + 0.5) / camera.height * np.pi)
            stretch = np.clip(np.rint(1 / beside_pole), 1, _MAX_STRETCH).astype(np.int64)
        return cls(camera, MODEL_CODE[camera.model], params, np.ascontiguousarray(rays), stretch)


def length_of(camera: Camera, points: Array) -> NDArray[np.float64]:
    """What the inverse depth of a point is the inverse of: z for pinhole, distance otherwise."""
    return np.asarray(points[..., 2] if camera.model == "pinhole" else np.linalg.norm(points, axis=-1))


@dataclass(frozen=True, slots=True)
class Prior:
    """What the keyframes say about one frame, on the grid of cells.

    Attributes:
        inverse_depth: (h8, w8) float32, positive everywhere.
        confidence: (h8, w8) float32; 0 where no keyframe says anything.
        low, high: Range of inverse depth in view.
    """

    inverse_depth: NDArray[np.float32]
    confidence: NDArray[np.float32]
    low: float
    high: float


class KeyframePrior:
    """Carries the keyframes' inverse depth into any frame."""

    def __init__(self, scene: SceneMap) -> None:
        self._scene = scene
        height, width = scene.inverse_depth.shape[1:]
        self._camera = scene.camera.resized(width, height)
        self._rays = self._camera.rays()
        self._seam = Seam(scene.camera)
        values: Array = scene.inverse_depth[(scene.confidence > _CONFIDENT) & (scene.inverse_depth > 0)]
        if not len(values):
            values = scene.inverse_depth[np.isfinite(scene.inverse_depth) & (scene.inverse_depth > 0)]
        if not len(values):
            values = np.ones(1)
        self.median = float(np.median(values))
        self._range = _padded_range(values)

    def of(self, frame: int) -> Prior:
        """The prior of a frame from the keyframe at or before it and the one after it."""
        scene = self._scene
        height, width = self._rays.shape[:2]
        value = np.zeros(height * width)
        trust = np.zeros(height * width)
        after = int(np.searchsorted(scene.keyframes, frame, side="right"))
        start, stop = scene.shot_of(frame)
        for k in (after - 1, after):
            if not (0 <= k < len(scene.keyframes) and start <= scene.keyframes[k] < stop):
                continue
            d, c, cell = self._carried(k, frame)
            carried, carried_trust = np.zeros_like(value), np.zeros_like(trust)
            # Ascending inverse depth: the nearest surface is written last and stays.
            order = np.argsort(d, kind="stable")
            carried[cell[order]] = d[order]
            carried_trust[cell[order]] = c[order]
            both = (trust > 0) & (carried_trust > 0)
            agree = np.abs(carried - value) < 0.05 * np.maximum(carried, value)
            total = trust + carried_trust
            mean = (trust * value + carried_trust * carried) / np.maximum(total, 1e-9)
            better = carried_trust > trust
            value = np.where(both & agree, mean, np.where(better, carried, value))
            # Two keyframes that contradict each other are half as credible as the better of them.
            strongest = np.maximum(trust, carried_trust)
            trust = np.where(both & ~agree, 0.5 * strongest, strongest)
        return self._finished(value.reshape(height, width), trust.reshape(height, width))

    def _carried(self, k: int, frame: int) -> tuple[Array, Array, Array]:
        scene = self._scene
        height, width = self._rays.shape[:2]
        motion = inverse(scene.world_from_cam[frame]) @ scene.world_from_cam[scene.keyframes[k]]
        d = scene.inverse_depth[k].astype(np.float64)
        points = self._rays @ motion[:3, :3].T + d[..., None] * motion[:3, 3]
        px, imaged = self._camera.project(points)
        col, row = np.rint(px[..., 0]), np.rint(px[..., 1])
        if self._seam.closed:
            col %= width
        kept = imaged & (col >= 0) & (row >= 0) & (col < width) & (row < height)
        kept &= (scene.confidence[k] > 0) & (d > 0) & np.isfinite(d)
        length = length_of(self._camera, points)
        kept &= length > 1e-9
        cell = row[kept].astype(np.int64) * width + col[kept].astype(np.int64)
        return d[kept] / length[kept], scene.confidence[k][kept].astype(np.float64), cell

    def _finished(self, value: Array, trust: Array) -> Prior:
        confident = value[trust > _CONFIDENT]
        low, high = _padded_range(confident) if len(confident) >= _MIN_SAMPLES else self._range
        weight = trust.astype(np.float32)
        filled: Array = np.full(value.shape, self.median, np.float32)
        around, product = self._seam.around(weight), self._seam.around((weight * value).astype(np.float32))
        for sigma in (12.0, 3.0, 1.0):
            total = self._seam.joined(cv2.GaussianBlur(around, (0, 0), sigma))
            blurred = self._seam.joined(cv2.GaussianBlur(product, (0, 0), sigma))
            filled = np.where(total > 0.02, blurred / np.maximum(total, 1e-6), filled)
        known = trust > 0
        return Prior(
            np.clip(np.where(known, value, filled), 1e-3 * low, 10 * high).astype(np.float32), weight, low, high
        )


def _padded_range(values: Array) -> tuple[float, float]:
    """Range of inverse depth to search, from samples of it."""
    low, high = np.quantile(values, (0.01, 0.99))
    return 0.7 * float(low), 1.4 * float(high)


def choose_sources(scene: SceneMap, view: View, prior: Prior, frame: int, settings: DepthSettings) -> list[int]:
    """Up to four frames that see what `frame` sees with useful parallax: a near and a far one from each side.

    Parallax is counted in pixels rather than as a share of the depth, so that forward motion, which moves the picture
    little, gets the longer baselines that it needs. Empty when no frame of the window has parallax.
    """
    start, stop = scene.shot_of(frame)
    first = max(start, frame - settings.window_frames)
    last = min(stop - 1, frame + settings.window_frames)
    candidates = np.array([j for j in range(first, last + 1) if j != frame], np.int64)
    if not len(candidates):
        return []
    camera = view.camera
    rows = np.linspace(0.08, 0.92, 7) * (camera.height - 1)
    cols = np.linspace(0.08, 0.92, 9) * (camera.width - 1)
    if camera.model == "equirect":
        cols = (np.arange(8) + 0.5) / 8 * camera.width - 0.5
    px = np.stack(np.meshgrid(cols, rows), axis=-1).reshape(-1, 2)
    rays = camera.unproject(px)
    cell_rows = np.clip((px[:, 1] * prior.inverse_depth.shape[0] / camera.height).astype(int), 0, None)
    cell_cols = np.clip((px[:, 0] * prior.inverse_depth.shape[1] / camera.width).astype(int), 0, None)
    d = prior.inverse_depth[cell_rows, cell_cols].astype(np.float64)
    motion = inverse(scene.world_from_cam[candidates]) @ scene.world_from_cam[frame]
    turned = np.einsum("nij,pj->npi", motion[:, :3, :3], rays)
    seen, imaged = camera.project(turned + d[None, :, None] * motion[:, None, :3, 3])
    unmoved, _ = camera.project(turned)
    if camera.model == "equirect":
        # Everything is in view. Pixels count as they do at the horizon: near the poles they are many for a small angle.
        inside = imaged
        along = camera.unproject(seen)
        angle = np.arctan2(np.linalg.norm(np.cross(along, turned), axis=-1), (along * turned).sum(-1))
        shift = angle * (camera.width / (2 * np.pi))
    else:
        inside = imaged & (seen >= 0).all(-1) & (seen <= (camera.width - 1, camera.height - 1)).all(-1)
        shift = np.where(inside, np.linalg.norm(seen - unmoved, axis=-1), 0.0)
    overlap = inside.mean(axis=1)
    # Median over the points inside: they sort to the end, behind the zeros of the others.
    shift.sort(axis=1)
    middle = shift.shape[1] - 1 - inside.sum(axis=1) // 2
    parallax = shift[np.arange(len(shift)), np.clip(middle, 0, None)]
    usable = (overlap >= settings.min_overlap) & (parallax >= settings.min_parallax_px)
    scale = camera.width / 160
    chosen: list[int] = []
    for side in (candidates < frame, candidates > frame):
        pool = np.flatnonzero(usable & side).tolist()
        for wanted in settings.parallax_px:
            left = [i for i in pool if i not in chosen]
            if left:
                chosen.append(min(left, key=lambda i: (abs(np.log(parallax[i] / (wanted * scale))), i)))
    missing = 2 * len(settings.parallax_px) - len(chosen)
    if missing > 0:
        middle = float(np.sqrt(settings.parallax_px[0] * settings.parallax_px[-1])) * scale
        left = [i for i in np.flatnonzero(usable).tolist() if i not in chosen]
        left.sort(key=lambda i: (abs(np.log(parallax[i] / middle)), i))
        chosen += left[:missing]
    return sorted(int(candidates[i]) for i in chosen)
