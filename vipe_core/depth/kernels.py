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


@vectorised
def _angle(y: Any, x: Any) -> Any:
    """`atan2` in float32 without a call, to 1e-5 radians, a thousandth of a pixel: an odd polynomial for the arc
    tangent (minimax on 0..1), unfolded to the full circle."""
    pi, half_pi = np.float32(math.pi), np.float32(math.pi / 2)
    wide, high = abs(x), abs(y)
    large, small = (wide, high) if wide > high else (high, wide)
    t = small / (large + np.float32(1e-30))
    q = t * t
    r = np.float32(0.05265332) - q * np.float32(0.01172120)
    r = np.float32(0.19354346) - q * (np.float32(0.11643287) - q * r)
    r = t * (np.float32(0.99997726) - q * (np.float32(0.33262347) - q * r))
    r = half_pi - r if high > wide else r
    r = pi - r if x < 0 else r
    return -r if y < 0 else r


@vectorised
def _warp_around(
    image: Array, turned: Array, t: Array, base: Array, step: Array, offset: float, params: Array, warped: Array
) -> None:
    """`_warp_pinhole` for a panorama, which sees everything; `base` may be wider than it."""
    h, w = base.shape
    rows, columns = image.shape
    zero, half, one = np.float32(0), np.float32(0.5), np.float32(1)
    per_turn, per_half_turn = params[0] / np.float32(2 * math.pi), params[1] / np.float32(math.pi)
    # Coordinates are kept positive, so that cutting them off rounds them down.
    middle = half * params[0] + half
    tx, ty, tz = t[0], t[1], t[2]
    across, down = np.empty(w, np.float32), np.empty(w, np.float32)
    for y in range(h):
        for x in range(w):
            d = base[y, x] + offset * step[y, x]
            d = d if d > zero else zero
            a, b, c = turned[y, x, 0] + tx * d, turned[y, x, 1] + ty * d, turned[y, x, 2] + tz * d
            across[x] = _angle(a, c) * per_turn + middle
            down[x] = _angle(np.float32(math.sqrt(a * a + c * c)), -b) * per_half_turn + half
        for x in range(w):
            ui, vi = np.int32(across[x]), np.int32(down[x])
            fu, fv = across[x] - np.float32(ui), down[x] - np.float32(vi)
            left = ui - 1 if ui > 0 else columns - 1
            right = ui if ui < columns else 0
            upper = vi - 1 if vi > 0 else 0
            lower = vi if vi < rows else rows - 1
            above = image[upper, left] + fu * (image[upper, right] - image[upper, left])
            below = image[lower, left] + fu * (image[lower, right] - image[lower, left])
            warped[y, x] = above + min(one, fv) * (below - above)


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
    """`_warp_pinhole` for the unified model."""
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
def _supports(image: Array, radius: int, stride: int, across: Array, edge: float) -> tuple[Array, Array, Array]:
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
                v, u = y + stride * (i // side) - reach, x + across[y] * (i % side - side // 2)
                if v < 0 or u < 0 or v >= h or u >= w:
                    continue
                weight = math.exp(-abs(image[v, u] - image[y, x]) / edge)
                weights[i, y, x] = weight
                total += weight
                mean += weight * image[v, u]
                squares += weight * image[v, u] * image[v, u]
            mean /= total
            for i in range(side * side):
                v, u = y + stride * (i // side) - reach, x + across[y] * (i % side - side // 2)
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
    across: Array,
    margin: int,
    noise: float,
    first: Array,
    second: Array,
    count: Array,
) -> None:
    """Correlation of all windows with the warped pictures (D, h + 2 radius, w + 2 margin) of one source.

    Keeps the best two scores (D, h, w) and counts the sources. The inner loops have no branches, so that the compiler
    can vectorise them; what is not seen is NaN and makes the sums of its window NaN.
    """
    num_planes, h, w = first.shape
    side = 2 * (radius // stride) + 1
    start, left = radius - stride * (radius // stride), margin - side // 2 * across
    sums = np.empty((3, w), np.float32)
    floor, outside = np.float32(noise), np.float32(-2)
    for y in range(h):
        for k in range(num_planes):
            sums[:] = 0
            for i in range(side * side):
                line = warped[k, y + start + stride * (i // side)]
                shift = left[y] + across[y] * (i % side)
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
    across: Array,
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
        sources: (S, h, w) float32 gray images of the same camera, NaN on pixels that must not be used. Those of a
            panorama are as wide as it is, also where the reference goes on beyond its ends.
        rotations: (S, 3, 3) float32 source_from_reference.
        translations: (S, 3) float32.
        model: Code of the camera model.
        params: (5,) float32 index parameters at this resolution.
        radius: Half side of the window.
        stride: Distance between the rows of a window that count.
        across: (h,) int64 distance between the pixels of such a row, by the row of the window's centre: a panorama is
            stretched towards its poles.
        edge: Grey-level difference to the centre that lowers the weight of a pixel by a factor e.
        noise: Variance that is added to both windows'.

    Returns:
        (h, w, D) float32 in 0..2; 1 where no source sees the window.
    """
    h, w = reference.shape
    num_planes, num_sources = len(offsets), len(sources)
    # Grey levels around zero keep the products small for float32.
    level = np.float32(reference.mean())
    weights, products, statistics = _supports(reference - level, radius, stride, across, edge)
    gain = (1 / np.sqrt(statistics[1] + np.float32(noise))).astype(np.float32)
    first = np.full((num_planes, h, w), np.float32(-2), np.float32)
    second = np.full((num_planes, h, w), np.float32(-2), np.float32)
    count = np.zeros((num_planes, h, w), np.uint8)
    turned = np.empty((h, w, 3), np.float32)
    margin = radius // stride * across.max()
    warped = np.zeros((num_planes, h + 2 * radius, w + 2 * margin), np.float32)
    for s in range(num_sources):
        r, t, image = rotations[s], translations[s], sources[s] - level
        for y in range(h):
            for x in range(w):
                for c in range(3):
                    turned[y, x, c] = r[c, 0] * rays[y, x, 0] + r[c, 1] * rays[y, x, 1] + r[c, 2] * rays[y, x, 2]
        for k in range(num_planes):
            inner = warped[k, radius : radius + h, margin : margin + w]
            if model == 0:
                _warp_pinhole(image, turned, t, base, step, offsets[k], params, inner)
            elif model == 2:
                _warp_around(image, turned, t, base, step, offsets[k], params, inner)
            else:
                _warp(image, turned, t, base, step, offsets[k], model, params, inner)
        _correlate(
            weights, products, statistics[0], gain, warped, radius, stride, across, margin, noise, first, second, count
        )
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

    A pixel that lands in the other picture (h', w') is asked there. It is confirmed where the inverse depths differ by
    no more than `tolerance` of the predicted one plus `slack`: one vote, and the ratio of the two. It is hidden where
    the other frame sees something nearer, which is no contradiction.
    """
    h, w = inverse_depth.shape
    rows, columns = other.shape
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
            if model == 2 and ui == columns:
                ui = 0
            if length <= 0 or ui < 0 or vi < 0 or ui >= columns or vi >= rows:
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
