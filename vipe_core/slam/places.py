"""Place recognition within one video: which keyframes look alike (VLAD, Jegou et al., CVPR 2010).

The vocabulary is made from the video itself, so nothing has to be trained or shipped.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2

_WORDS = 64
_TRAINING = 8000
_SEED = 0


def similarity(descriptors: Sequence[NDArray[np.float32]]) -> NDArray[np.float32]:
    """(K, K) cosine of the looks of K frames, from the (n_k, D) unit descriptors of each. A blank frame has zeros."""
    count = len(descriptors)
    everything = np.concatenate(list(descriptors)) if count else np.zeros((0, 1), np.float32)
    if len(everything) < _WORDS:
        return np.zeros((count, count), np.float32)
    chosen = np.linspace(0, len(everything) - 1, min(len(everything), _TRAINING)).astype(np.int64)
    with warnings.catch_warnings():
        # A word that no descriptor is nearest to, where many are the same: it stays what it was, and counts nothing.
        warnings.filterwarnings("ignore", "One of the clusters is empty")
        words, _ = kmeans2(everything[chosen].astype(np.float64), _WORDS, iter=8, minit="points", rng=_SEED)
    words = words.astype(np.float32)
    looks = np.stack([_vlad(found, words) for found in descriptors])
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
