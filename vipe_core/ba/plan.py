"""The shape of a bundle adjustment, worked out once per graph: order of edges, chunks of source frames, columns.

Everything behind one inverse depth is seen by the edges that leave its frame, so the work is grouped by source frame
(edges of a frame whose depths are fixed may be summed apart).
Frames of similar out-degree share a chunk, padded to the largest one; a chunk is what one batch of tensor operations
works on, sized for the cache of a CPU or for the occupancy of a GPU. Edges are ordered by (source, target), so a solve
does not depend on the order they came in.

Columns of the reduced system: 6 per free pose (translation, rotation), 6 per free view of a rig, then the free
intrinsics (log f, alpha) of every camera, then the right-hand side, then one dump column that collects everything fixed
and is dropped.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from vipe_core.ba.problem import Problem
from vipe_core.ba.rigs import unknowns_of

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
        columns: (F, L) int64 columns in the reduced system of each frame: source pose 6, target poses 6 D; then, where
            extrinsics are free, source view 6, target views 6 D; then, where every view has intrinsics of its own,
            those of the targets n D; then the source's n, and the right-hand side.
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
        pose_columns: (N, 6) int64 columns of each frame's pose; the dump where fixed.
        view_columns: (V, 6) int64 columns of the extrinsics; the dump where fixed.
        intrinsic_columns: (C, n) int64 columns of the n free ones of (log f, alpha) of each camera.
        free_intrinsics: Which of (log f, alpha) these are, 0 or 1.
        any_depth_free: Whether any source frame has free inverse depths.
    """

    chunks: tuple[Chunk, ...]
    num_columns: int
    pose_columns: Tensor
    view_columns: Tensor
    intrinsic_columns: Tensor
    free_intrinsics: tuple[int, ...]
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


def build_plan(problem: Problem, camera_of: Tensor, num_cameras: int, device: torch.device) -> Plan:
    """Lay out a problem. Host work, linear in edges and frames; the plan's tensors end on `device`.

    Args:
        camera_of: (N,) which of the `num_cameras` different intrinsics each frame has.
    """
    depth_free = problem.free.inverse_depth.cpu()
    source, target = problem.edges.source.cpu(), problem.edges.target.cpu()
    num_frames = len(depth_free)
    unknowns = unknowns_of(problem)

    free_intrinsics = [0] if problem.free.focal else []
    if problem.free.distortion and problem.camera_model == "mei":
        free_intrinsics.append(1)
    each = len(free_intrinsics)
    pose_width = 6 * int(unknowns.poses.sum())
    view_width = 6 * int(unknowns.views.sum())
    num_columns = pose_width + view_width + num_cameras * each
    dump = num_columns + 1
    rig_columns = torch.full((len(unknowns.poses), 6), dump)
    rig_columns[unknowns.poses] = torch.arange(pose_width).reshape(-1, 6)
    pose_columns = rig_columns[unknowns.pose_of_frame]
    view_columns = torch.full((len(unknowns.views), 6), dump)
    view_columns[unknowns.views] = pose_width + torch.arange(view_width).reshape(-1, 6)
    view_columns_of = view_columns[unknowns.view_of_frame]
    intrinsic_columns = torch.arange(pose_width + view_width, num_columns).reshape(num_cameras, each)
    intrinsic_columns_of = intrinsic_columns[camera_of.cpu()]

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

        def of_targets(columns: Tensor, real: Tensor = real, targets: Tensor = targets) -> Tensor:
            return torch.where(real[..., None], columns[targets], dump).flatten(1)

        parts = [pose_columns[frames], of_targets(pose_columns)]
        if view_width:
            parts += [view_columns_of[frames], of_targets(view_columns_of)]
        if num_cameras > 1:
            parts.append(of_targets(intrinsic_columns_of))
        parts += [intrinsic_columns_of[frames], torch.full((len(frames), 1), num_columns)]
        columns = torch.cat(parts, dim=1)
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
        view_columns=view_columns.to(device),
        intrinsic_columns=intrinsic_columns.to(device),
        free_intrinsics=tuple(free_intrinsics),
        any_depth_free=any(chunk.depth_free for chunk in chunks),
    )
