"""Dense matching by DIS optical flow (Kroeger et al., ECCV 2016) with forward-backward and structure weights.

No weights to download, CPU only. The bundle adjustment's current estimate of the flow goes in as the starting point
of the search, the role that the recurrent update has in the paper.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vipe_core.ba.problem import Grid
from vipe_core.priors.classical.features import (
    Array,
    FlowFeatures,
    cell_centres_px,
    cell_mean,
    dense_from_cells,
    fill_cells,
    grid_of,
    larger,
    length_px,
    sample_px,
)
from vipe_core.priors.protocols import Match, WorkingFrame

# A pixel whose forward and backward flows disagree by this much (plus 1 % of the flow) gets exp(-1) of its weight.
_FB_TOLERANCE_PX = 0.6
_FB_TOLERANCE_RATIO = 0.01
_MIN_FB_WEIGHT = 0.02
# Beyond this median displacement (share of the image diagonal) DIS's own pyramid is not trusted to follow a guess.
_WIDE_MOTION_RATIO = 0.1


# A picture of which less than this share of the cells shows structure of this level is blank: what is left is the
# noise of a camera or an encoder, a structure of about 0.2 for each grey level of its standard deviation squared.
_BLANK_SHARE = 0.01
_BLANK_STRUCTURE = 0.5
# A cell of so many times the structure of where it is seen, which has no more than a blank one, is not seen there.
_LOST_RATIO = 20.0


class _Flow:
    """One kind of OpenCV's flow, as a function of its arguments alone.

    An object of OpenCV's that was once given a starting flow keeps it, and searches around it in every later call
    without one, whatever pictures that is about (and beyond its end when they are larger). So calls with and without a
    starting flow have an object each. Both are made anew for another picture size.
    """

    def __init__(self, make: Callable[[], Any]) -> None:
        self._make = make
        self._shape: tuple[int, ...] = ()

    def calc(self, source: Array, target: Array, init: Array | None = None) -> NDArray[np.float32]:
        """(h, w, 2) flow from `source` to `target`, two (h, w) uint8 pictures, with `init` as a candidate."""
        if self._shape != source.shape:
            self._shape = source.shape
            self._free, self._guided = self._make(), self._make()
        return np.asarray((self._free if init is None else self._guided).calc(source, target, init))


def _preset(preset: int) -> _Flow:
    return _Flow(lambda: cv2.DISOpticalFlow.create(preset))


def _motion_only() -> Any:
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
    flow.setFinestScale(1)
    flow.setVariationalRefinementIterations(0)
    return flow


def _unsmoothed() -> Any:
    """Patches at half the picture's size, like the medium preset, but sparser and without its variational refinement:
    where there is structure its error is the same, at a third of the price."""
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)
    flow.setFinestScale(1)
    return flow


class DisFlowMatcher:
    """`DenseMatcher` without a network. One instance per thread: OpenCV's flow object owns its buffers.

    Args:
        fine: `match` refines flow variationally, at three times the price: for those who use it as it is. In the map,
            tracks and patches refine it.
    """

    def __init__(self, *, fine: bool = False) -> None:
        self._both_ways = _preset(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM) if fine else _Flow(_unsmoothed)
        self._fast = _preset(cv2.DISOPTICAL_FLOW_PRESET_FAST)
        self._ultrafast = _preset(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)
        self._half = _Flow(_motion_only)

    def encode(self, frame: WorkingFrame) -> FlowFeatures:
        """Features of a frame; needs at least 16 x 16 pixels."""
        gray = np.ascontiguousarray(frame.gray)
        return FlowFeatures(frame.index, gray, frame.valid, grid_of(gray))

    def is_blank(self, features: FlowFeatures) -> bool:
        """Whether the picture holds nothing to match: black, white, or noise of a grey level or so."""
        usable = features.usable_cells
        strength = features.strength[usable]
        return not len(strength) or float((strength >= _BLANK_STRUCTURE).mean()) < _BLANK_SHARE

    def motion_px(self, source: FlowFeatures, target: FlowFeatures) -> float:
        """Median displacement over textured cells, pixels (the mean would follow moving objects)."""
        cells = source.textured_cells
        if not cells.any():
            return 0.0
        flow = self._half.calc(source.half, target.half)
        points = (cell_centres_px(source.grid) - 0.5) / 2
        return 2 * float(np.median(length_px(sample_px(flow, points[cells]))))

    def match(self, source: FlowFeatures, target: FlowFeatures, guess_px: Array | None = None) -> tuple[Match, Match]:
        """Measurements source -> target and target -> source; see `DenseMatcher.match`."""
        guess = _guessed_cells(source, guess_px)
        forward_init, backward_init = _dense_guess(guess, source), _dense_inverse(guess, source)
        forward = self._refined(self._both_ways, source.gray, target.gray, forward_init)
        backward = self._refined(self._both_ways, target.gray, source.gray, backward_init)
        return _measure(source, target, forward, backward), _measure(target, source, backward, forward)

    def match_fast(self, source: FlowFeatures, target: FlowFeatures, guess_px: Array | None = None) -> Match:
        """One-way measurement; the backward flow of the check is the cheapest preset."""
        init = _dense_guess(_guessed_cells(source, guess_px), source)
        forward = self._refined(self._fast, source.gray, target.gray, init)
        # The check runs at its own cost but must not fail for wide motion: it starts from the inverse of the answer.
        backward = self._ultrafast.calc(
            target.gray, source.gray, _dense_inverse(cell_mean(forward).reshape(-1, 2), source)
        )
        return _measure(source, target, forward, backward)

    def _refined(self, dis: _Flow, source: Array, target: Array, init: Array | None) -> NDArray[np.float32]:
        """(h, w, 2) flow, searched for around `init`."""
        if init is None:
            return dis.calc(source, target)
        height, width = source.shape
        reach = float(np.median(length_px(cell_mean(init))))
        if reach <= _WIDE_MOTION_RATIO * float(np.hypot(height, width)):
            return dis.calc(source, target, np.array(init, np.float32, order="C"))
        # Far from zero, DIS may drop the guess at its coarsest scale. Warp the target by the guess, measure the small
        # residual, and let the flow between the original images (no resampling blur) polish the sum.
        u, v = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
        warped = cv2.remap(
            target, u + init[..., 0], v + init[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        return dis.calc(source, target, np.array(init + self._fast.calc(source, warped), np.float32, order="C"))


def _guessed_cells(source: FlowFeatures, guess_px: Array | None) -> NDArray[np.float32] | None:
    """(P, 2) displacement of every cell from the guess at those that have one; None without a usable guess."""
    if guess_px is None:
        return None
    height, width = source.gray.shape
    displacement = np.asarray(guess_px, np.float64) - cell_centres_px(source.grid)
    # Points that the current geometry puts behind the camera come in as anything at all.
    with np.errstate(invalid="ignore"):
        known = larger(np.abs(displacement)) < width + height
    if not known.any():
        return None
    return fill_cells(np.where(known[:, None], displacement, 0), known, source.grid)


def _dense_guess(cells: Array | None, source: FlowFeatures) -> NDArray[np.float32] | None:
    """Dense starting flow out of displacements of the source's cells."""
    height, width = source.gray.shape
    return None if cells is None else dense_from_cells(cells, source.grid, (height, width))


def _dense_inverse(cells: Array | None, source: FlowFeatures) -> NDArray[np.float32] | None:
    """Dense starting flow of the way back."""
    return None if cells is None else _dense_guess(_inverse_cells(cells, source.grid), source)


def _inverse_cells(displacement: Array, grid: Grid) -> NDArray[np.float32]:
    """(P, 2) displacement target -> source at the target's cells, from source -> target at the source's cells."""
    landing = np.rint((displacement + cell_centres_px(grid) - grid.offset) / grid.stride).astype(np.int64)
    inside = _inside(landing, grid.width, grid.height)
    index = landing[inside, 1] * grid.width + landing[inside, 0]
    count = np.bincount(index, minlength=grid.num_cells)
    mean = np.stack(
        [np.bincount(index, displacement[inside, k], grid.num_cells) / np.maximum(count, 1) for k in (0, 1)], axis=-1
    )
    if not inside.any():
        return np.broadcast_to(-np.median(displacement, axis=0), displacement.shape).astype(np.float32)
    return -fill_cells(mean, count > 0, grid)


def _inside(points: Array, width: int, height: int) -> NDArray[np.bool_]:
    """(P,) which of (P, 2) index coordinates lie on a picture."""
    x, y = points[:, 0], points[:, 1]
    return np.asarray((x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1))


def _measure(source: FlowFeatures, target: FlowFeatures, forward: Array, backward: Array) -> Match:
    """Samples a flow at the source's cells and weighs it by consistency with the reverse flow and by structure."""
    height, width = target.gray.shape
    displacement = cell_mean(forward).reshape(-1, 2)
    target_px = cell_centres_px(source.grid) + displacement
    inside = _inside(target_px, width, height)
    error = length_px(displacement + sample_px(backward, target_px))
    tolerance = _FB_TOLERANCE_PX + _FB_TOLERANCE_RATIO * length_px(displacement)
    agreement = np.exp(-np.square(error / tolerance))
    agreement[agreement < _MIN_FB_WEIGHT] = 0
    usable = inside & source.usable_cells
    if target.usable is not None:
        usable &= sample_px(target.usable.astype(np.float32), target_px) > 0.5
    # Against black, or anything else without structure, every flow agrees with its reverse.
    strength = target.strength.reshape(target.grid.height, target.grid.width)
    seen = sample_px(strength, (target_px - target.grid.offset) / target.grid.stride)
    usable &= (seen >= _BLANK_STRUCTURE) | (source.strength < _LOST_RATIO * seen)
    structure = source.structure / (source.structure + source.structure_floor)
    weight = np.where(usable, agreement, 0)[:, None] * structure
    consistent = float((error[usable] < tolerance[usable]).mean()) if usable.any() else 0.0
    return Match(target_px.astype(np.float32), weight.astype(np.float32), consistent)
