"""Similarity transforms and the closed-form alignment of two point sets (float64 numpy)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float64Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Sim3:
    """target_from_source: x -> scale * rotation @ x + translation.

    Attributes:
        scale: Positive.
        rotation: (3, 3).
        translation: (3,) in the target frame.
    """

    scale: float
    rotation: Float64Array
    translation: Float64Array

    @property
    def matrix(self) -> Float64Array:
        """(4, 4) with the scale in the upper left block."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.scale * self.rotation
        matrix[:3, 3] = self.translation
        return matrix

    def apply(self, points: Float64Array) -> Float64Array:
        """(..., 3) points of the source frame -> (..., 3) points of the target frame."""
        return self.scale * (points @ self.rotation.T) + self.translation

    def apply_to_poses(self, source_from_body: Float64Array) -> Float64Array:
        """(..., 4, 4) rigid poses in the source frame -> rigid poses in the target frame (positions scaled)."""
        target_from_body = source_from_body.copy()
        target_from_body[..., :3, :3] = self.rotation @ source_from_body[..., :3, :3]
        target_from_body[..., :3, 3] = self.apply(source_from_body[..., :3, 3])
        return target_from_body

    def __matmul__(self, other: Sim3) -> Sim3:
        """target_from_source @ source_from_other: `self` after `other`."""
        return Sim3(self.scale * other.scale, self.rotation @ other.rotation, self.apply(other.translation))

    def inverse(self) -> Sim3:
        """source_from_target."""
        return Sim3(1 / self.scale, self.rotation.T, -(self.rotation.T @ self.translation) / self.scale)


def umeyama(src: Float64Array, dst: Float64Array, with_scale: bool = True, weights: Float64Array | None = None) -> Sim3:
    """The similarity (or rigid motion) that moves `src` onto `dst` with the least squared distance.

    Source: S. Umeyama, Least-squares estimation of transformation parameters between two point patterns, 1991.

    Args:
        src: (N, 3) points.
        dst: (N, 3) points they correspond to.
        with_scale: Estimate the scale too; otherwise it is one.
        weights: (N,) non-negative, or None for equal ones.

    Returns:
        dst_from_src. On a line or a single point the rotation that is not determined is an arbitrary proper one.

    Raises:
        ValueError: Shapes disagree, values are not finite, there is no weight, or (with scale) a set has no extent.
    """
    src = np.asarray(src, dtype=np.float64)
    dst = np.asarray(dst, dtype=np.float64)
    if src.shape != dst.shape or src.ndim != 2 or src.shape[1] != 3 or len(src) == 0:
        raise ValueError(f"umeyama takes two (N, 3) arrays with N > 0, got {src.shape} and {dst.shape}")
    share = np.ones(len(src)) if weights is None else np.asarray(weights, dtype=np.float64)
    if not (np.isfinite(src).all() and np.isfinite(dst).all() and share.sum() > 0):
        raise ValueError("umeyama takes finite points with a positive total weight")
    share = share / share.sum()

    src_mean = share @ src
    dst_mean = share @ dst
    src_centred = src - src_mean
    dst_centred = dst - dst_mean
    u, singular, vt = np.linalg.svd((share[:, None] * dst_centred).T @ src_centred)
    # A reflection is never an answer: flip the direction that costs least.
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = (u * signs) @ vt
    scale = 1.0
    if with_scale:
        src_variance = float(share @ (src_centred**2).sum(axis=1))
        scale = float(singular @ signs) / src_variance if src_variance > 0 else 0.0
        if not scale > 0:
            raise ValueError("umeyama cannot find a scale: all points of one set coincide")
    return Sim3(scale, rotation, dst_mean - scale * rotation @ src_mean)
