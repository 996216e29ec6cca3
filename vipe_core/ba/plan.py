"""The shape of a bundle adjustment, worked out once per graph: order of edges, chunks of source frames, columns.

Everything behind one inverse depth is seen by the edges that leave its frame, so the work is grouped by source frame
(edges of a frame whose depths are fixed may be summed apart).
Frames of similar out-degree share a chunk, padded to the largest one; a chunk is what one batch of tensor operations
works on, sized for the cache of a CPU or for the occupancy of a GPU. Edges are ordered by (source, target), so a solve
does not depend on the order they came in.

Columns of the reduced system: 6 per free pose (translation, rotation), then the free intrinsics (log f, alpha), then
the right-hand side, then one dump column that collects everything fixed and is dropped.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from vipe_core.ba.problem import Problem

# Edge cells per chunk: temporaries of this many float32 stay in a CPU's second-level cache; a GPU wants bulk.
_CPU_CHUNK_CELLS = 1 << 15
_GPU_CHUNK_CELLS = 1 << 22


@dataclass(frozen=True, slots=True)
class Chunk:
    """F source frames with D edges each (padded).

    Attributes:
        frames: (F,) int64 source frames, different ones where depths are free.
        edges: (F, D) int64 indices into the problem's edges; 0 where padded.
        targets: (F, D) int64 target frames; the source itself where padded.
        real: (F, D) bool, False where padded.
        columns: (F, 6 D + 6 + n + 1) int64 column in the reduced system of the source pose, target poses, intrinsics
            and right-hand side of each frame.
        depth_free: Whether the inverse depths of these frames move; the same for all of a chunk.
    """

    frames: Tensor
    edges: Tensor
    targets: Tensor
    real: Tensor
    columns: Tensor
    depth_free: bool

    @property
    def degree(self) -> int:
        return int(self.edges.shape[1])


@dataclass(frozen=True, slots=True)
class Plan:
    """Order and layout of one problem.

    Attributes:
        chunks: Cover every edge exactly once.
        num_columns: Free columns n of the reduced system; n is the right-hand side, n + 1 the dump.
        pose_columns: (N, 6) int64 columns of each pose; the dump where fixed.
        focal_column: Column of log f, or None.
        alpha_column: Column of alpha, or None.
        any_depth_free: Whether any source frame has free inverse depths.
    """

    chunks: tuple[Chunk, ...]
    num_columns: int
    pose_columns: Tensor
    focal_column: int | None
    alpha_column: int | None
    any_depth_free: bool


class _Group(NamedTuple):
    """Edges of one source frame that are summed together; sorts by what can share a chunk."""

    depth_free: bool
    size: int
    frame: int
    offset: int


def _groups(depth_free: Tensor, degree: Tensor, limit: int) -> Iterator[_Group]:
    """All edges of a frame whose depths are eliminated; pieces of at most `limit` edges of a frame whose are not."""
    for frame, (free, count) in enumerate(zip(depth_free.tolist(), degree.tolist(), strict=True)):
        piece = count if free else limit
        for offset in range(0, count, max(piece, 1)):
            yield _Group(free, min(piece, count - offset), frame, offset)


def build_plan(problem: Problem, device: torch.device) -> Plan:
    """Lay out a problem. Host work, linear in edges and frames; the plan's tensors end on `device`."""
    free_poses = problem.free.poses.cpu()
    depth_free = problem.free.inverse_depth.cpu()
    source, target = problem.edges.source.cpu(), problem.edges.target.cpu()
    num_frames = len(free_poses)

    # A frame that no edge touches has nothing to say about its pose.
    touched = torch.zeros(num_frames, dtype=torch.bool)
    touched[source] = True
    touched[target] = True
    free_poses = free_poses & touched

    focal_free = problem.free.focal
    alpha_free = problem.free.distortion and problem.camera_model == "mei"
    pose_width = 6 * int(free_poses.sum())
    num_columns = pose_width + focal_free + alpha_free
    focal_column = pose_width if focal_free else None
    alpha_column = pose_width + focal_free if alpha_free else None
    dump = num_columns + 1
    pose_columns = torch.full((num_frames, 6), dump)
    pose_columns[free_poses] = torch.arange(pose_width).reshape(-1, 6)
    shared_columns = torch.arange(pose_width, num_columns + 1)

    order = torch.argsort(source * num_frames + target, stable=True)
    degree = torch.bincount(source, minlength=num_frames)
    first = torch.cumsum(degree, 0) - degree
    limit = (_CPU_CHUNK_CELLS if device.type == "cpu" else _GPU_CHUNK_CELLS) // max(problem.grid.num_cells, 1)
    groups = sorted(_groups(depth_free, degree, max(limit, 1)))

    chunks: list[Chunk] = []
    start = 0
    while start < len(groups):
        stop = start + 1
        # Sorted by size, so the last one sets the padding.
        while (
            stop < len(groups)
            and groups[stop].depth_free == groups[start].depth_free
            and (stop + 1 - start) * groups[stop].size <= limit
        ):
            stop += 1
        frames, offset, size = torch.tensor([(g.frame, g.offset, g.size) for g in groups[start:stop]]).T
        slots = torch.arange(int(size[-1]))
        real = slots < size[:, None]
        position = (first[frames] + offset)[:, None] + slots
        edges = torch.where(real, order[position.clamp_max(len(order) - 1)], 0)
        targets = torch.where(real, target[edges], frames[:, None])
        columns = torch.cat(
            (
                pose_columns[frames],
                torch.where(real[..., None], pose_columns[targets], dump).flatten(1),
                shared_columns.expand(len(frames), -1),
            ),
            dim=1,
        )
        chunks.append(
            Chunk(
                frames.to(device),
                edges.to(device),
                targets.to(device),
                real.to(device),
                columns.to(device),
                groups[start].depth_free,
            )
        )
        start = stop
    return Plan(
        chunks=tuple(chunks),
        num_columns=num_columns,
        pose_columns=pose_columns.to(device),
        focal_column=focal_column,
        alpha_column=alpha_column,
        any_depth_free=any(chunk.depth_free for chunk in chunks),
    )
