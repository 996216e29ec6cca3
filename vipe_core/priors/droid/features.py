"""What the DROID family keeps of a frame."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from vipe_core.ba.problem import Grid
from vipe_core.priors.droid.network import DroidNetwork
from vipe_core.priors.protocols import WorkingFrame
from vipe_core.transfer import uploaded

Array = NDArray[Any]

STRIDE = 8
OFFSET_PX = 4.0
"""The sample point of a cell: in the middle of its block, to half a pixel. See `pictures_of`."""

_USABLE_SHARE = 0.99


def grid_of(shape: tuple[int, ...]) -> Grid:
    """The cells of a picture (height, width, ...)."""
    return Grid(shape[0] // STRIDE, shape[1] // STRIDE, float(STRIDE), OFFSET_PX)


@dataclass(frozen=True, eq=False)
class DroidFeatures:
    """A frame, ready to be matched. The context, which only sources of edges need, is computed when first asked for.

    Attributes:
        index: Frame index in the video.
        rgb: (h, w, 3) uint8.
        gray: (h, w) uint8.
        valid: (h, w) bool, False on pixels that must not be used, or None.
        found: (128, h/8, w/8) what is correlated, on the network's device.
    """

    index: int
    rgb: NDArray[np.uint8]
    gray: NDArray[np.uint8]
    valid: NDArray[np.bool_] | None
    found: Tensor
    _network: DroidNetwork

    @property
    def grid(self) -> Grid:
        return grid_of(self.gray.shape)

    @cached_property
    def context(self) -> tuple[Tensor, Tensor]:
        """(128, h/8, w/8) each: where states of edges out of this frame begin, and their context."""
        begin, context = self._network.context(pictures_of(self._network, [self.rgb]))
        return _inner(begin)[0], _inner(context)[0]

    @cached_property
    def usable(self) -> Tensor:
        """(P,) float32, 1 on cells whose block may be used, on the network's device."""
        cells = np.ones(self.grid.num_cells, np.float32) if self.valid is None else usable_cells(self.valid)
        return uploaded(torch.from_numpy(cells), self._network.device)


def encoded(network: DroidNetwork, frames: list[WorkingFrame]) -> list[DroidFeatures]:
    """Features of frames of one size, in one pass through the encoder."""
    found = _inner(network.features(pictures_of(network, [frame.rgb for frame in frames])))
    return [
        # A copy of its own, so that no frame holds the memory of its batch.
        DroidFeatures(frame.index, frame.rgb, frame.gray, frame.valid, found[row].contiguous().clone(), network)
        for row, frame in enumerate(frames)
    ]


def pictures_of(network: DroidNetwork, pictures: list[NDArray[np.uint8]]) -> Tensor:
    """(B, 3, h + 8, w + 8) for the encoders, of pictures (h, w, 3).

    An encoder centres its cell i on pixel 8i. With a margin of 4 repeated pixels on each side and the first row and
    column of the answer left out, cell i of the picture is centred on pixel 8i + 4 instead: the grid covers it evenly.
    """
    stacked = torch.from_numpy(np.ascontiguousarray(np.stack(pictures).transpose(0, 3, 1, 2)))
    margin = int(OFFSET_PX)
    return functional.pad(network.normalised(stacked), (margin,) * 4, mode="replicate")


def usable_cells(valid: NDArray[np.bool_]) -> NDArray[np.float32]:
    """(P,) 1 on cells of which nearly every pixel may be used."""
    grid = grid_of(valid.shape)
    inside = valid[: grid.height * STRIDE, : grid.width * STRIDE].reshape(grid.height, STRIDE, grid.width, STRIDE)
    return np.asarray(inside.mean(axis=(1, 3)).reshape(-1) > _USABLE_SHARE, np.float32)


def _inner(encoded: Tensor) -> Tensor:
    return encoded[..., 1:, 1:]
