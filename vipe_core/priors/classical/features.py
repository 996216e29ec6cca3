"""What the classical matchers keep of a frame, and the small dense-field operations that they share."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vipe_core.ba.problem import Grid
from vipe_core.priors.classical.keypoints import Keypoints, detect

Array = NDArray[Any]

STRIDE = 8
"""Working pixels per grid cell. Cell (y, x) samples index coordinates (8x + 3.5, 8y + 3.5)."""

_STRUCTURE_BOX_PX = 13
_KEYPOINT_AREA_PX = 320 * 240
_MAX_CORNERS = 1000
_CORNER_TERMINATION = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.01)
_MASK_MARGIN_PX = 4
# What Scharr's integer kernel makes of a slope of one grey level per pixel.
_SCHARR_GAIN = 32


@dataclass(frozen=True)
class FlowFeatures:
    """A working frame, ready to be matched. Derived arrays are computed when first asked for and then kept.

    Attributes:
        index: Frame index in the video.
        gray: (h, w) uint8.
        valid: (h, w) bool, False on pixels that must not be used, or None.
        grid: Cells of the frame.
    """

    index: int
    gray: NDArray[np.uint8]
    valid: NDArray[np.bool_] | None
    grid: Grid

    @cached_property
    def half(self) -> NDArray[np.uint8]:
        """(h/2, w/2) uint8, area-averaged."""
        height, width = self.gray.shape
        return np.asarray(cv2.resize(self.gray, (width // 2, height // 2), interpolation=cv2.INTER_AREA))

    @cached_property
    def structure(self) -> NDArray[np.float32]:
        """(P, 2) squared gradient per component, (grey levels / px)^2, averaged over a box of about 12 px per cell."""
        gx, gy = cv2.Scharr(self.gray, cv2.CV_16S, 1, 0), cv2.Scharr(self.gray, cv2.CV_16S, 0, 1)
        box = (_STRUCTURE_BOX_PX, _STRUCTURE_BOX_PX)
        squares = [cell_mean(cv2.sqrBoxFilter(g, cv2.CV_32F, box)).reshape(-1) for g in (gx, gy)]
        return np.stack(squares, axis=-1) / np.float32(_SCHARR_GAIN**2)

    @cached_property
    def strength(self) -> NDArray[np.float32]:
        """(P,) structure of the component that has more of it."""
        return larger(self.structure)

    @cached_property
    def usable(self) -> NDArray[np.bool_] | None:
        """(h, w) bool: `valid` shrunk by a few pixels, because flow bleeds over the border of a mask."""
        if self.valid is None or bool(self.valid.all()):
            return None
        kernel = np.ones((2 * _MASK_MARGIN_PX + 1,) * 2, np.uint8)
        return np.asarray(cv2.erode(self.valid.astype(np.uint8), kernel)).astype(bool)

    @cached_property
    def usable_cells(self) -> NDArray[np.bool_]:
        """(P,) bool: cells whose sample point may be used."""
        if self.usable is None:
            return np.ones(self.grid.num_cells, bool)
        return np.asarray(cell_mean(self.usable.astype(np.float32)).reshape(-1) > 0.99)

    @cached_property
    def textured_cells(self) -> NDArray[np.bool_]:
        """(P,) bool: usable cells with texture.

        The bar is the smaller of a fixed level and a quantile of the frame itself, so that a frame of blank walls
        still votes with its best cells.
        """
        strength = self.strength
        usable = self.usable_cells
        if not usable.any():
            return usable
        return np.asarray(usable & (strength >= min(4.0, float(np.quantile(strength[usable], 0.7)))))

    @cached_property
    def corners_px(self) -> NDArray[np.float32]:
        """(n, 2) index coordinates of at most 1000 corners to a fraction of a pixel, at least a cell apart."""
        mask = None if self.usable is None else self.usable.astype(np.uint8)
        found = cv2.goodFeaturesToTrack(self.gray, _MAX_CORNERS, 0.003, STRIDE, mask=mask, blockSize=5)
        if found is None:
            return np.zeros((0, 2), np.float32)
        refined = cv2.cornerSubPix(self.gray, found, (3, 3), (-1, -1), _CORNER_TERMINATION)
        return np.asarray(refined.reshape(-1, 2), np.float32)

    @cached_property
    def structure_floor(self) -> float:
        """The structure at which a cell has half of the full weight; lower in frames with little texture."""
        usable = self.usable_cells
        if not usable.any():
            return 9.0
        return float(np.clip(np.quantile(self.strength[usable], 0.6), 1.0, 9.0))

    @cached_property
    def keypoints(self) -> Keypoints:
        """Local features, of a smaller picture where this one is large: the finest ones are most of the price."""
        height, width = self.gray.shape
        shrink = min(1.0, math.sqrt(_KEYPOINT_AREA_PX / (height * width)))
        size = (round(shrink * width), round(shrink * height))
        gray = np.asarray(cv2.resize(self.gray, size, interpolation=cv2.INTER_AREA))
        usable = self.usable
        if usable is not None:
            usable = cv2.resize(usable.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST).astype(np.bool_)
        found = detect(gray, usable)
        scale = np.array([width / size[0], height / size[1]], np.float32)
        return Keypoints((found.points_px + np.float32(0.5)) * scale - np.float32(0.5), found.descriptors)


def grid_of(gray: Array) -> Grid:
    """The grid of a working image: one cell per full 8 x 8 block."""
    height, width = gray.shape
    return Grid(height // STRIDE, width // STRIDE, float(STRIDE), (STRIDE - 1) / 2)


def larger(pairs: Array) -> Array:
    """(...) the larger of the two components of (..., 2): many times faster than a maximum over so short an axis."""
    return np.asarray(np.maximum(pairs[..., 0], pairs[..., 1]))


def length_px(vectors: Array) -> Array:
    """(...) lengths of (..., 2), for the same reason."""
    return np.asarray(np.sqrt(np.square(vectors[..., 0]) + np.square(vectors[..., 1])))


def cell_mean(field: Array) -> NDArray[np.float32]:
    """Samples (h, w[, c]) at the cell centres: mean of the four central pixels, never of the whole cell."""
    lo = STRIDE // 2 - 1
    rows, cols = field.shape[0] // STRIDE * STRIDE, field.shape[1] // STRIDE * STRIDE
    f = field[:rows, :cols]
    a, b = slice(lo, None, STRIDE), slice(lo + 1, None, STRIDE)
    return np.asarray(0.25 * (f[a, a] + f[a, b] + f[b, a] + f[b, b]), np.float32)


def cell_centres_px(grid: Grid) -> NDArray[np.float32]:
    """(P, 2) index coordinates (u, v) of the cells, row-major."""
    v, u = np.mgrid[: grid.height, : grid.width].astype(np.float32) * grid.stride + grid.offset
    return np.stack((u.reshape(-1), v.reshape(-1)), axis=-1)


def sample_px(field: Array, points_px: Array) -> NDArray[np.float32]:
    """Bilinear samples of (h, w[, c]) at (N, 2) index coordinates; coordinates outside take the border's value."""
    points = np.ascontiguousarray(points_px, np.float32)[:, None]
    # cv2.remap keeps its coordinates in 16 bits: rows go in as blocks that stay below.
    blocks = [
        cv2.remap(field, points[k : k + 30000], None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        for k in range(0, len(points), 30000)
    ]
    out = np.concatenate(blocks)[:, 0] if blocks else np.zeros((0, *field.shape[2:]), field.dtype)
    return np.asarray(out, np.float32)


def dense_from_cells(cells: Array, grid: Grid, shape: tuple[int, int]) -> NDArray[np.float32]:
    """Bilinear (h, w, c) field from (P, c) values at the cell centres; constant beyond the outermost centres."""
    height, width = shape
    low = np.ascontiguousarray(cells, np.float32).reshape(grid.height, grid.width, -1)
    rows, cols = grid.height * STRIDE, grid.width * STRIDE
    full = cv2.resize(low, (cols, rows), interpolation=cv2.INTER_LINEAR).reshape(rows, cols, -1)
    if (rows, cols) != shape:
        full = cv2.copyMakeBorder(full, 0, height - rows, 0, width - cols, cv2.BORDER_REPLICATE)
    return np.ascontiguousarray(full, np.float32).reshape(height, width, -1)


def fill_cells(values: Array, known: Array, grid: Grid) -> NDArray[np.float32]:
    """(P, c) with unknown cells filled from known ones nearby (normalised Gaussian blur at two widths)."""
    if known.all():
        return np.asarray(values, np.float32)
    v = np.where(known[:, None], values, 0).astype(np.float32).reshape(grid.height, grid.width, -1)
    k = known.astype(np.float32).reshape(grid.height, grid.width)
    out = np.empty_like(v)
    median = np.median(values[known], axis=0) if known.any() else np.zeros(v.shape[-1])
    out[:] = median
    for sigma in (6.0, 1.5):
        weight = cv2.GaussianBlur(k, (0, 0), sigma)
        blurred = cv2.GaussianBlur(v, (0, 0), sigma).reshape(v.shape)
        out = np.where(weight[..., None] > 0.05, blurred / np.maximum(weight, 1e-6)[..., None], out)
    return np.where(known[:, None], values, out.reshape(len(values), -1)).astype(np.float32)
