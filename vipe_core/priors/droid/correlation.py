"""How alike two frames are around where a cell is thought to be seen: all-pairs volumes, or products on the fly.

The correlation of cells p and q is f1(p) . f2(q) / 16. Level L of the pyramid averages it over 2^L x 2^L cells of the
target (what does not fill a block is left out). A lookup reads, at each level, the 7 x 7 values around a position, by
bilinear interpolation with zeros outside; channel 49 L + 7 (dx + 3) + (dy + 3) is the one at offset (dx, dy).

A volume costs P^2 values for every edge and is read at once. Products on the fly need the features alone, whose average
over cells has the averaged correlation (it is linear in them).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import torch
from torch import Tensor
from torch.nn import functional

from vipe_core.priors.droid.kernels import lookup_kernels

LEVELS = 4
RADIUS = 3
SIDE = 2 * RADIUS + 1
NUM_CHANNELS = LEVELS * SIDE * SIDE
SCALE = 1 / 16

# Values gathered at a time by the lookup without a kernel.
_BATCH_VALUES = 1 << 24


class Correlation(Protocol):
    """Correlations of a list of edges, looked up as often as the geometry moves."""

    def __len__(self) -> int:
        """Number of edges."""

    def lookup(self, cells: Tensor) -> Tensor:
        """(E, 196, h, w) around positions (E, h, w, 2) (x, y) in the target, cells."""

    def kept(self, rows: Tensor) -> Correlation:
        """The edges of these rows (n,) int64."""


class VolumeCorrelation:
    """All pairs of cells of every edge, in a pyramid.

    Attributes:
        levels: (E, P, h >> L, w >> L) for each level L.
    """

    def __init__(self, levels: Sequence[Tensor]) -> None:
        self.levels = tuple(levels)

    @classmethod
    def of(cls, source: Tensor, target: Tensor) -> VolumeCorrelation:
        """Of features (E, C, h, w) of the two ends of each edge."""
        edges, _, height, width = source.shape
        volume = SCALE * source.flatten(2).mT @ target.flatten(2)
        return cls(pyramid(volume.view(edges, height * width, height, width)))

    def __len__(self) -> int:
        return len(self.levels[0])

    def lookup(self, cells: Tensor) -> Tensor:
        edges, height, width, _ = cells.shape
        at = cells.reshape(edges, height * width, 2).float().contiguous()
        kernels = lookup_kernels(cells.device, self.levels[0].dtype)
        if kernels is not None:
            return _channels_last(kernels.of_volume(self.levels, at), height, width)
        found = [windows_of_volume(level, at / 2**number) for number, level in enumerate(self.levels)]
        return _as_channels(found, height, width)

    def extended(self, other: VolumeCorrelation) -> VolumeCorrelation:
        """These edges, and those of another one behind them."""
        return VolumeCorrelation([torch.cat(both) for both in zip(self.levels, other.levels, strict=True)])

    def kept(self, rows: Tensor) -> VolumeCorrelation:
        return VolumeCorrelation([level[rows] for level in self.levels])


class FeatureCorrelation:
    """Products of features on the fly, for graphs whose volumes would not fit.

    Attributes:
        frames: (F, P, C) features of all frames of the graph.
        levels: (F, h >> L, w >> L, C) the same in a pyramid.
        source: (E,) int64 frame of each edge.
        target: (E,) int64.
    """

    def __init__(self, frames: Tensor, levels: Sequence[Tensor], source: Tensor, target: Tensor) -> None:
        self.frames, self.levels = frames, tuple(levels)
        self.source, self.target = source, target

    @classmethod
    def of(cls, features: Tensor, source: Tensor, target: Tensor) -> FeatureCorrelation:
        """Of features (F, C, h, w) of frames, and the numbers (E,) of the two ends of each edge among them."""
        levels = [level.permute(0, 2, 3, 1).contiguous() for level in pyramid(features)]
        return cls(levels[0].flatten(1, 2), levels, source, target)

    def __len__(self) -> int:
        return len(self.source)

    def lookup(self, cells: Tensor) -> Tensor:
        edges, height, width, _ = cells.shape
        at = cells.reshape(edges, height * width, 2).float().contiguous()
        kernels = lookup_kernels(cells.device, self.frames.dtype)
        if kernels is not None:
            return _channels_last(kernels.of_features(self.levels, self.source, self.target, at), height, width)
        answer = torch.empty(edges, NUM_CHANNELS, height, width, dtype=torch.float32, device=cells.device)
        batch = max(1, _BATCH_VALUES // (self.frames[0].numel() * (SIDE + 1)))
        for start in range(0, edges, batch):
            some = slice(start, start + batch)
            queries = self.frames[self.source[some]]
            windows = [
                windows_of_features(queries, level[self.target[some]], at[some] / 2**number)
                for number, level in enumerate(self.levels)
            ]
            answer[some] = _as_channels(windows, height, width)
        return answer

    def kept(self, rows: Tensor) -> FeatureCorrelation:
        return FeatureCorrelation(self.frames, self.levels, self.source[rows], self.target[rows])


def pyramid(image: Tensor) -> list[Tensor]:
    """`LEVELS` pictures (..., h, w): means over blocks of 2 x 2, again and again; one row or column is kept."""
    levels = [image]
    for _ in range(LEVELS - 1):
        height, width = levels[-1].shape[-2:]
        levels.append(functional.avg_pool2d(levels[-1], (min(height, 2), min(width, 2))))
    return levels


def windows_of_volume(level: Tensor, at: Tensor) -> Tensor:
    """(E, P, 49) around positions (E, P, 2) in one level (E, P, h, w) of a volume."""
    height, width = level.shape[-2:]
    index, inside, fraction = _window(at, height, width)
    values = level.flatten(2).gather(2, index.flatten(2)).float() * inside.flatten(2)
    return _between(values.view(*at.shape[:2], SIDE + 1, SIDE + 1), fraction)


def windows_of_features(queries: Tensor, level: Tensor, at: Tensor) -> Tensor:
    """(E, P, 49) around positions (E, P, 2): products of features (E, P, C) and of one level (E, h, w, C)."""
    edges, height, width, channels = level.shape
    index, inside, fraction = _window(at, height, width)
    flat = level.reshape(edges, height * width, channels)
    row = torch.arange(edges, device=at.device)[:, None, None]
    columns = [
        torch.einsum("epc,epyc->epy", queries.float(), flat[row, index[:, :, x]].float()) for x in range(SIDE + 1)
    ]
    return _between(SCALE * torch.stack(columns, dim=2) * inside, fraction)


def _window(at: Tensor, height: int, width: int) -> tuple[Tensor, Tensor, Tensor]:
    """The 8 x 8 cells (x, y) that a lookup touches: numbers, which of them exist, and how far `at` is between two."""
    corner = at.floor()
    offsets = torch.arange(-RADIUS, RADIUS + 2, device=at.device)
    # Geometry may see a cell anywhere; far outside there is nothing, wherever that is.
    whole = torch.stack(
        [corner[..., axis].nan_to_num(-1e4).clamp(-1e4, 1e4).long() for axis in (0, 1)],
        dim=-1,
    )
    x = (whole[..., 0, None] + offsets)[..., :, None]
    y = (whole[..., 1, None] + offsets)[..., None, :]
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    index = y.clamp(0, height - 1) * width + x.clamp(0, width - 1)
    return index, inside, (at - corner).nan_to_num(0.0)


def _between(values: Tensor, fraction: Tensor) -> Tensor:
    """(E, P, 49) bilinear values between those (E, P, 8, 8) at whole cells (x, y)."""
    fx, fy = (fraction[..., axis, None, None] for axis in (0, 1))
    along = (1 - fx) * values[:, :, :-1] + fx * values[:, :, 1:]
    return ((1 - fy) * along[..., :-1] + fy * along[..., 1:]).flatten(2)


def _as_channels(levels: Sequence[Tensor], height: int, width: int) -> Tensor:
    """(E, 196, h, w) of the levels' (E, P, 49)."""
    together = torch.cat(tuple(levels), dim=-1)
    return together.mT.reshape(len(together), NUM_CHANNELS, height, width)


def _channels_last(found: Tensor, height: int, width: int) -> Tensor:
    """(E, 196, h, w) of (E, P, 196), as it lies in memory."""
    return found.view(len(found), height, width, NUM_CHANNELS).permute(0, 3, 1, 2)
