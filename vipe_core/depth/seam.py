"""The left and right border of a panorama, where the picture goes on at its other end.

The loops of the depth stage know flat pictures. A panorama is given to them with a part of its other end on either
side, so that nothing they do stops at the border, and what they found twice there is faded from one into the other.
"""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from vipe_core.cameras import Camera

Scalar = TypeVar("Scalar", bound=np.generic)
Array = NDArray[Any]

# What is added on either side, as a share of the width: more than what any window or path of the stage reaches.
_SHARE = 1 / 16


class Seam:
    """Adds and takes away the other end of pictures of whole cells; does nothing for cameras that see no full circle.

    Args:
        camera: At the working resolution.

    Attributes:
        closed: Whether the left and the right border are one place.
    """

    def __init__(self, camera: Camera) -> None:
        self.closed = camera.model == "equirect"
        self._columns = camera.width // 8
        self._added = max(1, round(_SHARE * self._columns)) if self.closed else 0

    def around(self, values: NDArray[Scalar]) -> NDArray[Scalar]:
        """(h, w, ...) -> (h, w + 2 added, ...); w is a multiple of the number of cells in a row."""
        added = self._added * (values.shape[1] // self._columns)
        if not added:
            return values
        return np.concatenate((values[:, -added:], values, values[:, :added]), axis=1)

    def inside(self, values: NDArray[Scalar]) -> NDArray[Scalar]:
        """(h, w + 2 added, ...) -> (h, w, ...), what was added cut off."""
        added = self._within(values)
        return np.ascontiguousarray(values[:, added : values.shape[1] - added]) if added else values

    def joined(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """`inside`, with what was found at both ends faded into each other: no step where the ends meet."""
        added = self._within(values)
        if not added:
            return values
        out = self.inside(values)
        share = ((np.arange(added, dtype=np.float32) + 0.5) / added).reshape(1, -1, *(1,) * (values.ndim - 2))
        beyond_left, beyond_right = values[:, :added], values[:, -added:]
        out[:, :added] += (0.5 - 0.5 * share) * (beyond_right - out[:, :added])
        out[:, -added:] += 0.5 * share * (beyond_left - out[:, -added:])
        return out

    def _within(self, values: Array) -> int:
        scale: int = values.shape[1] // (self._columns + 2 * self._added)
        return self._added * scale
