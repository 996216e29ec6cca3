"""Points followed through a shot, as a term beside what a network measures between keyframes (paper section 3.2.2).

A track says where one point of the source is in the target. The map knows depths of cells: what the track found beyond
the network's own answer, interpolated at the point, is taken to hold for the cell around it. The paper splats tracks to
cells as well, but without the difference in where point and cell are.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from vipe_core.ba.problem import Grid
from vipe_core.cameras import Camera
from vipe_core.priors.protocols import PointFollower, TrackedPoints
from vipe_core.slam.selection import Report, Selection
from vipe_core.slam.working import WorkingSize
from vipe_core.transfer import uploaded
from vipe_core.video.source import FrameSource

# A track that is further from the network's answer sees something else, or has slipped.
_AGREE_PX = 2.0
# Between cells that move more differently than that, and a tenth of their motion, is the edge of a thing.
_CALM_RATIO = 0.1


def follow_keyframes(
    follower: PointFollower,
    source: FrameSource,
    selection: Selection,
    size: WorkingSize,
    camera: Camera,
    report: Report,
) -> dict[int, TrackedPoints]:
    """Follow points through every shot: keyframe's index in the video -> the points in it, in working pixels.

    Args:
        camera: As far as it is known, at the working size.

    Raises:
        InputError, DecodeError: From the source.
    """
    info = source.info
    given = follower.input_size(info.width, info.height)
    scale = np.array(size.size) / np.array(given)
    seen: dict[int, TrackedPoints] = {}
    for shot in selection.shots:
        wanted = {keyframe.index for keyframe in shot.keyframes}
        first, last = min(wanted), max(wanted)
        if first == last:
            continue
        with closing(source.frames(given, start=first, stop=last + 1)) as frames:
            # What belongs to no shot, a flash or a black frame, would end all tracks.
            placed = [index for index in range(first, last + 1) if selection.placed[index]]
            pictures = (frame for frame in frames if selection.placed[frame.index])
            for index, points in zip(placed, follower.follow(pictures, camera.resized(*given)), strict=False):
                if index in wanted:
                    seen[index] = TrackedPoints(points.ids, ((points.px + 0.5) * scale - 0.5).astype(np.float32))
                report("track", 0, selection.num_frames)
    return seen


@dataclass(frozen=True, slots=True)
class SharedPoints:
    """Points of one frame that another one sees, at most one for each cell.

    Attributes:
        cells: (n,) int64 the cells of the source that they are in, increasing.
        source_px: (n, 2) float32.
        target_px: (n, 2) float32.
    """

    cells: NDArray[np.int64]
    source_px: NDArray[np.float32]
    target_px: NDArray[np.float32]


def shared_points(grid: Grid, source: TrackedPoints, target: TrackedPoints) -> SharedPoints:
    """The points that two frames share; of those in one cell of the source, the nearest to where it is sampled."""
    _, here, there = np.intersect1d(source.ids, target.ids, assume_unique=True, return_indices=True)
    source_px, target_px = source.px[here], target.px[there]
    in_cells = (source_px - grid.offset) / grid.stride
    nearest = np.rint(in_cells)
    inside = ((nearest >= 0) & (nearest <= (grid.width - 1, grid.height - 1))).all(axis=1)
    cells = (nearest[:, 1] * grid.width + nearest[:, 0]).astype(np.int64)
    away = np.square(in_cells - nearest).sum(axis=1)
    order = np.lexsort((away, cells))
    order = order[inside[order]]
    first = np.ones(len(order), dtype=np.bool_)
    first[1:] = cells[order][1:] != cells[order][:-1]
    chosen = order[first]
    return SharedPoints(cells[chosen], source_px[chosen], target_px[chosen])


class EdgeTracks:
    """What tracks say of the edges under refinement, row by row.

    Args:
        seen: Index of a frame -> the points in it, working pixels.
        device: Where measurements are.
    """

    def __init__(self, grid: Grid, seen: Mapping[int, TrackedPoints], device: torch.device) -> None:
        self._grid = grid
        self._seen = seen
        self._device = device
        self._edges: list[SharedPoints] = []
        self._nothing = TrackedPoints(np.zeros(0, np.int64), np.zeros((0, 2), np.float32))
        self._flat: tuple[Tensor, Tensor, Tensor, Tensor] | None = None

    def add(self, frames: Iterable[tuple[int, int]]) -> None:
        """Append edges between frames of the video."""
        seen, nothing = self._seen, self._nothing
        self._edges += [shared_points(self._grid, seen.get(i, nothing), seen.get(j, nothing)) for i, j in frames]
        self._flat = None

    def keep(self, rows: Sequence[int]) -> None:
        """Forget all edges but those of these rows."""
        self._edges = [self._edges[row] for row in rows]
        self._flat = None

    def joined(self, target_px: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
        """Measurements with the tracks in them.

        A track counts as much as the network trusts its cell: which things move by themselves, only that knows. The sum
        of two squares in the same reprojection is one square at their weighted mean, up to a constant.

        Args:
            target_px, weight: (E, P, 2) of the network; see `Refined`.
        """
        if not self._edges:
            return target_px, weight
        row, cell, source_px, points_px = self._uploaded()
        grid = self._grid
        flow = target_px - grid.sample_px(target_px.dtype, target_px.device)
        place = (source_px - grid.offset) / grid.stride
        corner = place.floor()
        x = corner[:, 0].clamp(0, grid.width - 2).long()
        y = corner[:, 1].clamp(0, grid.height - 2).long()
        within = place - torch.stack((x, y), dim=-1)
        around = torch.stack([flow[row, (y + dy) * grid.width + x + dx] for dy in (0, 1) for dx in (0, 1)])
        rows = torch.lerp(around[0::2], around[1::2], within[:, :1])
        here = torch.lerp(rows[0], rows[1], within[:, 1:])
        beyond = points_px - source_px - here
        spread = (around.amax(dim=0) - around.amin(dim=0)).amax(dim=-1)
        fits = (spread <= _AGREE_PX + _CALM_RATIO * here.norm(dim=-1)) & (beyond.square().sum(dim=-1) <= _AGREE_PX**2)
        own = weight[row, cell]
        extra = torch.where(fits, own.amax(dim=-1), 0.0)[:, None]
        total = own + extra
        share = extra / torch.where(total > 0, total, 1.0)
        # Each cell of an edge is written once, so the order does not matter.
        target_px, weight = target_px.clone(), weight.clone()
        target_px[row, cell] += share * torch.where(fits[:, None], beyond, 0.0)
        weight[row, cell] = total
        return target_px, weight

    def _uploaded(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """(T,) rows, (T,) cells, (T, 2) points of the source and (T, 2) of the target of all edges, on the device."""
        if self._flat is None:
            counts = [len(edge.cells) for edge in self._edges]
            parts = (
                np.repeat(np.arange(len(self._edges)), counts),
                np.concatenate([edge.cells for edge in self._edges]),
                np.concatenate([edge.source_px for edge in self._edges]),
                np.concatenate([edge.target_px for edge in self._edges]),
            )
            row, cell, source_px, points_px = (uploaded(part, self._device) for part in parts)
            self._flat = row, cell, source_px, points_px
        return self._flat
