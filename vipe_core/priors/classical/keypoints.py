"""Local features with descriptors: SIFT corners and blobs as RootSIFT (Arandjelovic and Zisserman, CVPR 2012).

Unlike flow they need no starting point: they are found again whatever the displacement, which is what wide steps and
returns to an old place call for.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

MAX_KEYPOINTS = 1500
_CONTRAST = 0.02
# A descriptor has length 1 and no element above about a half: this maps it to bytes.
_BYTES_PER_UNIT = 512.0
_RATIO = 0.8


@dataclass(frozen=True, slots=True)
class Keypoints:
    """Features of one frame.

    Attributes:
        points_px: (n, 2) float32 index coordinates in the working image.
        descriptors: (n, 128) uint8 RootSIFT, a unit vector times 512.
    """

    points_px: NDArray[np.float32]
    descriptors: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.points_px)

    def vectors(self) -> NDArray[np.float32]:
        """(n, 128) descriptors of unit length."""
        vectors = self.descriptors.astype(np.float32)
        return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-6))


def detect(gray: NDArray[np.uint8], usable: NDArray[np.bool_] | None) -> Keypoints:
    """The strongest keypoints of a (h, w) picture; those on pixels that are not `usable` are left out."""
    sift = cv2.SIFT.create(nfeatures=MAX_KEYPOINTS, contrastThreshold=_CONTRAST)
    mask = None if usable is None else usable.astype(np.uint8)
    found, raw = sift.detectAndCompute(gray, mask)
    if raw is None or not len(found):
        return Keypoints(np.zeros((0, 2), np.float32), np.zeros((0, 128), np.uint8))
    points = np.array([point.pt for point in found], dtype=np.float32)
    root = np.sqrt(raw / np.maximum(raw.sum(axis=1, keepdims=True), 1e-6))
    return Keypoints(points, np.clip(np.rint(_BYTES_PER_UNIT * root), 0, 255).astype(np.uint8))


def mutual_matches(source: Keypoints, target: Keypoints) -> NDArray[np.int64]:
    """(m, 2) pairs that are each other's nearest neighbour and clearly nearer than the second nearest."""
    if len(source) < 2 or len(target) < 2:
        return np.zeros((0, 2), np.int64)
    similarity = source.vectors() @ target.vectors().T
    there = similarity.argmax(axis=1)
    back = similarity.argmax(axis=0)
    rows = np.arange(len(there))
    best = similarity[rows, there]
    similarity[rows, there] = -1.0
    second = similarity.max(axis=1)
    # Squared distances of unit vectors are 2 - 2 cos.
    clear = (1.0 - best) < _RATIO**2 * (1.0 - second)
    kept = np.flatnonzero((back[there] == rows) & clear)
    return np.stack([kept, there[kept]], axis=-1)
