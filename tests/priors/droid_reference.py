"""The DROID network once more, in float64 and as plainly as it can be said: loops over taps, cells and edges.

Written from the description of the network alone, to be compared with the real one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
Weights = Mapping[str, Array]


def convolve(w: Weights, name: str, x: Array, stride: int = 1) -> Array:
    """(O, H', W') of (C, H, W), padded by half the kernel."""
    kernel, bias = w[f"{name}.weight"], w[f"{name}.bias"]
    size = kernel.shape[-1]
    pad = size // 2
    height, width = ((n + 2 * pad - size) // stride + 1 for n in x.shape[1:])
    padded = np.zeros((x.shape[0], x.shape[1] + 2 * pad, x.shape[2] + 2 * pad))
    padded[:, pad : pad + x.shape[1], pad : pad + x.shape[2]] = x
    out = np.tile(bias[:, None, None], (1, height, width))
    for row in range(height):
        for column in range(width):
            patch = padded[:, row * stride : row * stride + size, column * stride : column * stride + size]
            out[:, row, column] += np.einsum("ocyx,cyx->o", kernel, patch)
    return out


def relu(x: Array) -> Array:
    return np.where(x > 0, x, 0.0)


def sigmoid(x: Array) -> Array:
    return 1 / (1 + np.exp(-x))


def encode(w: Weights, net: str, picture: Array) -> Array:
    """(O, H/8, W/8) of an RGB picture (H, W, 3) of 0..255."""

    def norm(x: Array) -> Array:
        if net == "cnet":
            return x
        mean, var = x.mean((1, 2), keepdims=True), x.var((1, 2), keepdims=True)
        return (x - mean) / np.sqrt(var + 1e-5)

    mean, std = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])
    x = ((picture / 255.0 - mean) / std).transpose(2, 0, 1)
    x = relu(norm(convolve(w, f"{net}.conv1", x, 2)))
    for layer in (1, 2, 3):
        for block in (0, 1):
            at = f"{net}.layer{layer}.{block}"
            stride = 2 if layer > 1 and block == 0 else 1
            y = relu(norm(convolve(w, f"{at}.conv1", x, stride)))
            y = relu(norm(convolve(w, f"{at}.conv2", y)))
            if stride == 2:
                x = norm(convolve(w, f"{at}.downsample.0", x, 2))
            x = relu(x + y)
    return convolve(w, f"{net}.conv2", x)


def correlate(source: Array, target: Array, cells: Array) -> Array:
    """(196, h, w) of features (C, h, w), at positions (h, w, 2) (x, y) in the target."""
    _, height, width = source.shape
    out = np.zeros((196, height, width))
    for row in range(height):
        for column in range(width):
            level_map = np.einsum("c,cyx->yx", source[:, row, column] / 4, target / 4)
            for level in range(4):
                x, y = cells[row, column] / 2**level
                for dx in range(-3, 4):
                    for dy in range(-3, 4):
                        channel = 49 * level + 7 * (dx + 3) + (dy + 3)
                        out[channel, row, column] = bilinear(level_map, x + dx, y + dy)
                level_map = halved(level_map)
    return out


def halved(image: Array) -> Array:
    height, width = (max(n // 2, 1) for n in image.shape)
    down, across = min(image.shape[0], 2), min(image.shape[1], 2)
    out = np.zeros((height, width))
    for row in range(height):
        for column in range(width):
            out[row, column] = image[2 * row : 2 * row + down, 2 * column : 2 * column + across].mean()
    return out


def bilinear(image: Array, x: float, y: float) -> float:
    left, top = math.floor(x), math.floor(y)
    total = 0.0
    for row, share_y in ((top, top + 1 - y), (top + 1, y - top)):
        for column, share_x in ((left, left + 1 - x), (left + 1, x - left)):
            if 0 <= row < image.shape[0] and 0 <= column < image.shape[1]:
                total += share_x * share_y * image[row, column]
    return total


def gru(w: Weights, hidden: Array, inputs: Array) -> Array:
    everywhere = (sigmoid(convolve(w, "update.gru.w", hidden)) * hidden).mean((1, 2))[:, None, None]

    def gate(name: str, state: Array) -> Array:
        stacked = np.concatenate([state, inputs])
        return convolve(w, f"update.gru.{name}", stacked) + convolve(w, f"update.gru.{name}_glo", everywhere)

    z, r = sigmoid(gate("convz", hidden)), sigmoid(gate("convr", hidden))
    return (1 - z) * hidden + z * np.tanh(gate("convq", r * hidden))


def two(w: Weights, name: str, x: Array) -> Array:
    return convolve(w, f"{name}.2", relu(convolve(w, f"{name}.0", x)))


def update(
    w: Weights,
    hidden: Sequence[Array],
    context: Sequence[Array],
    correlation: Sequence[Array],
    motion: Sequence[Array],
    sources: Sequence[int],
) -> tuple[list[Array], list[Array], list[Array], dict[int, Array]]:
    """States, corrections (2, h, w), weights (2, h, w) of each edge; damping (h, w) of each source."""
    states, deltas, weights = [], [], []
    aggregated: dict[int, list[Array]] = {}
    for edge, source in enumerate(sources):
        looked = relu(two(w, "update.corr_encoder", correlation[edge]))
        moved = relu(two(w, "update.flow_encoder", np.clip(motion[edge], -64, 64)))
        state = gru(w, hidden[edge], np.concatenate([context[edge], looked, moved]))
        states.append(state)
        deltas.append(two(w, "update.delta", state))
        weights.append(sigmoid(two(w, "update.weight", state)))
        aggregated.setdefault(source, []).append(relu(convolve(w, "update.agg.conv1", state)))
    damping = {}
    for source, each in aggregated.items():
        mean = relu(convolve(w, "update.agg.conv2", sum(each) / len(each)))
        damping[source] = 0.01 * np.log1p(np.exp(convolve(w, "update.agg.eta.0", mean)))[0]
    return states, deltas, weights, damping
