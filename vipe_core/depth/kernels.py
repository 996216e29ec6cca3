"""Compiled loops of the plane sweep: warping, correlation, and consistency between frames.

All geometry is written in inverse depth along the ray of the camera model: a pixel with ray r and inverse depth d is
seen by another camera in direction R r + d t, with no division by d, so d = 0 (infinity) is an ordinary value.

Numba's cache notices changes of the file of a function only, so what calls each other lives here together.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vipe_core.compilation import compiled, vectorised

Array = NDArray[Any]


_FAR_COST = 1.0


@compiled
def _project(model: int, params: Array, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Index coordinates of a direction, and the length that its inverse depth is divided by (0: not imaged)."""
    if model == 0:
        if z <= 1e-6:
            return 0.0, 0.0, 0.0
        inverse = 1.0 / z
        return params[0] * x * inverse + params[2], params[1] * y * inverse + params[3], z
    norm = math.sqrt(x * x + y * y + z * z)
    if model == 1:
        s = z + params[4] * norm
        if s <= 1e-6 * norm or (params[4] > 1 and params[4] * z <= -norm):
            return 0.0, 0.0, 0.0
        return params[0] * x / s + params[2], params[1] * y / s + params[3], norm
    u = (math.atan2(x, z) / (2 * math.pi) + 0.5) * params[0] - 0.5
    v = math.atan2(math.sqrt(x * x + z * z), -y) / math.pi * params[1] - 0.5
    return u, v, norm


@compiled
def _warp_pinhole(
    image: Array, turned: Array, t: Array, base: Array, step: Array, offset: float, params: Array, warped: Array
) -> None:
    """Samples `image` at every pixel for the inverse depths `base + offset * step`, all in float32 for speed.

    `warped` is a view of the size of `base`; what is not seen becomes NaN.
    """
    h, w = base.shape
    fx, fy, cx, cy = params[0], params[1], params[2], params[3]
    tx, ty, tz = t[0], t[1], t[2]
    zero, one, tiny, missing = np.float32(0), np.float32(1), np.float32(1e-6), np.float32(np.nan)
    right, bottom = np.float32(w - 1), np.float32(h - 1)
    for y in range(h):
        for x in range(w):
            d = max(zero, base[y, x] + offset * step[y, x])
            z = turned[y, x, 2] + tz * d
            if z > tiny:
                inverse = one / z
                u = fx * (turned[y, x, 0] + tx * d) * inverse + cx
                v = fy * (turned[y, x, 1] + ty * d) * inverse + cy
                if u >= zero and v >= zero and u <= right and v <= bottom:
                    ui, vi = np.uint32(min(np.int32(u), w - 2)), np.uint32(min(np.int32(v), h - 2))
                    fu, fv = u - np.float32(ui), v - np.float32(vi)
                    upper = image[vi, ui] + fu * (image[vi, ui + 1] - image[vi, ui])
                    lower = image[vi + 1, ui] + fu * (image[vi + 1, ui + 1] - image[vi + 1, ui])
                    warped[y, x] = upper + fv * (lower - upper)
                    continue
            warped[y, x] = missing


@compiled
def _warp(
    image: Array,
    turned: Array,
    t: Array,
    base: Array,
    step: Array,
    offset: float,
    model: int,
    params: Array,
    warped: Array,
) -> None:
    """`_warp_pinhole` for any camera model."""
    h, w = base.shape
    for y in range(h):
        for x in range(w):
            d = max(np.float32(0), base[y, x] + offset * step[y, x])
            u, v, length = _project(
                model, params, turned[y, x, 0] + t[0] * d, turned[y, x, 1] + t[1] * d, turned[y, x, 2] + t[2] * d
            )
            if length > 0 and u >= 0 and v >= 0 and u <= w - 1 and v <= h - 1:
                ui, vi = min(int(u), w - 2), min(int(v), h - 2)
                fu, fv = np.float32(u - ui), np.float32(v - vi)
                upper = image[vi, ui] + fu * (image[vi, ui + 1] - image[vi, ui])
                lower = image[vi + 1, ui] + fu * (image[vi + 1, ui + 1] - image[vi + 1, ui])
                warped[y, x] = upper + fv * (lower - upper)
            else:
                warped[y, x] = np.nan


@vectorised
def _supports(image: Array, radius: int, stride: int, edge: float) -> tuple[Array, Array, Array]:
    """Adaptive support windows (Yoon and Kweon, PAMI 2006): pixels that look like the centre count most.

    A window does not reach over the edge of a thing onto what is behind it, so that neither takes the other's depth.

    Returns:
        weights: (T, h, w) float32, sum 1 over the taps of a pixel; 0 outside of the picture.
        products: (T, h, w) float32 weights times the grey level at the tap.
        statistics: (2, h, w) float32 weighted mean and variance.
    """
    h, w = image.shape
    side = 2 * (radius // stride) + 1
    weights = np.zeros((side * side, h, w), np.float32)
    products = np.zeros((side * side, h, w), np.float32)
    statistics = np.zeros((2, h, w), np.float32)
    reach = stride * (radius // stride)
    for y in range(h):
        for x in range(w):
            total, mean, squares = 0.0, 0.0, 0.0
            for i in range(side * side):
                v, u = y + stride * (i // side) - reach, x + stride * (i % side) - reach
                if v < 0 or u < 0 or v >= h or u >= w:
                    continue
                weight = math.exp(-abs(image[v, u] - image[y, x]) / edge)
                weights[i, y, x] = weight
                total += weight
                mean += weight * image[v, u]
                squares += weight * image[v, u] * image[v, u]
            mean /= total
            for i in range(side * side):
                v, u = y + stride * (i // side) - reach, x + stride * (i % side) - reach
                if v < 0 or u < 0 or v >= h or u >= w:
                    continue
                weights[i, y, x] /= total
                products[i, y, x] = weights[i, y, x] * image[v, u]
            statistics[0, y, x] = mean
            statistics[1, y, x] = max(0.0, squares / total - mean * mean)
    return weights, products, statistics


@vectorised
def _correlate(
    weights: Array,
    products: Array,
    mean: Array,
    gain: Array,
    warped: Array,
    radius: int,
    stride: int,
    noise: float,
    first: Array,
    second: Array,
    count: Array,
) -> None:
    """Correlation of all windows with the warped pictures (D, h + 2 radius, w + 2 radius) of one source.

    Keeps the best two scores (D, h, w) and counts the sources. The inner loops have no branches, so that the compiler
    can vectorise them; what is not seen is NaN and makes the sums of its window NaN.
    """
    num_planes, h, w = first.shape
    side = 2 * (radius // stride) + 1
    start = radius - stride * (radius // stride)
    sums = np.empty((3, w), np.float32)
    floor, outside = np.float32(noise), np.float32(-2)
    for y in range(h):
        for k in range(num_planes):
            sums[:] = 0
            for i in range(side * side):
                line = warped[k, y + start + stride * (i // side)]
                shift = start + stride * (i % side)
                share, product = weights[i, y], products[i, y]
                for x in range(w):
                    j = line[x + shift]
                    part = share[x] * j
                    sums[0, x] += part
                    sums[1, x] += part * j
                    sums[2, x] += product[x] * j
            for x in range(w):
                mj = sums[0, x]
                spread = max(np.float32(0), sums[1, x] - mj * mj) + floor
                value = (sums[2, x] - mj * mean[y, x]) * gain[y, x] / np.float32(math.sqrt(spread))
                whole = value == value
                score = value if whole else outside
                best = first[k, y, x]
                second[k, y, x] = max(second[k, y, x], min(best, score))
                first[k, y, x] = max(best, score)
                count[k, y, x] += np.uint8(whole)


@compiled
def sweep_cost(
    reference: Array,
    rays: Array,
    base: Array,
    step: Array,
    offsets: Array,
    sources: Array,
    rotations: Array,
    translations: Array,
    model: int,
    params: Array,
    radius: int,
    stride: int,
    edge: float,
    noise: float,
) -> Array:
    """Matching cost of every pixel for the inverse depths `base + offsets[k] * step`.

    The cost is 1 minus the zero-mean normalised cross-correlation of adaptive support windows, averaged over the better
    half of the sources: what is hidden in one direction is usually visible in another. A source that does not see the
    window says nothing, a correlation of 0; the best of fewer would look better, and the fewest see what is very near.

    Args:
        reference: (h, w) float32 gray.
        rays: (h, w, 3) float32 rays of its pixels.
        base, step: (h, w) float32.
        offsets: (D,) float32.
        sources: (S, h, w) float32 gray images of the same camera, NaN on pixels that must not be used.
        rotations: (S, 3, 3) float32 source_from_reference.
        translations: (S, 3) float32.
        model: Code of the camera model.
        params: (5,) float32 index parameters at this resolution.
        radius: Half side of the window.
        stride: Distance of the pixels of a window that count.
        edge: Grey-level difference to the centre that lowers the weight of a pixel by a factor e.
        noise: Variance that is added to both windows'.

    Returns:
        (h, w, D) float32 in 0..2; 1 where no source sees the window.
    """
    h, w = reference.shape
    num_planes, num_sources = len(offsets), len(sources)
    # Grey levels around zero keep the products small for float32.
    level = np.float32(reference.mean())
    weights, products, statistics = _supports(reference - level, radius, stride, edge)
    gain = (1 / np.sqrt(statistics[1] + np.float32(noise))).astype(np.float32)
    first = np.full((num_planes, h, w), np.float32(-2), np.float32)
    second = np.full((num_planes, h, w), np.float32(-2), np.float32)
    count = np.zeros((num_planes, h, w), np.uint8)
    turned = np.empty((h, w, 3), np.float32)
    warped = np.zeros((num_planes, h + 2 * radius, w + 2 * radius), np.float32)
    for s in range(num_sources):
        r, t, image = rotations[s], translations[s], sources[s] - level
        for y in range(h):
            for x in range(w):
                for c in range(3):
                    turned[y, x, c] = r[c, 0] * rays[y, x, 0] + r[c, 1] * rays[y, x, 1] + r[c, 2] * rays[y, x, 2]
        for k in range(num_planes):
            inner = warped[k, radius : radius + h, radius : radius + w]
            if model == 0:
                _warp_pinhole(image, turned, t, base, step, offsets[k], params, inner)
            else:
                _warp(image, turned, t, base, step, offsets[k], model, params, inner)
        _correlate(weights, products, statistics[0], gain, warped, radius, stride, noise, first, second, count)
    cost = np.empty((h, w, num_planes), np.float32)
    half, zero = np.float32(0.5), np.float32(0)
    for y in range(h):
        for k in range(num_planes):
            for x in range(w):
                if count[k, y, x] == 0:
                    cost[y, x, k] = _FAR_COST
                elif num_sources <= 2:
                    cost[y, x, k] = 1 - first[k, y, x]
                else:
                    other = second[k, y, x] if count[k, y, x] > 1 else zero
                    cost[y, x, k] = 1 - half * (first[k, y, x] + other)
    return cost


@compiled
def check(
    inverse_depth: Array,
    rays: Array,
    other: Array,
    rotation: Array,
    translation: Array,
    model: int,
    params: Array,
    tolerance: float,
    slack: float,
    asked: Array,
    hidden: Array,
    votes: Array,
    ratios: Array,
) -> None:
    """Where another frame's depth map confirms this one; adds to the last four arrays (h, w) in place.

    A pixel that lands in the other picture is asked there. It is confirmed where the inverse depths differ by no more
    than `tolerance` of the predicted one plus `slack`: one vote, and the ratio of the two. It is hidden where the other
    frame sees something nearer, which is no contradiction.
    """
    h, w = inverse_depth.shape
    for y in range(h):
        for x in range(w):
            d = inverse_depth[y, x]
            a, b, c = rays[y, x, 0], rays[y, x, 1], rays[y, x, 2]
            u, v, length = _project(
                model,
                params,
                rotation[0, 0] * a + rotation[0, 1] * b + rotation[0, 2] * c + translation[0] * d,
                rotation[1, 0] * a + rotation[1, 1] * b + rotation[1, 2] * c + translation[1] * d,
                rotation[2, 0] * a + rotation[2, 1] * b + rotation[2, 2] * c + translation[2] * d,
            )
            ui, vi = math.floor(u + 0.5), math.floor(v + 0.5)
            if length <= 0 or ui < 0 or vi < 0 or ui >= w or vi >= h:
                continue
            predicted = max(d / length, 1e-12)
            nearer = other[vi, ui] - predicted
            bound = tolerance * predicted + slack
            asked[y, x] += 1
            if nearer > bound:
                hidden[y, x] += 1
            elif nearer >= -bound:
                votes[y, x] += 1
                ratios[y, x] += other[vi, ui] / predicted
