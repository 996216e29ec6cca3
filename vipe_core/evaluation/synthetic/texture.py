"""Procedural textures, filtered to the pixel's footprint.

A texture is a function of metres on the surface. Every octave of noise fades out before its cell falls below the
footprint, and every sharp edge is integrated over the footprint in closed form; nothing shimmers as the camera moves,
and the colour of a surface point depends on the viewpoint only through that filter. `scene.PATTERNS` numbers the
patterns.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from vipe_core.compilation import compiled

_OCTAVES = 11
_PERSISTENCE = 0.86
_COS, _SIN = 0.8, 0.6  # between octaves the noise lattice turns, which hides its axes


@compiled
def _random(x: int, y: int, z: int, seed: int) -> float:
    """A hash of four integers to [0, 1)."""
    h = x * 0x1B873593 + y * 0x19D699A5 + z * 0x2C1B3C6D + seed * 0x297A2D39
    h = (h ^ ((h >> 15) & 0x1FFFFFFFFFFFF)) * 0x2C1B3C6D85EBCA6B
    h = (h ^ ((h >> 29) & 0x7FFFFFFFF)) * 0x297A2D39C2B2AE35
    return ((h >> 32) & 0xFFFFFF) / 16777216.0


@compiled
def _noise2(u: float, v: float, seed: int) -> float:
    """Value noise on the unit lattice, -1..1."""
    fu, fv = math.floor(u), math.floor(v)
    iu, iv = int(fu), int(fv)
    a, b = u - fu, v - fv
    a, b = a * a * (3.0 - 2.0 * a), b * b * (3.0 - 2.0 * b)
    low = _random(iu, iv, 0, seed) * (1.0 - a) + _random(iu + 1, iv, 0, seed) * a
    high = _random(iu, iv + 1, 0, seed) * (1.0 - a) + _random(iu + 1, iv + 1, 0, seed) * a
    return 2.0 * (low * (1.0 - b) + high * b) - 1.0


@compiled
def _noise3(x: float, y: float, z: float, seed: int) -> float:
    fx, fy, fz = math.floor(x), math.floor(y), math.floor(z)
    ix, iy, iz = int(fx), int(fy), int(fz)
    a, b, c = x - fx, y - fy, z - fz
    a, b, c = a * a * (3.0 - 2.0 * a), b * b * (3.0 - 2.0 * b), c * c * (3.0 - 2.0 * c)
    total = 0.0
    for k in range(2):
        low = _random(ix, iy, iz + k, seed) * (1.0 - a) + _random(ix + 1, iy, iz + k, seed) * a
        high = _random(ix, iy + 1, iz + k, seed) * (1.0 - a) + _random(ix + 1, iy + 1, iz + k, seed) * a
        total += (low * (1.0 - b) + high * b) * (c if k == 1 else 1.0 - c)
    return 2.0 * total - 1.0


@compiled
def _fade(cell: float, foot: float) -> float:
    """How much of a feature of size `cell` survives the footprint: 0 below one pixel, 1 above 2.2."""
    return min(1.0, max(0.0, (cell / foot - 1.0) / 1.2))


@compiled
def _fbm2(u: float, v: float, cell: float, foot: float, seed: int) -> float:
    """Band-limited noise, about -1..1: octaves from `cell` down to the footprint."""
    total, amplitude, norm = 0.0, 1.0, 0.0
    for octave in range(_OCTAVES):
        keep = _fade(cell, foot)
        if keep > 0.0:
            total += amplitude * keep * _noise2(u / cell, v / cell, seed + octave)
        # The sum of squares of all octaves, so that contrast does not change with distance.
        norm += amplitude * amplitude
        amplitude *= _PERSISTENCE
        cell *= 0.5
        u, v = _COS * u - _SIN * v + 17.3, _SIN * u + _COS * v - 9.1
    return 1.6 * total / math.sqrt(norm)


@compiled
def _fbm3(x: float, y: float, z: float, cell: float, foot: float, seed: int) -> float:
    total, amplitude, norm = 0.0, 1.0, 0.0
    for octave in range(_OCTAVES):
        keep = _fade(cell, foot)
        if keep > 0.0:
            total += amplitude * keep * _noise3(x / cell, y / cell, z / cell, seed + octave)
        norm += amplitude * amplitude
        amplitude *= _PERSISTENCE
        cell *= 0.5
        x, y, z = _COS * x - _SIN * y + 17.3, _SIN * x + _COS * y - 9.1, z + 5.7
    return 1.6 * total / math.sqrt(norm)


@compiled
def _pulse(x: float, period: float, width: float, foot: float) -> float:
    """Share of [x - foot/2, x + foot/2] that lies in [k period, k period + width] for any integer k."""
    low, high = (x - 0.5 * foot) / period, (x + 0.5 * foot) / period
    duty = width / period
    integral_high = math.floor(high) * duty + min(high - math.floor(high), duty)
    integral_low = math.floor(low) * duty + min(low - math.floor(low), duty)
    return (integral_high - integral_low) * period / foot


@compiled
def _step(signed: float, foot: float) -> float:
    """Share of a footprint on the positive side of an edge at distance `signed`."""
    return min(1.0, max(0.0, signed / foot + 0.5))


@compiled
def _pattern(
    number: int, u: float, v: float, w: float, period: float, foot: float, seed: int
) -> tuple[float, float, float]:
    """(weight of colour 2, weight of colour 3, extra brightness) of a pattern; colour 1 has the rest."""
    p = period
    iu, iv = math.floor(u / p), math.floor(v / p)
    fade = _fade(p, foot)
    if number == 1:  # tiles: a checkerboard of colours 1 and 2, joints in colour 3, each tile with its own tone
        a = 2.0 * _pulse(u, 2.0 * p, p, foot) - 1.0
        b = 2.0 * _pulse(v, 2.0 * p, p, foot) - 1.0
        second = 0.5 + 0.5 * a * b
        joint = max(_pulse(u + 0.02 * p, p, 0.04 * p, foot), _pulse(v + 0.02 * p, p, 0.04 * p, foot))
        return second * (1.0 - joint), joint, 0.16 * (_random(iu, iv, 1, seed) - 0.5) * fade
    if number == 2:  # bricks twice as wide as high, tone between colours 1 and 2, mortar in colour 3
        h = 0.5 * p
        row = math.floor(v / h)
        shifted = u + 0.5 * p * (row % 2)
        column = math.floor(shifted / p)
        mortar = max(_pulse(shifted + 0.035 * p, p, 0.07 * p, foot), _pulse(v + 0.035 * p, h, 0.07 * p, foot))
        keep = _fade(h, foot)
        tone = 0.5 + keep * (_random(column, row, 2, seed) - 0.5)
        return tone * (1.0 - mortar), mortar, 0.22 * keep * (_random(column, row, 3, seed) - 0.5)
    if number == 3:  # planks along u: each with its tone between colours 1 and 2, long grain and dark joints (colour 3)
        length = 7.0 * p
        shifted = u + length * _random(iv, 0, 4, seed)
        column = math.floor(shifted / length)
        joint = max(_pulse(v + 0.02 * p, p, 0.04 * p, foot), _pulse(shifted, length, 0.04 * p, foot))
        grain = _fbm2(0.15 * shifted, v + 3.1 * column, 0.6 * p, foot, seed + 31 * (iv % 64))
        tone = min(1.0, max(0.0, 0.5 + fade * (_random(column, iv, 5, seed) - 0.5) + 0.45 * grain))
        return tone * (1.0 - joint), joint, 0.14 * fade * (_random(column, iv, 6, seed) - 0.5)
    if number == 4:  # wallpaper: stripes of colours 1 and 2 with a diamond of colour 3 in every second stripe
        second = _pulse(u, p, 0.5 * p, foot)
        cu, cv = u - (math.floor(u / p) + 0.25) * p, v / p + 0.5 * (iu % 2)
        cv = (cv - math.floor(cv) - 0.5) * p
        diamond = _step(0.17 * p - abs(cu) - 0.55 * abs(cv), foot) - _step(0.08 * p - abs(cu) - 0.55 * abs(cv), foot)
        diamond *= fade
        return second * (1.0 - diamond), diamond, 0.0
    if number == 5:  # poster: cells with a disc or a quarter circle, colours drawn per cell
        pick, shape = _random(iu, iv, 7, seed), _random(iu, iv, 8, seed)
        cu, cv = u / p - iu, v / p - iv
        if shape < 0.5:
            signed = 0.36 - math.hypot(cu - 0.5, cv - 0.5)
        elif shape < 0.85:
            signed = 0.92 - math.hypot(cu - (1.0 if shape < 0.67 else 0.0), cv - (1.0 if shape < 0.75 else 0.0))
        else:
            signed = (cu - cv) * 0.7071
        inner = _step(signed * p, foot)
        ground = 1 if pick < 0.33 else (2 if pick < 0.66 else 0)
        figure = (ground + (1 if _random(iu, iv, 9, seed) < 0.5 else 2)) % 3
        line = max(_pulse(u + 0.02 * p, p, 0.04 * p, foot), _pulse(v + 0.02 * p, p, 0.04 * p, foot))
        second = (inner if figure == 1 else 0.0) + (1.0 - inner if ground == 1 else 0.0)
        third = (inner if figure == 2 else 0.0) + (1.0 - inner if ground == 2 else 0.0)
        return second * fade, third * fade, -0.5 * line * fade
    if number == 6:  # a row of books: jittered spines with bands, tops of different height, dark board above
        shelf = 7.0 * p
        row = math.floor(v / shelf)
        within = v - row * shelf
        book = iu
        if u / p - iu < 0.35 * _random(iu, row, 10, seed):
            book = iu - 1  # the left neighbour's spine reaches over
        left = (book + 0.35 * _random(book, row, 10, seed)) * p
        right = (book + 1 + 0.35 * _random(book + 1, row, 10, seed)) * p
        height = (0.62 + 0.24 * _random(book, row, 11, seed)) * shelf
        gap = 1.0 - min(_step(u - left - 0.04 * p, foot), _step(right - 0.04 * p - u, foot))
        above = _step(within - height, foot)
        board = 1.0 - _step(within - 0.05 * shelf, foot)
        dark = max(gap, above) * (1.0 - board)
        tone, bright = _random(book, row, 12, seed), _random(book, row, 13, seed)
        band_at = (0.12 + 0.1 * _random(book, row, 14, seed)) * shelf
        band = _step(within - band_at, foot) - _step(within - band_at - 0.4 * p, foot)
        second = (1.0 if tone < 0.4 else (0.5 if tone < 0.6 else 0.0)) * (1.0 - board)
        third = (1.0 if tone > 0.78 else 0.0) * (1.0 - board)
        lift = 0.55 * (bright - 0.5) + 0.28 * band
        return second, third, fade * ((1.0 - dark) * lift * (1.0 - board) - 0.75 * dark)
    if number == 7:  # rug: zigzag bands and lozenges
        tri = abs(u / p - math.floor(u / p) - 0.5)
        second = _pulse(v + tri * p, p, 0.5 * p, foot)
        cu, cv = u / (2.0 * p), v / (2.0 * p)
        cu, cv = abs(cu - math.floor(cu) - 0.5), abs(cv - math.floor(cv) - 0.5)
        third = _step((0.22 - abs(cu + cv - 0.32)) * p, foot) * (1.0 if (iu // 2 + iv // 2) % 2 == 0 else 0.35)
        return second * (1.0 - third), third, 0.0
    if number == 8:  # foliage: leaves of two greens over dark gaps
        a = _fbm3(u, v, w, p, foot, seed + 50)
        b = _fbm3(u, v, w, 0.35 * p, foot, seed + 80)
        second = min(1.0, max(0.0, 0.5 + 1.1 * a))
        third = min(1.0, max(0.0, 0.9 * b - 0.1))
        return second * (1.0 - third), third, 0.22 * b
    if number == 9:  # marble: veins of colour 3 where warped noise crosses zero, clouds of colour 2
        warp = _fbm3(u, v, w, p, foot, seed + 20)
        vein = _noise3(u / p + 1.2 * warp, v / p - warp, w / p + warp, seed + 60)
        third = max(0.0, 1.0 - abs(vein) / max(0.10, 1.5 * foot / p)) * _fade(0.3 * p, foot)
        second = min(1.0, max(0.0, 0.5 + 0.9 * _fbm3(u, v, w, 0.5 * p, foot, seed + 40)))
        return second * (1.0 - third), third, 0.0
    if number == 10:  # ball: six gores about the local z axis, caps of colour 3, spots on every second gore
        radius = math.hypot(u, v)
        turn = (math.atan2(v, u) / (2.0 * math.pi) + 0.5) * 6.0
        second = _pulse(turn, 2.0, 1.0, foot * 6.0 / (2.0 * math.pi * max(radius, 1e-3)))
        latitude = math.atan2(w, max(radius, 1e-9))
        size = math.hypot(radius, w)
        cap = _step((abs(latitude) - 1.05) * size, foot)
        ring = _step((0.10 - abs(abs(latitude) - 0.55)) * size, foot)
        third = max(cap, ring)
        return second * (1.0 - third), third, 0.0
    if number == 11:  # facade: windows with frames in a wall of colour 1; glass of colour 2, frames of colour 3
        h = 1.25 * p
        row = math.floor(v / h)
        cu, cv = u - (iu + 0.5) * p, v - (row + 0.52) * h
        glass = min(_step(0.24 * p - abs(cu), foot), _step(0.30 * h - abs(cv), foot))
        frame = min(_step(0.29 * p - abs(cu), foot), _step(0.35 * h - abs(cv), foot)) - glass
        bars = max(_step(0.018 * p - abs(cu), foot), _step(0.018 * p - abs(cv - 0.08 * h), foot)) * glass
        sill = _step(0.34 * p - abs(cu), foot) * _step(0.03 * h - abs(cv + 0.37 * h), foot)
        third = min(1.0, frame + bars + sill)
        light = (_random(iu, row, 15, seed) - 0.5) * 0.5 + 0.25 * cv / h
        return glass * (1.0 - bars) * fade, third * fade, fade * light * glass
    return 0.0, 0.0, 0.0  # plaster: colour 1 and its grain


@compiled
def shade(
    materials: NDArray[np.float64],
    sky: NDArray[np.float64],
    material: NDArray[np.int64],
    variant: NDArray[np.int64],
    coords: NDArray[np.float64],
    footprint: NDArray[np.float64],
    brightness: NDArray[np.float64],
    rgb: NDArray[np.float32],
) -> None:
    """Colours of R surface samples.

    Args:
        materials: (M, 14) rows of `Material.row`.
        sky: (9,) colours of horizon, zenith, clouds.
        material: (R,) row of `materials`; -1 is the sky, whose `coords` are the unit direction.
        variant: (R,) which face it is, so that equal materials on two faces differ.
        coords: (R, 3) metres.
        footprint: (R,) width of the pixel on the surface, metres; radians for the sky.
        brightness: (R,) factor.
        rgb: Output (R, 3), 0..255, not rounded.
    """
    for i in range(material.shape[0]):
        u, v, w, foot = coords[i, 0], coords[i, 1], coords[i, 2], footprint[i]
        m = material[i]
        if m < 0:
            up = max(w, 0.0)
            mix = math.sqrt(up)
            cloud = 0.0
            if up > 0.02:
                cu, cv = u / (up + 0.12), v / (up + 0.12)
                cloud = _fbm2(cu, cv, 1.2, foot / (up + 0.12), 7) - 0.05
                cloud = min(0.9, max(0.0, 1.3 * cloud)) * min(1.0, 6.0 * (up - 0.02))
            for k in range(3):
                colour = sky[k] * (1.0 - mix) + sky[3 + k] * mix
                rgb[i, k] = 255.0 * (colour * (1.0 - cloud) + sky[6 + k] * cloud)
            continue
        row = materials[m]
        number = int(row[0])
        seed = int(row[4]) * 1009 + variant[i] * 131
        second, third, lift = _pattern(number, u, v, w, row[1], foot, seed)
        if number >= 8 and number <= 10:
            noise = _fbm3(u, v, w, row[3], foot, seed + 500)
        else:
            noise = _fbm2(u, v, row[3], foot, seed + 500)
        factor = brightness[i] * max(0.0, 1.0 + lift) * max(0.05, 1.0 + row[2] * noise)
        for k in range(3):
            colour = row[5 + k] * (1.0 - second - third) + row[8 + k] * second + row[11 + k] * third
            rgb[i, k] = min(255.0, 255.0 * colour * factor)
