"""The provider `droid.network`: the network behind the protocols of dense matching and of refinement."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from vipe_core.ba.problem import Grid
from vipe_core.priors.classical.features import FlowFeatures
from vipe_core.priors.classical.flow import DisFlowMatcher
from vipe_core.priors.droid.features import OFFSET_PX, STRIDE, DroidFeatures, encoded
from vipe_core.priors.droid.network import FRAME_STEP, DroidNetwork
from vipe_core.priors.droid.refinement import DroidRefinement
from vipe_core.priors.protocols import Match, WorkingFrame
from vipe_core.transfer import downloaded, uploaded

Array = NDArray[Any]

# Updates of a match that no bundle adjustment takes part in.
_UPDATES = 8
_FAST_UPDATES = 4
# Frames whose motion is asked of the network at once. Captured shapes are padded to as many sources: no more work than
# for one frame.
_MOTIONS = FRAME_STEP
# A cell whose forward and backward flows disagree by more than this many pixels and this share of the flow is wrong.
_CONSISTENT_PX = 2.0
_CONSISTENT_RATIO = 0.05


class DroidMatcher:
    """`DenseMatcher`, `BatchEncoder` and `Refiner` of a network that is on its device.

    In the map, measurements are refined in turns with the geometry. `match` is for pairs that have no geometry yet: the
    network goes on from its own answer.

    Attributes:
        batch_frames: Frames that are best encoded at once.
        bytes_per_px: Of the features of a frame: picture, gray picture, and 128 values for a cell.
    """

    def __init__(self, network: DroidNetwork) -> None:
        self._network = network
        on_host = network.device.type == "cpu"
        self.batch_frames = 1 if on_host else 16
        self.bytes_per_px = 4 + 128 * (4 if on_host else 2) / STRIDE**2
        self._blank = DisFlowMatcher()
        self._batch: list[DroidFeatures] = []
        self._motions_px: dict[tuple[int, int], float] = {}

    @property
    def offset_px(self) -> float:
        """See `Refiner.offset_px`."""
        return OFFSET_PX

    def encode(self, frame: WorkingFrame) -> DroidFeatures:
        """Features of a frame."""
        return self.encode_batch([frame])[0]

    def encode_batch(self, frames: Sequence[WorkingFrame]) -> list[DroidFeatures]:
        """Features of frames of one size."""
        self._batch, self._motions_px = encoded(self._network, list(frames)), {}
        return list(self._batch)

    def is_blank(self, features: DroidFeatures) -> bool:
        """Whether the picture holds nothing to match: as the classical family judges it, by its structure."""
        return self._blank.is_blank(FlowFeatures(features.index, features.gray, features.valid, features.grid))

    def motion_px(self, source: DroidFeatures, target: DroidFeatures) -> float:
        """Mean length of the first correction of a standing picture, pixels (paper section 3.1, step 2).

        The frames that were encoded with `target` and come after it are asked for, too, since they will be asked about
        unless one before them becomes a keyframe: the host waits for the GPU a few times a batch and not once a frame.
        """
        asked = source.index, target.index
        if asked not in self._motions_px:
            place = next((k for k, features in enumerate(self._batch) if features is target), None)
            targets = [target] if place is None else self._batch[place : place + _MOTIONS]
            refinement, still = self._between([(source, features) for features in targets])
            refined = refinement.update(still, range(len(targets)))
            lengths = (refined.target_px - still).norm(dim=-1)
            # Read at once: the host waits for the GPU here.
            mean = ((lengths * source.usable).sum(dim=-1) / source.usable.sum().clamp(min=1)).tolist()
            self._motions_px = {(source.index, f.index): px for f, px in zip(targets, mean, strict=True)}
        return self._motions_px[asked]

    def match(self, source: DroidFeatures, target: DroidFeatures, guess_px: Array | None = None) -> tuple[Match, Match]:
        """Measurements source -> target and target -> source; see `DenseMatcher.match`."""
        there, back = self._flow([(source, target), (target, source)], [guess_px, None], _UPDATES)
        grid = source.grid
        return _checked(there, back, grid), _checked(back, there, grid)

    def match_fast(self, source: DroidFeatures, target: DroidFeatures, guess_px: Array | None = None) -> Match:
        """One-way measurement; what the network is sure of counts as consistent."""
        return self._flow([(source, target)], [guess_px], _FAST_UPDATES)[0]

    def picture(self, features: DroidFeatures) -> NDArray[np.uint8]:
        """See `Refiner.picture`."""
        return features.rgb

    def begin(self, grid: Grid, *, lean: bool, spilled: bool = False) -> DroidRefinement:
        """See `Refiner.begin`."""
        return DroidRefinement(self._network, grid, lean=lean, spilled=spilled)

    def _between(self, pairs: Sequence[tuple[DroidFeatures, DroidFeatures]]) -> tuple[DroidRefinement, Tensor]:
        """A refinement of pairs that stand still, and (E, P, 2) where that sees the cells."""
        grid = pairs[0][0].grid
        # A volume of all pairs is worth its memory where it is looked up many times, and on a CPU, where a product of
        # matrices is far faster than to gather features.
        refinement = DroidRefinement(self._network, grid, lean=self._network.device.type != "cpu")
        still = grid.sample_px(torch.float32, self._network.device).expand(len(pairs), -1, -1)
        refinement.add(pairs, still)
        return refinement, still

    def _flow(
        self, pairs: Sequence[tuple[DroidFeatures, DroidFeatures]], guesses: Sequence[Array | None], updates: int
    ) -> list[Match]:
        """Flow of each pair from a guess, or from standing still."""
        refinement, seen = self._between(pairs)
        for row, guess_px in enumerate(guesses):
            if guess_px is not None:
                given = uploaded(np.asarray(guess_px, np.float32), seen.device)
                seen = seen.clone()
                seen[row] = torch.where(given.isfinite(), given, seen[row])
        for _ in range(updates):
            refined = refinement.update(seen, range(len(pairs)))
            seen = refined.target_px
        size = _size_px(pairs[0][0].grid)
        found = []
        for (_, target), target_px, weight in zip(pairs, refined.target_px, refined.weight, strict=True):
            inside = (target_px >= 0).all(-1) & (target_px[:, 0] <= size[0]) & (target_px[:, 1] <= size[1])
            kept = weight * (inside * _sampled(target.usable, target_px, target.grid))[:, None]
            found.append(torch.cat((target_px, kept, inside[:, None]), dim=-1))
        # All of it is read at once: the host waits for the GPU here.
        (read,) = downloaded(torch.stack(found))
        return [_matched(one) for one in read]


def _matched(found: Array) -> Match:
    """Of (P, 5): target (x, y), weights, and whether it is inside; what the network is sure of is its share."""
    weight, inside = found[:, 2:4].copy(), found[:, 4].sum()
    sure = np.count_nonzero(weight.max(axis=1) > 0.5)
    return Match(found[:, :2].copy(), weight, float(sure / max(inside, 1.0)))


def _checked(forward: Match, backward: Match, grid: Grid) -> Match:
    """A match without what the way back contradicts."""
    source = grid.sample_px().numpy().astype(np.float32)
    flow = forward.target_px - source
    cell = np.rint((forward.target_px - grid.offset) / grid.stride).astype(np.int64)
    inside = ((cell >= 0) & (cell < (grid.width, grid.height))).all(axis=1)
    landing = np.clip(cell, 0, (grid.width - 1, grid.height - 1))
    returning = (backward.target_px - source)[landing[:, 1] * grid.width + landing[:, 0]]
    error = np.linalg.norm(flow + returning, axis=1)
    agrees = inside & (error < _CONSISTENT_PX + _CONSISTENT_RATIO * np.linalg.norm(flow, axis=1))
    consistent = float(agrees[inside].mean()) if inside.any() else 0.0
    return Match(forward.target_px, np.where(agrees[:, None], forward.weight, np.float32(0)), consistent)


def _sampled(cells: Tensor, px: Tensor, grid: Grid) -> Tensor:
    """(P,) values of the nearest cells of positions (P, 2)."""
    at = ((px - grid.offset) / grid.stride).round().nan_to_num(0).long()
    column, row = at[:, 0].clamp(0, grid.width - 1), at[:, 1].clamp(0, grid.height - 1)
    return cells[row * grid.width + column]


def _size_px(grid: Grid) -> tuple[float, float]:
    return grid.width * grid.stride - 1, grid.height * grid.stride - 1
