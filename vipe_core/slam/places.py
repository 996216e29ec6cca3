"""Place recognition within one video: which keyframes look alike (VLAD, Jegou et al., CVPR 2010).

The vocabulary is made from the video itself, so nothing has to be trained or shipped.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2

_WORDS = 64
_TRAINING = 8000
_SEED = 0


def similarity(count: int, descriptors: Callable[[int], NDArray[np.float32]]) -> NDArray[np.float32]:
    """(K, K) cosine of the looks of `count` frames. A blank frame has zeros.

    Args:
        descriptors: Frame number -> its (n, D) unit descriptors. Asked for one frame at a time, and again: those of a
            long video would take more memory than its map.
    """
    ends = np.cumsum([len(descriptors(k)) for k in range(count)], dtype=np.int64)
    total = int(ends[-1]) if count else 0
    if total < _WORDS:
        return np.zeros((count, count), np.float32)
    chosen = np.linspace(0, total - 1, min(total, _TRAINING)).astype(np.int64)
    owner = np.searchsorted(ends, chosen, side="right")
    # Counted from the end, a descriptor has its number within its frame.
    training = np.concatenate([descriptors(k)[chosen[owner == k] - ends[k]] for k in np.unique(owner)])
    with warnings.catch_warnings():
        # A word that no descriptor is nearest to, where many are the same: it stays what it was, and counts nothing.
        warnings.filterwarnings("ignore", "One of the clusters is empty")
        words, _ = kmeans2(training.astype(np.float64), _WORDS, iter=8, minit="points", rng=_SEED)
    words = words.astype(np.float32)
    looks = np.stack([_vlad(descriptors(k), words) for k in range(count)])
    # What all frames of the video have in common tells no places apart.
    looks -= looks.mean(axis=0)
    looks /= np.maximum(np.linalg.norm(looks, axis=1, keepdims=True), 1e-6)
    return np.asarray(looks @ looks.T)


def _vlad(descriptors: NDArray[np.float32], words: NDArray[np.float32]) -> NDArray[np.float32]:
    """(words * D,) sums of the differences from the nearest word, each word's sum normalised and then the whole."""
    total = np.zeros_like(words)
    if len(descriptors):
        distance = np.square(words).sum(axis=1) - 2 * (descriptors @ words.T)
        nearest = distance.argmin(axis=1)
        np.add.at(total, nearest, descriptors - words[nearest])
    total /= np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-6)
    flat = total.reshape(-1)
    return np.asarray(flat / max(float(np.linalg.norm(flat)), 1e-6))
