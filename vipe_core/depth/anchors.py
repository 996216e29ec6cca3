"""What video depth is aligned to in one frame: the map as the frame sees it, completed where it is sparse, and metric
depth where there is next to none of it (paper, section 3.3).

Each source counts by how much of the picture is left to it, so nothing changes all at once from one frame to the next.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vipe_core.annotation import DepthKind
from vipe_core.cameras import Camera
from vipe_core.cameras.along import inverse_along
from vipe_core.depth.alignment import Samples
from vipe_core.depth.projection import MapProjector, ProjectedMap
from vipe_core.depth.types import SceneMap
from vipe_core.priors.protocols import DepthFamily
from vipe_core.slam.segmentation import MOVING
from vipe_core.video.source import Frame

Array = NDArray[Any]

# Shares of the picture that the map covers: from the upper one on it is enough by itself, below the lower one metric
# depth joins in.
_DENSE, _SPARSE = 0.5, 0.1
# The least number of samples that is given to completion.
_MIN_KNOWN = 20
# Independent measurements in a picture full of samples of the map, of completed ones, and of metric ones: those share
# the error of the picture's scale, so all of them are worth less than one of the map.
_MEASURED, _COMPLETED, _METRIC = 60.0, 15.0, 0.05


@dataclass(frozen=True, slots=True)
class Anchors:
    """What is known of a frame.

    Attributes:
        px: (n, 2) index coordinates in the picture of the video model.
        cell: (n,) row-major cells that they lie in.
        samples: Video depth and scene there; the first `measured` are of the map.
        measured: How many.
        coverage: Share of the picture that the map covers without what moves.
    """

    px: NDArray[np.float64]
    cell: NDArray[np.int64]
    samples: Samples
    measured: int
    coverage: float


class AnchorFinder:
    """Finds the anchors of the frames of a video.

    Args:
        family: Video depth, and completion and metric depth where there are any.
        size: (width, height) of the video model's pictures.
        metres: Whether the scene is in metres, so that metric depth can stand in for the map.
    """

    def __init__(self, scene: SceneMap, family: DepthFamily, kind: DepthKind, size: tuple[int, int], metres: bool):
        self._scene, self._family, self._metres = scene, family, metres
        self._projector = MapProjector(scene)
        self._cells: tuple[int, int] = scene.inverse_depth.shape[1:]
        self._camera = scene.camera.resized(*size)
        self.along = inverse_along(self._camera, kind)
        self._along_metric = None if family.metric is None else inverse_along(self._camera, family.metric.depth_kind)

    @property
    def camera(self) -> Camera:
        """At the size of the video model's pictures."""
        return self._camera

    def of(self, frame: Frame, video: NDArray[np.float32]) -> Anchors:
        """Anchors of a frame.

        Args:
            frame: At the size of the video model.
            video: (h, w) its inverse depth.
        """
        seen = self._projector.of(frame.index).without(self._unusable(frame))
        width, height = self._camera.width, self._camera.height
        scale = np.array([width / self._scene.camera.width, height / self._scene.camera.height])
        px = (seen.px + 0.5) * scale - 0.5
        parts = [(px, seen.cell, seen.inverse_depth, _worth(seen.weight, _MEASURED * seen.coverage))]
        left = np.clip((_DENSE - seen.coverage) / (_DENSE - _SPARSE), 0, 1)
        known = np.zeros(self._cells[0] * self._cells[1], np.bool_)
        known[seen.cell] = True
        if self._family.completion is not None and left > 0 and len(seen.cell) >= _MIN_KNOWN:
            worth = _COMPLETED * (1 - seen.coverage) * float(left) * min(1.0, seen.coverage / _SPARSE)
            sparse = np.zeros((height, width), np.float32)
            at = np.clip(np.rint(px), 0, (width - 1, height - 1)).astype(np.int64)
            sparse[at[:, 1], at[:, 0]] = 1 / seen.inverse_depth
            dense = self._family.completion.complete(frame.rgb, sparse, self._camera)
            parts.append(self._sampled(1 / np.maximum(dense, 1e-9).astype(np.float64), ~known, worth))
        if self._family.metric is not None and self._along_metric is not None and self._metres:
            worth = _METRIC * max(0.0, 1 - seen.coverage / _SPARSE)
            if worth > 0:
                found = self._family.metric.estimate(frame.rgb, self._camera)
                positive = (found.depth_m > 0) & np.isfinite(found.depth_m) & (self._along_metric > 0)
                along_ray = np.where(positive, found.depth_m * np.where(positive, self._along_metric, 1), np.inf)
                parts.append(self._sampled(1 / along_ray, ~known, worth, found.confidence))
        return self._joined(parts, seen, video)

    def _joined(self, parts: list[tuple[Array, Array, Array, Array]], seen: ProjectedMap, video: Array) -> Anchors:
        px, cell, inverse_depth, weight = (np.concatenate(part) for part in zip(*parts, strict=True))
        samples = Samples(_at(video, px), inverse_depth * _at(self.along.astype(np.float32), px), weight)
        return Anchors(px, cell, samples, len(seen.cell), seen.coverage)

    def _sampled(
        self, inverse_depth: Array, cells: Array, worth: float, confidence: Array | None = None
    ) -> tuple[Array, Array, Array, Array]:
        """Values of a picture (h, w) in the middle of some cells, worth so many measurements together."""
        rows, columns = self._cells
        cell = np.flatnonzero(cells)
        scale = np.array([self._camera.width / columns, self._camera.height / rows])
        px = (np.stack((cell % columns, cell // columns), axis=-1) + 0.5) * scale - 0.5
        value = inverse_depth[np.rint(px[:, 1]).astype(np.int64), np.rint(px[:, 0]).astype(np.int64)]
        trust = np.ones(len(cell)) if confidence is None else _at(np.asarray(confidence, np.float32), px)
        kept = np.isfinite(value) & (value > 0) & (trust > 0)
        return px[kept], cell[kept], value[kept], _worth(trust[kept], worth)

    def _unusable(self, frame: Frame) -> NDArray[np.bool_]:
        """(h8, w8) cells in which something moves, or that must not be used, and their neighbours."""
        rows, columns = self._cells
        out = np.zeros((rows, columns), np.uint8)
        if self._scene.labels is not None:
            out |= (self._scene.labels[frame.index].reshape(rows, columns) == MOVING).astype(np.uint8)
        if frame.masked is not None:
            share = cv2.resize(frame.masked.astype(np.float32), (columns, rows), interpolation=cv2.INTER_AREA)
            out |= (share > 0).astype(np.uint8)
        return np.asarray(cv2.dilate(out, np.ones((3, 3), np.uint8)) > 0)


def _worth(weight: Array, worth: float) -> NDArray[np.float64]:
    """The weights, made to add up to what they are worth together."""
    return np.asarray(weight * (worth / max(float(weight.sum()), 1e-9)), np.float64)


def _at(image: Array, px: Array) -> NDArray[np.float64]:
    """(n,) bilinear samples; the border continues the picture."""
    if not len(px):
        return np.zeros(0)
    at = np.asarray(px, np.float32)[None]
    found = cv2.remap(image, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(found[0], np.float64)
