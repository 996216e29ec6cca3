"""Edges under refinement by the network: their states, correlations, and what was last said of them."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from vipe_core.ba.problem import Grid
from vipe_core.priors.droid.correlation import Correlation, FeatureCorrelation, VolumeCorrelation
from vipe_core.priors.droid.features import DroidFeatures
from vipe_core.priors.droid.network import DroidNetwork
from vipe_core.priors.droid.update import shares
from vipe_core.priors.protocols import Refined
from vipe_core.transfer import uploaded

# DROID weighs a residual of one cell by 0.001 and adds a fifth of the damping to the depths' diagonal. Here residuals
# are in pixels, an eighth of a cell, with a weight of one.
_DAMPING = 0.2 / (0.001 / 64)
# Source frames whose edges are updated at once in a lean refinement.
_LEAN_SOURCES = 8


class DroidRefinement:
    """`Refinement` of the network.

    Args:
        lean: Products of features on the fly instead of volumes, and updates in parts.
        spilled: States lie on the host but for the part that is updated.
    """

    def __init__(self, network: DroidNetwork, grid: Grid, *, lean: bool, spilled: bool = False) -> None:
        self._network, self._grid, self._lean = network, grid, lean
        self._home = torch.device("cpu") if spilled else network.device
        self._cells = _own_cells(grid, network.device)
        self._pairs: list[tuple[DroidFeatures, DroidFeatures]] = []
        self._correlation: Correlation | None = None
        self._hidden: Tensor | None = None
        self._said: Tensor | None = None

    def __len__(self) -> int:
        return len(self._pairs)

    def add(self, pairs: Sequence[tuple[DroidFeatures, DroidFeatures]], seen_px: Tensor) -> None:
        """See `Refinement.add`."""
        if not pairs:
            return
        self._pairs += pairs
        begin = torch.stack([source.context[0].to(self._home) for source, _ in pairs])
        said = self._in_cells(seen_px)
        self._hidden = begin if self._hidden is None else torch.cat((self._hidden, begin))
        self._said = said if self._said is None else torch.cat((self._said, said))
        if self._lean:
            self._correlation = None
            return
        volume = VolumeCorrelation.of(
            torch.stack([source.found for source, _ in pairs]), torch.stack([target.found for _, target in pairs])
        )
        known = self._correlation
        self._correlation = known.extended(volume) if isinstance(known, VolumeCorrelation) else volume

    def keep(self, rows: Sequence[int]) -> None:
        """See `Refinement.keep`."""
        if list(rows) == list(range(len(self))) or self._hidden is None or self._said is None:
            return
        index = uploaded(torch.tensor(list(rows), dtype=torch.int64), self._network.device)
        self._pairs = [self._pairs[row] for row in rows]
        self._hidden, self._said = self._hidden[index.to(self._home)], self._said[index]
        if self._correlation is not None:
            self._correlation = None if self._lean else self._correlation.kept(index)

    @torch.inference_mode()
    def update(self, seen_px: Tensor, sources: Sequence[int]) -> Refined:
        """See `Refinement.update`."""
        assert self._hidden is not None
        assert self._said is not None
        device = self._network.device
        seen = self._in_cells(seen_px)
        said = torch.empty_like(self._said)
        weight = torch.empty_like(self._said)
        dampings = []
        correlation = self._correlated()
        for rows in self._parts(sources):
            index = uploaded(torch.tensor(rows, dtype=torch.int64), device)
            at_home = index.to(self._home)
            some = correlation if len(rows) == len(self) else correlation.kept(index)
            motion = torch.cat((seen[index] - self._cells, self._said[index] - seen[index]), dim=-1)
            updated = self._network.step(
                self._hidden[at_home].to(device),
                torch.stack([self._pairs[row][0].context[1] for row in rows]),
                some.lookup(seen[index]).to(self._network.dtype),
                motion.permute(0, 3, 1, 2),
                uploaded(shares([sources[row] for row in rows]), device),
            )
            # In place, part by part: the states of a large graph are most of what there is.
            hidden = updated.hidden.to(self._hidden.dtype).nan_to_num(0.0, 1.0, -1.0)
            self._hidden[at_home] = hidden.to(self._home)
            said[index] = seen[index] + updated.delta.permute(0, 2, 3, 1)
            weight[index] = updated.weight.permute(0, 2, 3, 1)
            dampings.append(updated.damping.flatten(1))
        # Half precision may overflow; what it says then is nothing, and must not be what the next update starts from.
        sound = said.isfinite() & weight.isfinite()
        said, weight = torch.where(sound, said, seen), torch.where(sound, weight, 0.0)
        self._said = said
        usable = torch.stack([source.usable for source, _ in self._pairs])
        return Refined(
            said.flatten(1, 2) * self._grid.stride + self._grid.offset,
            weight.flatten(1, 2) * usable[..., None],
            _DAMPING * torch.cat(dampings).nan_to_num(0.0, 0.0),
        )

    def _parts(self, sources: Sequence[int]) -> list[list[int]]:
        """Rows that are updated together: all edges out of a frame, in increasing order of frames."""
        frames = sorted(set(sources))
        size = _LEAN_SOURCES if self._lean else max(len(frames), 1)
        parts = [set(frames[start : start + size]) for start in range(0, len(frames), size)]
        return [[row for row, source in enumerate(sources) if source in part] for part in parts]

    def _correlated(self) -> Correlation:
        if self._correlation is None:
            frames: dict[int, int] = {}
            found: list[Tensor] = []
            for features in (each for pair in self._pairs for each in pair):
                if features.index not in frames:
                    frames[features.index] = len(found)
                    found.append(features.found)
            ends = torch.tensor([[frames[source.index], frames[target.index]] for source, target in self._pairs])
            ends = uploaded(ends, self._network.device)
            self._correlation = FeatureCorrelation.of(
                torch.stack(found), ends[:, 0].contiguous(), ends[:, 1].contiguous()
            )
        return self._correlation

    def _in_cells(self, px: Tensor) -> Tensor:
        """(E, h, w, 2) float32 cells of (E, P, 2) pixels; a cell's own place where the geometry says nothing."""
        cells = (px.to(self._network.device, torch.float32) - self._grid.offset) / self._grid.stride
        cells = cells.view(len(px), self._grid.height, self._grid.width, 2)
        return torch.where(cells.isfinite(), cells, self._cells)


def _own_cells(grid: Grid, device: torch.device) -> Tensor:
    """(h, w, 2) the place (x, y) of every cell."""
    y, x = torch.meshgrid(
        torch.arange(grid.height, dtype=torch.float32, device=device),
        torch.arange(grid.width, dtype=torch.float32, device=device),
        indexing="ij",
    )
    return torch.stack((x, y), dim=-1)
