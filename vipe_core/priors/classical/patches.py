"""Patch alignment: where a cell is seen in another frame, to a tenth of a pixel, once the geometry is nearly known.

Optical flow is smooth by construction, and that bends it: its error is the same for whole regions of the picture, so
that no number of cells averages it away. Here each cell stands alone. A small patch round it is aligned to the target
by Lucas-Kanade (inverse compositional; Baker and Matthews, IJCV 2004), warped by the local affine map of the flow that
poses and depths predict, so that perspective does not pull at it. Brightness may change by a gain and an offset.
"""

from __future__ import annotations

from collections import OrderedDict

import cv2
import numpy as np
from numpy.typing import NDArray

from vipe_core.ba.problem import Grid
from vipe_core.compilation import vectorised
from vipe_core.priors.classical.features import STRIDE, Array, FlowFeatures, larger, length_px, sample_px
from vipe_core.priors.protocols import Match

_RADIUS_PX = 8
_BLUR_PX = 0.8
_MAX_ITERATIONS = 8
_ENOUGH_PX = 0.05
# Differences of the target position between neighbouring cells that disagree by more than this (per pixel) lie on two
# surfaces: the side that distorts less is taken.
_SAME_SURFACE = 0.15
# Variance of the noise of a picture that even a perfect alignment leaves, squared grey levels, and the ratio of the
# two parts of an alignment's variance; see `_certainty`.
_MIN_NOISE = 1.0
_NOISE_TO_FLOOR = 5.0
_LEAST_CERTAINTY = 0.02
# Share of a patch's own variance that may be left before the alignment is worth nothing.
_MAX_LEFT = 0.5


def _pattern() -> NDArray[np.int32]:
    """(N, 2) offsets (x, y) of the samples of a patch: every other pixel, as on a chessboard.

    The picture is blurred before, so that the pixels left out hold next to nothing of their own.
    """
    y, x = np.mgrid[1 - _RADIUS_PX : 1 + _RADIUS_PX, 1 - _RADIUS_PX : 1 + _RADIUS_PX]
    kept = (x + y) % 2 == 0
    return np.stack([x[kept], y[kept]], axis=-1).astype(np.int32)


_PATTERN = _pattern()


def local_affine(target_px: Array, grid: Grid) -> NDArray[np.float32]:
    """(P, 4) derivative (du/dx, du/dy, dv/dx, dv/dy) of the target position with the source position, per cell.

    Args:
        target_px: (P, 2); NaN gives NaN around it.
    """
    field = np.asarray(target_px, np.float32).reshape(grid.height, grid.width, 2)
    columns = []
    for axis, unit in ((1, (1.0, 0.0)), (0, (0.0, 1.0))):
        step = np.diff(field, axis=axis) / grid.stride
        if step.shape[axis] == 0:
            columns.append(np.broadcast_to(np.array(unit), field.shape))
            continue
        first, last = np.take(step, [0], axis), np.take(step, [-1], axis)
        before, after = np.concatenate([first, step], axis), np.concatenate([step, last], axis)
        with np.errstate(invalid="ignore", over="ignore"):
            same = length_px(before - after) < _SAME_SURFACE
            calmer = length_px(before - unit) <= length_px(after - unit)
        columns.append(np.where(same[..., None], 0.5 * (before + after), np.where(calmer[..., None], before, after)))
    return np.stack(columns, axis=-1).reshape(-1, 4).astype(np.float32)


class PatchAligner:
    """`Aligner` on the features of `DisFlowMatcher`. One instance per thread: it keeps the last few pictures.

    Args:
        max_shift_px: A patch that ends farther than this from the guess is lost.
        weight: Inverse variance of a perfect alignment, 1/px^2, relative to 1 for a perfect flow measurement.
        kept: Blurred pictures that are kept for the next call.
    """

    def __init__(self, max_shift_px: float = 3.0, weight: float = 4.0, kept: int = 8) -> None:
        self._max_shift_px = max_shift_px
        self._weight = weight
        self._kept = kept
        self._pictures: OrderedDict[int, tuple[FlowFeatures, NDArray[np.float32]]] = OrderedDict()

    def align(self, source: FlowFeatures, target: FlowFeatures, guess_px: Array, wanted: Array) -> Match:
        """See `Aligner.align`."""
        target_px, information, residual = self._aligned(source, target, guess_px, wanted)
        found = information[:, 0] + information[:, 2] > 0
        if target.usable is not None:
            found &= sample_px(target.usable.astype(np.float32), target_px) > 0.5
        weight = np.where(found[:, None], self._weight * _certainty(information, residual), 0)
        looked = np.flatnonzero(source.textured_cells & wanted & np.isfinite(guess_px[:, 0] + guess_px[:, 1]))
        consistent = float((larger(weight)[looked] > 0).mean()) if len(looked) else 0.0
        return Match(target_px, weight.astype(np.float32), consistent)

    def _aligned(
        self, source: FlowFeatures, target: FlowFeatures, guess_px: Array, wanted: Array
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """Target positions (the guess where there is no alignment), (P, 3) mean of (gx gx, gx gy, gy gy) over the
        patches in target coordinates, and (P, 2) mean square of what is left and of the patch about its mean."""
        grid = source.grid
        affine = local_affine(guess_px, grid)
        wanted = wanted & source.usable_cells & np.isfinite(guess_px[:, 0] + guess_px[:, 1])
        for column in affine.T:
            wanted &= np.isfinite(column)
        start = np.where(wanted[:, None], guess_px, 0).astype(np.float32)
        y, x = np.mgrid[: grid.height, : grid.width].astype(np.int32) * STRIDE + (STRIDE // 2 - 1)
        target_px = np.nan_to_num(np.asarray(guess_px, np.float32))
        information = np.zeros((grid.num_cells, 3), np.float32)
        residual = np.zeros((grid.num_cells, 2), np.float32)
        _align(
            self._picture(source),
            self._picture(target),
            x.reshape(-1),
            y.reshape(-1),
            start,
            affine,
            wanted,
            _PATTERN,
            _MAX_ITERATIONS,
            self._max_shift_px,
            _MIN_NOISE * _NOISE_TO_FLOOR * _LEAST_CERTAINTY,
            target_px,
            information,
            residual,
        )
        return target_px, information, residual

    def _picture(self, features: FlowFeatures) -> NDArray[np.float32]:
        """(h, w) blurred float picture that patches are read from."""
        held = self._pictures.pop(features.index, None)
        if held is None or held[0] is not features:
            blurred = cv2.GaussianBlur(features.gray.astype(np.float32), (0, 0), _BLUR_PX)
            held = features, np.asarray(blurred, np.float32)
        self._pictures[features.index] = held
        while len(self._pictures) > self._kept:
            self._pictures.popitem(last=False)
        return held[1]


def _certainty(information: NDArray[np.float32], residual: NDArray[np.float32]) -> NDArray[np.float64]:
    """(P, 2) inverse variance of u and v, 1 at best.

    The variance of an alignment is that of the noise times the inverse of the structure (Lucas-Kanade is least
    squares), and a part that more texture does not remove. Both were measured on rendered video after H.264: about
    (0.2 s)^2 + (0.09 px)^2, with s from the mean structure of the patch.
    """
    gxx, gxy, gyy = information.astype(np.float64).T
    determinant = np.maximum(gxx * gyy - gxy * gxy, 1e-9)
    noise = residual[:, 0] + _MIN_NOISE
    certainty = 1 / (1 + _NOISE_TO_FLOOR * noise[:, None] * np.stack([gyy, gxx], axis=-1) / determinant[:, None])
    # What is left must be small beside the patch itself, or something else is seen there.
    explained = np.clip(1 - residual[:, 0] / (_MAX_LEFT * np.maximum(residual[:, 1], 1e-6)), 0, 1)
    return np.asarray(certainty * explained[:, None])


@vectorised
def _align(
    source: Array,
    target: Array,
    cell_x: Array,
    cell_y: Array,
    start: Array,
    affine: Array,
    wanted: Array,
    pattern: Array,
    iterations: int,
    max_shift: float,
    least: float,
    target_px: Array,
    information: Array,
    residual: Array,
) -> None:
    height, width = source.shape
    target_height, target_width = target.shape
    count = len(pattern)
    zero, half, one = np.float32(0), np.float32(0.5), np.float32(1)
    share = one / np.float32(count)
    # Keeps the gain of a flat patch near one: a hundredth of a squared grey level is rounding.
    flat = np.float32(0.01) * np.float32(count)
    template, gx, gy = np.empty(count, np.float32), np.empty(count, np.float32), np.empty(count, np.float32)
    seen, u, v = np.empty(count, np.float32), np.empty(count, np.float32), np.empty(count, np.float32)
    low, high = pattern[:, 0].min(), pattern[:, 0].max()
    for cell in range(len(cell_x)):
        x0, y0 = cell_x[cell], cell_y[cell]
        if not wanted[cell] or x0 + low < 1 or y0 + low < 1 or x0 + high >= width - 1 or y0 + high >= height - 1:
            continue
        a, b, c, d = affine[cell, 0], affine[cell, 1], affine[cell, 2], affine[cell, 3]
        determinant = a * d - b * c
        if not (determinant > np.float32(0.2) and determinant < np.float32(5)):
            continue
        mean, mean_x, mean_y = zero, zero, zero
        for k in range(count):
            x, y = x0 + pattern[k, 0], y0 + pattern[k, 1]
            template[k] = source[y, x]
            gx[k] = half * (source[y, x + 1] - source[y, x - 1])
            gy[k] = half * (source[y + 1, x] - source[y - 1, x])
            mean += template[k]
            mean_x += gx[k]
            mean_y += gy[k]
        mean, mean_x, mean_y = mean * share, mean_x * share, mean_y * share
        hxx, hxy, hyy, variance = zero, zero, zero, zero
        for k in range(count):
            # The gradient in target coordinates is the inverse transpose of the affine map times the source's.
            p, q = gx[k] - mean_x, gy[k] - mean_y
            gx[k] = (p * d - q * c) / determinant
            gy[k] = (q * a - p * b) / determinant
            template[k] -= mean
            hxx += gx[k] * gx[k]
            hxy += gx[k] * gy[k]
            hyy += gy[k] * gy[k]
            variance += template[k] * template[k]
        definite = hxx * hyy - hxy * hxy
        # At the least noise there is, neither component could be sure enough to matter.
        if not definite * share > np.float32(least) * min(hxx, hyy):
            continue
        reach = np.float32(-low + 1) * (abs(a) + abs(b)) + one
        reach_y = np.float32(-low + 1) * (abs(c) + abs(d)) + one
        x, y = start[cell, 0], start[cell, 1]
        lost, left = False, zero
        for _ in range(iterations):
            if not (x > reach and y > reach_y and x < target_width - 1 - reach and y < target_height - 1 - reach_y):
                lost = True
                break
            for k in range(count):
                dx, dy = np.float32(pattern[k, 0]) - half, np.float32(pattern[k, 1]) - half
                u[k] = x + a * dx + b * dy
                v[k] = y + c * dx + d * dy
            mean = zero
            for k in range(count):
                column, row = int(u[k]), int(v[k])
                fx, fy = u[k] - np.float32(column), v[k] - np.float32(row)
                upper = target[row, column] + fx * (target[row, column + 1] - target[row, column])
                lower = target[row + 1, column] + fx * (target[row + 1, column + 1] - target[row + 1, column])
                seen[k] = upper + fy * (lower - upper)
                mean += seen[k]
            mean *= share
            spread = zero
            for k in range(count):
                seen[k] -= mean
                spread += seen[k] * seen[k]
            gain = np.sqrt((variance + flat) / (spread + flat))
            if not (gain > half and gain < np.float32(2)):
                lost = True
                break
            bx, by, left = zero, zero, zero
            for k in range(count):
                error = template[k] - gain * seen[k]
                bx += gx[k] * error
                by += gy[k] * error
                left += error * error
            step_x, step_y = (hyy * bx - hxy * by) / definite, (hxx * by - hxy * bx) / definite
            x += step_x
            y += step_y
            if not (abs(x - start[cell, 0]) <= max_shift and abs(y - start[cell, 1]) <= max_shift):
                lost = True
                break
            if step_x * step_x + step_y * step_y < np.float32(_ENOUGH_PX * _ENOUGH_PX):
                break
        if lost:
            continue
        target_px[cell, 0], target_px[cell, 1] = x, y
        information[cell, 0], information[cell, 1], information[cell, 2] = hxx * share, hxy * share, hyy * share
        residual[cell, 0], residual[cell, 1] = left * share, variance * share
