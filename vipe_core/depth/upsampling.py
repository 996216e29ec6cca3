"""Depth at the size of the source, along the edges of its picture."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vipe_core.compilation import compiled

Array = NDArray[Any]


@compiled
def upsample(
    inverse_depth: Array,
    confidence: Array,
    gray: Array,
    full_gray: Array,
    edge: float,
    same: float,
    closed: bool = False,
) -> tuple[Array, Array]:
    """Depth (not inverse) and confidence at the size of `full_gray`, following its edges.

    Each pixel looks at the four low-resolution samples around it, weighs them by distance and by grey-level difference,
    and averages those that lie on the surface of the heaviest one: no values between foreground and background.

    Args:
        inverse_depth, confidence, gray: (h, w) float32.
        full_gray: (H, W) uint8.
        edge: Grey-level difference that lowers a weight by a factor e.
        same: Relative difference in inverse depth within which two samples are one surface.
        closed: Whether the left and the right border are one place.
    """
    h, w = inverse_depth.shape
    rows, cols = full_gray.shape
    depth, sure = np.empty((rows, cols), np.float32), np.empty((rows, cols), np.float32)
    decay = np.empty(256, np.float32)
    for i in range(256):
        decay[i] = math.exp(-i / edge) + 1e-4
    weight, value, trust = np.empty(4, np.float32), np.empty(4, np.float32), np.empty(4, np.float32)
    for y in range(rows):
        v = (y + 0.5) * h / rows - 0.5
        v0 = math.floor(v)
        fv = v - v0
        for x in range(cols):
            u = (x + 0.5) * w / cols - 0.5
            u0 = math.floor(u)
            fu = u - u0
            heaviest = 0
            for i in range(4):
                yy = min(max(v0 + i // 2, 0), h - 1)
                xx = u0 + i % 2
                xx = xx % w if closed else min(max(xx, 0), w - 1)
                near = (fv if i // 2 else 1 - fv) * (fu if i % 2 else 1 - fu) + 1e-3
                difference = abs(np.float32(full_gray[y, x]) - gray[yy, xx])
                weight[i] = near * decay[min(255, int(difference))]
                value[i] = inverse_depth[yy, xx]
                trust[i] = confidence[yy, xx]
                if weight[i] > weight[heaviest]:
                    heaviest = i
            total, mean, mean_trust = 0.0, 0.0, 0.0
            for i in range(4):
                if abs(value[i] - value[heaviest]) <= same * value[heaviest]:
                    total += weight[i]
                    mean += weight[i] * value[i]
                    mean_trust += weight[i] * trust[i]
            depth[y, x] = total / mean
            sure[y, x] = mean_trust / total
    return depth, sure
