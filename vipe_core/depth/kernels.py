"""Compiled loops of the plane sweep: warping, correlation, semi-global aggregation, consistency, upsampling.

All geometry is written in inverse depth along the ray of the camera model: a pixel with ray r and inverse depth d is
seen by another camera in direction R r + d t, with no division by d, so d = 0 (infinity) is an ordinary value.

Numba's cache notices changes of the file of a function only, so what calls each other lives here together.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vipe_core.compilation import compiled

Array = NDArray[Any]

MODEL_CODE = {"pinhole": 0, "mei": 1, "equirect": 2}

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
def _window_statistics(image: Array, radius: int) -> tuple[Array, Array]:
    """Mean and variance of the clipped box around every pixel."""
    h, w = image.shape
    mean, variance = np.empty((h, w), np.float32), np.empty((h, w), np.float32)
    for y in range(h):
        for x in range(w):
            y0, y1, x0, x1 = max(0, y - radius), min(h, y + radius + 1), max(0, x - radius), min(w, x + radius + 1)
            total, squares = 0.0, 0.0
            for v in range(y0, y1):
                for u in range(x0, x1):
                    total += image[v, u]
                    squares += image[v, u] * image[v, u]
            n = (y1 - y0) * (x1 - x0)
            mean[y, x] = total / n
            variance[y, x] = max(0.0, squares / n - (total / n) ** 2)
    return mean, variance


@compiled
def _warp_pinhole(
    image: Array, turned: Array, t: Array, base: Array, offset: float, params: Array, warped: Array, seen: Array
) -> None:
    """Samples `image` at every pixel for the inverse depths `base + offset`, all in float32 for speed."""
    h, w = base.shape
    fx, fy, cx, cy = params[0], params[1], params[2], params[3]
    tx, ty, tz = t[0], t[1], t[2]
    zero, one, tiny = np.float32(0), np.float32(1), np.float32(1e-6)
    right, bottom = np.float32(w - 1), np.float32(h - 1)
    for y in range(h):
        for x in range(w):
            d = max(zero, base[y, x] + offset)
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
                    seen[y, x] = one
                    continue
            warped[y, x] = zero
            seen[y, x] = zero


@compiled
def _warp(
    image: Array,
    turned: Array,
    t: Array,
    base: Array,
    offset: float,
    model: int,
    params: Array,
    warped: Array,
    seen: Array,
) -> None:
    """`_warp_pinhole` for any camera model."""
    h, w = base.shape
    for y in range(h):
        for x in range(w):
            d = max(np.float32(0), base[y, x] + offset)
            u, v, length = _project(
                model, params, turned[y, x, 0] + t[0] * d, turned[y, x, 1] + t[1] * d, turned[y, x, 2] + t[2] * d
            )
            if length > 0 and u >= 0 and v >= 0 and u <= w - 1 and v <= h - 1:
                ui, vi = min(int(u), w - 2), min(int(v), h - 2)
                fu, fv = np.float32(u - ui), np.float32(v - vi)
                upper = image[vi, ui] + fu * (image[vi, ui + 1] - image[vi, ui])
                lower = image[vi + 1, ui] + fu * (image[vi + 1, ui + 1] - image[vi + 1, ui])
                warped[y, x] = upper + fv * (lower - upper)
                seen[y, x] = 1
            else:
                warped[y, x] = 0
                seen[y, x] = 0


@compiled
def _correlate(
    reference: Array,
    mean: Array,
    gain: Array,
    warped: Array,
    seen: Array,
    radius: int,
    noise: float,
    first: Array,
    second: Array,
    count: Array,
) -> None:
    """Correlation of all windows with the warped image; keeps the best two scores and counts the sources.

    Column sums move down one row at a time; row sums are differences of prefix sums. The last loop has no branches, so
    that the compiler can vectorise its root and its division.
    """
    h, w = reference.shape
    col = np.zeros((4, w), np.float64)
    prefix = np.zeros((4, w + 2 * radius + 2), np.float64)
    one, outside, floor = np.float32(1), np.float32(-2), np.float32(noise)
    for y in range(-radius, h):
        enter, leave = y + radius, y - radius - 1
        if enter < h:
            for x in range(w):
                j = warped[enter, x]
                col[0, x] += j
                col[1, x] += j * j
                col[2, x] += j * reference[enter, x]
                col[3, x] += seen[enter, x]
        if leave >= 0:
            for x in range(w):
                j = warped[leave, x]
                col[0, x] -= j
                col[1, x] -= j * j
                col[2, x] -= j * reference[leave, x]
                col[3, x] -= seen[leave, x]
        if y < 0:
            continue
        # prefix[x + radius + 1] is the sum of columns 0..x, flat on both sides.
        s0, s1, s2, s3 = 0.0, 0.0, 0.0, 0.0
        for x in range(w):
            s0, s1, s2, s3 = s0 + col[0, x], s1 + col[1, x], s2 + col[2, x], s3 + col[3, x]
            i = x + radius + 1
            prefix[0, i], prefix[1, i], prefix[2, i], prefix[3, i] = s0, s1, s2, s3
        for i in range(w + radius + 1, w + 2 * radius + 2):
            prefix[0, i], prefix[1, i], prefix[2, i], prefix[3, i] = s0, s1, s2, s3
        rows = min(h, enter + 1) - max(0, leave + 1)
        for x in range(w):
            n = np.float32(rows * (min(w, x + radius + 1) - max(0, x - radius)))
            share = one / n
            i = x + 2 * radius + 1
            mj = np.float32(prefix[0, i] - prefix[0, x]) * share
            jj = np.float32(prefix[1, i] - prefix[1, x]) * share
            ij = np.float32(prefix[2, i] - prefix[2, x]) * share
            whole = np.float32(prefix[3, i] - prefix[3, x]) > n - np.float32(0.5)
            spread = max(np.float32(0), jj - mj * mj) + floor
            value = (ij - mj * mean[y, x]) * gain[y, x] / np.float32(math.sqrt(spread))
            score = value if whole else outside
            best = first[y, x]
            second[y, x] = max(second[y, x], min(best, score))
            first[y, x] = max(best, score)
            count[y, x] += np.uint8(whole)


@compiled
def sweep_cost(
    reference: Array,
    rays: Array,
    base: Array,
    offsets: Array,
    sources: Array,
    rotations: Array,
    translations: Array,
    model: int,
    params: Array,
    radius: int,
    noise: float,
) -> Array:
    """Matching cost of every pixel for the inverse depths `base + offsets[k]`.

    The cost is 1 minus the zero-mean normalised cross-correlation, averaged over the better half of the sources that
    see the window: what is hidden in one direction is usually visible in another.

    Args:
        reference: (h, w) float32 gray.
        rays: (h, w, 3) float32 rays of its pixels.
        base: (h, w) float32.
        offsets: (D,) float32.
        sources: (S, h, w) float32 gray images of the same camera.
        rotations: (S, 3, 3) float32 source_from_reference.
        translations: (S, 3) float32.
        model: Code of the camera model.
        params: (5,) float32 index parameters at this resolution.
        radius: Half side of the window.
        noise: Variance that is added to both windows'.

    Returns:
        (h, w, D) float32 in 0..2; 1 where no source sees the window.
    """
    h, w = reference.shape
    num_planes, num_sources = len(offsets), len(sources)
    # Grey levels around zero keep the products small for float32.
    level = np.float32(reference.mean())
    centred = reference - level
    mean, variance = _window_statistics(centred, radius)
    gain = (1 / np.sqrt(variance + np.float32(noise))).astype(np.float32)
    first = np.full((num_planes, h, w), np.float32(-2), np.float32)
    second = np.full((num_planes, h, w), np.float32(-2), np.float32)
    count = np.zeros((num_planes, h, w), np.uint8)
    turned = np.empty((h, w, 3), np.float32)
    warped, seen = np.empty((h, w), np.float32), np.empty((h, w), np.float32)
    for s in range(num_sources):
        r, t, image = rotations[s], translations[s], sources[s] - level
        for y in range(h):
            for x in range(w):
                for c in range(3):
                    turned[y, x, c] = r[c, 0] * rays[y, x, 0] + r[c, 1] * rays[y, x, 1] + r[c, 2] * rays[y, x, 2]
        for k in range(num_planes):
            if model == 0:
                _warp_pinhole(image, turned, t, base, offsets[k], params, warped, seen)
            else:
                _warp(image, turned, t, base, offsets[k], model, params, warped, seen)
            _correlate(centred, mean, gain, warped, seen, radius, noise, first[k], second[k], count[k])
    cost = np.empty((h, w, num_planes), np.float32)
    half = np.float32(0.5)
    for y in range(h):
        for k in range(num_planes):
            for x in range(w):
                if count[k, y, x] == 0:
                    cost[y, x, k] = _FAR_COST
                elif count[k, y, x] <= 2:
                    cost[y, x, k] = 1 - first[k, y, x]
                else:
                    cost[y, x, k] = 1 - half * (first[k, y, x] + second[k, y, x])
    return cost


@compiled
def add_prior(cost: Array, position: Array, confidence: Array, gain: float, reach: float) -> None:
    """Adds a truncated cost of leaving plane `position` (h, w), in place; `confidence` (h, w) scales it."""
    h, w, num_planes = cost.shape
    for y in range(h):
        for x in range(w):
            if confidence[y, x] > 0:
                scale = np.float32(gain * confidence[y, x])
                for k in range(num_planes):
                    away = abs(k - position[y, x]) / reach
                    cost[y, x, k] += scale * np.float32(min(1.0, away))


@compiled
def _pass(
    cost: Array, gray: Array, total: Array, small: float, large: float, edge: float, vertical: bool, backward: bool
) -> None:
    """One direction of the aggregation."""
    h, w, n = cost.shape
    lines, length = (w, h) if vertical else (h, w)
    far = np.float32(1e9)
    p1 = np.float32(small)
    previous, current = np.full(n + 2, far, np.float32), np.full(n + 2, far, np.float32)
    for line in range(lines):
        lowest = np.float32(0)
        last_gray = np.float32(0)
        for step in range(length):
            i = length - 1 - step if backward else step
            y, x = (i, line) if vertical else (line, i)
            value = gray[y, x]
            smallest = far
            if step == 0:
                for k in range(n):
                    current[k + 1] = cost[y, x, k]
                    smallest = min(smallest, current[k + 1])
            else:
                p2 = np.float32(max(2 * small, large * math.exp(-abs(value - last_gray) / edge)))
                jump = lowest + p2
                for k in range(n):
                    best = min(min(previous[k + 1], previous[k] + p1), min(previous[k + 2] + p1, jump))
                    current[k + 1] = cost[y, x, k] + best - lowest
                for k in range(n):
                    smallest = min(smallest, current[k + 1])
            for k in range(n):
                total[y, x, k] += current[k + 1]
            previous, current = current, previous
            lowest, last_gray = smallest, value


@compiled
def aggregate(cost: Array, gray: Array, small: float, large: float, edge: float) -> Array:
    """Semi-global aggregation along four directions (Hirschmueller 2008, equation 13): (h, w, D) float32."""
    total = np.zeros_like(cost)
    _pass(cost, gray, total, small, large, edge, False, False)
    _pass(cost, gray, total, small, large, edge, False, True)
    _pass(cost, gray, total, small, large, edge, True, False)
    _pass(cost, gray, total, small, large, edge, True, True)
    return total


@compiled
def winner(total: Array, cost: Array) -> tuple[Array, Array]:
    """Position of the lowest aggregated cost with a parabola through its neighbours, and the raw cost there."""
    h, w, n = total.shape
    position, raw = np.empty((h, w), np.float32), np.empty((h, w), np.float32)
    for y in range(h):
        for x in range(w):
            best = 0
            for k in range(1, n):
                if total[y, x, k] < total[y, x, best]:
                    best = k
            offset = 0.0
            if 0 < best < n - 1:
                before, here, after = total[y, x, best - 1], total[y, x, best], total[y, x, best + 1]
                bend = before - 2 * here + after
                if bend > 1e-9:
                    offset = max(-0.5, min(0.5, 0.5 * (before - after) / bend))
            position[y, x] = best + offset
            raw[y, x] = cost[y, x, best]
    return position, raw


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
    votes: Array,
    ratios: Array,
) -> None:
    """Where another frame's depth map confirms this one; adds to `votes` and `ratios` (h, w) in place.

    A confirmed pixel gets one vote and the ratio of the other frame's inverse depth to the predicted one.
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
            predicted = d / length
            ratio = other[vi, ui] / max(predicted, 1e-12)
            if abs(ratio - 1) < tolerance:
                votes[y, x] += 1
                ratios[y, x] += ratio


@compiled
def upsample(
    inverse_depth: Array, confidence: Array, gray: Array, full_gray: Array, edge: float, same: float
) -> tuple[Array, Array]:
    """Depth (not inverse) and confidence at the size of `full_gray`, following its edges.

    Each pixel looks at the four low-resolution samples around it, weighs them by distance and by grey-level difference,
    and averages those that lie on the surface of the heaviest one: no values between foreground and background.

    Args:
        inverse_depth, confidence, gray: (h, w) float32.
        full_gray: (H, W) uint8.
        edge: Grey-level difference that lowers a weight by a factor e.
        same: Relative difference in inverse depth within which two samples are one surface.
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
                xx = min(max(u0 + i % 2, 0), w - 1)
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
