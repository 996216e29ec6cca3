"""The working resolution: the size at which frames are matched, and the grid of cells on it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from vipe_core.ba.problem import Grid
from vipe_core.cameras.camera import SQUARE
from vipe_core.priors.protocols import WorkingFrame
from vipe_core.video.source import Frame

_MIN_CELLS = 4
# Rows and columns at the border without a brighter pixel are a bar, not a picture: black is 16 in broadcast levels, and
# an encoder's ringing adds a few.
_BAR_LEVEL = 24


@dataclass(frozen=True, slots=True)
class WorkingSize:
    """Size of the working image, pixels. Source frames are resized to it, not cropped.

    The two axes may scale slightly differently because both are rounded to whole cells; `Camera.resized` carries that
    into fx and fy exactly.

    Attributes:
        stride: Pixels on the sides of a cell.
        offset_px: Where in a cell its sample point is; its centre if None.
    """

    width: int
    height: int
    stride: int = 8
    offset_px: float | None = None

    @property
    def grid(self) -> Grid:
        """Cells of the working image, blocks of `stride` x `stride` pixels."""
        offset_px = (self.stride - 1) / 2 if self.offset_px is None else self.offset_px
        return Grid(self.height // self.stride, self.width // self.stride, float(self.stride), offset_px)

    @property
    def size(self) -> tuple[int, int]:
        return self.width, self.height


def working_size(
    width: int,
    height: int,
    area_px: int,
    stride: int = 8,
    offset_px: float | None = None,
    pixel_aspect: float = 1.0,
) -> WorkingSize:
    """Working size of a video of `width` x `height` pixels: about `area_px`, whole cells, never enlarged.

    A video smaller than a few cells is enlarged to them, the least that a grid needs. Working pixels are square: of
    pixels that are not, the longer side is reduced.

    Args:
        pixel_aspect: Width of a pixel over its height.
    """
    if abs(math.log(pixel_aspect)) > SQUARE:
        width, height = round(width * min(1.0, pixel_aspect)), round(height / max(1.0, pixel_aspect))
    scale = min(1.0, math.sqrt(area_px / (width * height)))

    def whole_cells(length: int) -> int:
        cells = round(length * scale / stride)
        return stride * max(_MIN_CELLS, min(cells, length // stride))

    return WorkingSize(whole_cells(width), whole_cells(height), stride, offset_px)


def working_frame(frame: Frame) -> WorkingFrame:
    """The working frame of a picture that was decoded at the working size.

    Black rows and columns along the border (letterboxes) are not valid. The edge of such a bar stands still whatever
    the camera does, and draws the flow beside it along, so the picture is continued into it. Nor is what the frame
    itself says must not be used.
    """
    gray = np.asarray(cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
    rows, columns = (np.flatnonzero(gray.max(axis=axis) > _BAR_LEVEL) for axis in (1, 0))
    height, width = gray.shape
    if not len(rows) or (rows[0] == columns[0] == 0 and rows[-1] == height - 1 and columns[-1] == width - 1):
        return WorkingFrame(frame.index, gray, frame.rgb, None if frame.masked is None else ~frame.masked)
    top, bottom, left, right = int(rows[0]), int(rows[-1]) + 1, int(columns[0]), int(columns[-1]) + 1
    valid = np.zeros(gray.shape, dtype=np.bool_)
    valid[top:bottom, left:right] = True
    if frame.masked is not None:
        valid &= ~frame.masked
    inside = gray[top:bottom, left:right]
    gray = np.asarray(
        cv2.copyMakeBorder(inside, top, height - bottom, left, width - right, cv2.BORDER_REPLICATE), dtype=np.uint8
    )
    return WorkingFrame(frame.index, gray, frame.rgb, valid)
