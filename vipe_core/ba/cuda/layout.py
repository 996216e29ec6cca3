"""The shape of a bundle adjustment for the CUDA kernels, worked out on the host once per graph.

Edges are ordered by (source, target). Those of a frame whose depths are eliminated make one unit, those of a frame
whose depths are held are split. Free poses, and free views of a rig, are numbered in an order of elimination with
little fill; the tail (free intrinsics and the right-hand side) comes last. Every 6x6 block of the reduced system knows
which blocks of the units it sums, and every 48x48 tile of its factor which products it subtracts, so the kernels need
no atomics and no search.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vipe_core.ba import block_cholesky
from vipe_core.ba.cuda.context import SIDE, SIDE_BLOCKS, SLICE, TILE, TILE_THREADS

Ints = NDArray[np.int64]
Array = NDArray[Any]

# As in `kernels/tile.cu` and `kernels/context.cu`.
_FIXED_FLOATS = 20 + 10 * TILE + 2 * TILE + TILE_THREADS // 32 * 4 * TILE
_PRODUCT_STRIDE = {0: 32, 1: 40, 2: 48, 4: 72}

# What every GPU since compute capability 8.0 can give a block of threads: 99 KiB.
_MAX_SHARED_FLOATS = 99 * 256
# Edges of a frame whose depths are held that one block of threads takes.
_HELD_EDGES = 16


@dataclass(frozen=True, slots=True)
class Tail:
    """The last columns of the reduced system: free intrinsics of one camera after the other, then the right-hand side.

    Attributes:
        free: How many of log f and alpha are free.
        cameras: How many have them each for itself.
    """

    free: int
    cameras: int = 1

    @property
    def intrinsics(self) -> int:
        """Unknown intrinsics of all cameras."""
        return self.free * self.cameras

    @property
    def apart(self) -> bool:
        """Whether the two cameras of an edge have intrinsics of their own."""
        return self.free > 0 and self.cameras > 1

    @property
    def nodes(self) -> int:
        """Of six columns each."""
        return self.intrinsics // 6 + 1

    @property
    def product_stride(self) -> int:
        """Numbers that an edge leaves of the products of its rows."""
        return _PRODUCT_STRIDE[2 * self.free if self.apart else self.free]


@dataclass(frozen=True, slots=True)
class Layout:
    """What the kernels look up, and how many blocks of threads each needs.

    Attributes:
        tables: Arrays by their name in `Context`, int32 but for offsets in int64.
        num_large: Units too large for shared memory; they come first.
        shared_bytes: Dynamic shared memory of the pass over the others.
        scratch_stride: Numbers that a block of threads of the large ones needs instead.
        partial_size: Numbers in `partial`.
        pool_size, pool_parts: Blocks in each part of `pool`, and its parts (`_PARTS`).
        num_nodes: Unknown poses and views.
        level_tiles: (levels + 1) where the tiles of each level begin.
        level_columns: (levels + 1) where its columns begin.
    """

    tables: dict[str, Array]
    num_large: int
    shared_bytes: int
    scratch_stride: int
    partial_size: int
    pool_size: int
    pool_parts: int
    num_nodes: int
    level_tiles: tuple[int, ...]
    level_columns: tuple[int, ...]

    @property
    def num_units(self) -> int:
        return len(self.tables["unit_frame"])

    @property
    def num_blocks(self) -> int:
        return len(self.tables["block_row"])

    @property
    def num_tiles(self) -> int:
        return len(self.tables["tile_row"])

    @property
    def num_sides(self) -> int:
        return len(self.tables["column_diagonal"])


def unit_floats(count: int, depth_free: bool, tail: Tail) -> int:
    """Numbers for the rows and products of a tile of a unit of `count` edges (`TileLayout` of the kernel)."""
    slots = count + tail.nodes if depth_free else 0
    pairs = slots * (slots + 1) // 2
    groups = 1
    while groups < TILE // 4 and 2 * groups * pairs <= TILE_THREADS:
        groups *= 2
    stride = TILE + (4 * groups if groups < 8 else 0)
    by_camera = TILE_THREADS // 32 * tail.intrinsics * TILE if depth_free and tail.apart else 0
    return 6 * slots * stride + 36 * pairs * groups + count * tail.product_stride + by_camera


def build_layout(
    source: Ints,
    target: Ints,
    unknowns: Unknowns,
    free_depths: NDArray[np.bool_],
    cells: int,
    tail: Tail,
) -> Layout:
    """Lay out a graph.

    Args:
        source, target: (E,) frames of the edges, at least one edge.
        unknowns: What moves.
        free_depths: (N,).
        cells: Cells of a frame.
        tail: Which intrinsics are free.
    """
    num_frames, slices = len(free_depths), -(-cells // SLICE)
    order = np.argsort(source * num_frames + target, kind="stable")
    source, target = source[order], target[order]
    first = np.zeros(num_frames + 1, np.int64)
    first[1:] = np.cumsum(np.bincount(source, minlength=num_frames))

    units, num_large = _units(first, free_depths, tail)
    frame, begin, count, free = units.T
    poses, views, num_nodes = _nodes(unknowns, target, units)
    behind = _Behind(poses[unknowns.pose_of_frame], views[unknowns.view_of_frame], num_nodes, unknowns.rig)

    triangle = (count + tail.nodes) * (count + tail.nodes + 1) // 2 * free
    partial = (36 * triangle + count * tail.product_stride + 2) * slices
    direct = _starts((2 + tail.nodes) * count + 1 + tail.nodes + tail.nodes * (tail.nodes + 1) // 2)
    eliminated = direct[-1] + _starts((count + 1 + tail.nodes) * (count + 2 + tail.nodes) // 2 * free)
    tables = {
        "frame_node": behind.pose,
        "frame_view": unknowns.view_of_frame,
        "frame_camera": unknowns.view_of_frame * (unknowns.cameras > 1),
        "view_node": views,
        "node_view": _inverse(views, num_nodes),
        "edge_id": order,
        "edge_source": source,
        "edge_target": target,
        "unit_frame": frame,
        "unit_first": begin,
        "unit_count": count,
        "unit_free": free,
        "unit_partial": _starts(partial)[:-1],
        "unit_direct": direct[:-1],
        "unit_eliminated": eliminated[:-1],
    }
    floats = [unit_floats(int(n), bool(f), tail) for n, f in zip(count, free, strict=True)]
    tables |= _blocks(units, target, behind, tail.nodes, direct, eliminated)
    num_sides = (6 * num_nodes + tail.intrinsics) // SIDE + 1
    factor, level_tiles, level_columns = _factor(tables["block_row"], tables["block_column"], num_sides)
    tables |= factor
    wide = {"unit_partial", "unit_direct", "unit_eliminated"}
    return Layout(
        tables={name: table.astype(np.int64 if name in wide else np.int32) for name, table in tables.items()},
        num_large=num_large,
        shared_bytes=4 * (_FIXED_FLOATS + max(floats[num_large:], default=0)),
        scratch_stride=-(-max(floats[:num_large], default=0) // 4) * 4,
        partial_size=int(partial.sum()),
        pool_size=int(eliminated[-1]),
        pool_parts=behind.parts,
        num_nodes=num_nodes,
        level_tiles=level_tiles,
        level_columns=level_columns,
    )


LARGE_SHARED_BYTES = 4 * _FIXED_FLOATS
"""Dynamic shared memory of the pass over large units."""


def _starts(sizes: Ints) -> Ints:
    starts = np.zeros(len(sizes) + 1, np.int64)
    np.cumsum(sizes, out=starts[1:])
    return starts


def _units(first: Ints, free_depths: NDArray[np.bool_], tail: Tail) -> tuple[Ints, int]:
    """(U, 4) frame, first edge, edges, whether depths are free: large ones first, then by falling size."""
    rows: list[tuple[bool, int, int, int, bool]] = []
    for frame, free in enumerate(free_depths.tolist()):
        begin, end = int(first[frame]), int(first[frame + 1])
        piece = end - begin if free else _HELD_EDGES
        for start in range(begin, end, max(piece, 1)):
            count = min(piece, end - start)
            small = _FIXED_FLOATS + unit_floats(count, free, tail) <= _MAX_SHARED_FLOATS
            rows.append((small, -count, frame, start, free))
    rows.sort()
    units = np.array([(frame, start, -count, free) for _, count, frame, start, free in rows], np.int64)
    return units, sum(not small for small, *_ in rows)


@dataclass(frozen=True, slots=True)
class Unknowns:
    """Which poses and views move, of `vipe_core.ba.rigs.Unknowns`.

    Attributes:
        pose_of_frame, view_of_frame: (N,).
        poses: (R,) bool.
        views: (V,) bool.
        rig: Whether there is one.
        cameras: How many intrinsics there are: one, or one for each view.
    """

    pose_of_frame: Ints
    view_of_frame: Ints
    poses: NDArray[np.bool_]
    views: NDArray[np.bool_]
    rig: bool
    cameras: int


@dataclass(frozen=True, slots=True)
class _Behind:
    """(N,) nodes of the pose and of the view behind each frame, -1 where held."""

    pose: Ints
    view: Ints
    num_nodes: int
    rig: bool

    @property
    def parts(self) -> int:
        return 1 if not self.rig else 4 if (self.view >= 0).any() else 2


# Parts of `pool`: blocks of two frames, then, of a rig, what they say of two poses, of view and pose, pose and view.
_FRAMES, _POSES, _VIEW_POSE, _POSE_VIEW = range(4)


def _inverse(places: Ints, count: int) -> Ints:
    inverse = np.full(count, -1)
    inverse[places[places >= 0]] = np.flatnonzero(places >= 0)
    return inverse


def _nodes(unknowns: Unknowns, target: Ints, units: Ints) -> tuple[Ints, Ints, int]:
    """Place of each pose (R,) and view (V,) in the order of elimination, -1 where held; and how many there are.

    A frame with free depths couples all unknowns that see it.
    """
    free = np.concatenate((unknowns.poses, unknowns.views))
    number = np.where(free, np.cumsum(free) - 1, -1)
    pose = number[unknowns.pose_of_frame]
    view = number[len(unknowns.poses) + unknowns.view_of_frame]
    behind = [[node for node in both if node >= 0] for both in zip(pose.tolist(), view.tolist(), strict=True)]
    cliques: list[Sequence[int]] = []
    for frame, begin, count, depth_free in units.tolist():
        others = target[begin : begin + count].tolist()
        if depth_free:
            cliques.append([node for k in (frame, *others) for node in behind[k]])
        else:
            cliques += [behind[frame] + behind[other] for other in others]
    num_nodes = int(free.sum())
    place = np.append(block_cholesky.analyse(num_nodes, cliques, dense_last=0).place, -1)[number]
    return place[: len(unknowns.poses)], place[len(unknowns.poses) :], num_nodes


def _blocks(
    units: Ints, target: Ints, behind: _Behind, num_tail: int, direct: Ints, eliminated: Ints
) -> dict[str, Array]:
    """The blocks of the reduced system on and below the diagonal, and what each of them sums."""
    num_frames, num_nodes, size = len(behind.pose), behind.num_nodes + num_tail, int(eliminated[-1])
    pose = np.append(behind.pose, behind.num_nodes + np.arange(num_tail))
    view = np.append(behind.view, np.full(num_tail, -1))
    keys: list[Ints] = []
    entries: list[Ints] = []
    kinds: list[Ints] = []
    frames = np.full((2, size if behind.rig else 0), -1)

    def add(rows: Ints, columns: Ints, mixed: NDArray[np.bool_], block: Ints, kind: int) -> None:
        """Sum `block` into (row, column), or its transpose into (column, row); both where two slots are one node."""
        for flip, chosen in ((0, rows >= columns), (1, (rows < columns) | (rows == columns) & mixed)):
            use = chosen & (rows >= 0) & (columns >= 0)
            low, high = np.minimum(rows, columns)[use], np.maximum(rows, columns)[use]
            keys.append(high * num_nodes + low)
            entries.append(2 * block[use] + flip)
            kinds.append(np.full(int(use.sum()), kind))

    def add_slots(slots: Ints, rows: Ints, columns: Ints, block: Ints, kind: int) -> None:
        """Sum the blocks of pairs of slots of units, frames and then nodes of the tail, into what is behind them."""
        above, beside = slots[:, rows], slots[:, columns]
        mixed = np.broadcast_to(rows != columns, block.shape)
        if not behind.rig:
            add(pose[above], pose[beside], mixed, block, kind)
            return
        for number, some in enumerate((above, beside)):
            frames[number, block] = np.where(some < num_frames, some, -1)
        add(pose[above], pose[beside], mixed, block + _POSES * size, kind)
        if behind.parts > 2:
            add(view[above], view[beside], mixed, block + _FRAMES * size, kind)
            add(view[above], pose[beside], mixed, block + _VIEW_POSE * size, kind)
            # Of a slot with itself, that is the transpose of the one before.
            add(np.where(mixed, pose[above], -1), view[beside], mixed, block + _POSE_VIEW * size, kind)

    # Units of one shape at a time.
    for count, free in sorted({(int(c), int(f)) for c, f in units[:, 2:]}):
        chosen = np.flatnonzero((units[:, 2] == count) & (units[:, 3] == free))
        end = count + 1 + np.arange(num_tail)
        slots = np.empty((len(chosen), count + 1 + num_tail), np.int64)
        slots[:, 0] = units[chosen, 0]
        slots[:, 1:-num_tail] = target[units[chosen, 1][:, None] + np.arange(count)]
        slots[:, -num_tail:] = num_frames + np.arange(num_tail)
        # Per edge (target, target), (target, source), (tail, target); then (source, source) and so on.
        m = np.arange(1, count + 1)[:, None]
        rows = np.hstack((m, m, np.broadcast_to(end, (count, num_tail)))).ravel()
        columns = np.hstack((m, 0 * m, np.broadcast_to(m, (count, num_tail)))).ravel()
        corner = np.tril_indices(num_tail)
        rows = np.concatenate((rows, [0], end, end[corner[0]]))
        columns = np.concatenate((columns, [0], 0 * end, end[corner[1]]))
        add_slots(slots, rows, columns, direct[chosen][:, None] + np.arange(len(rows)), 0)
        if free:
            rows, columns = np.tril_indices(count + 1 + num_tail)
            add_slots(slots, rows, columns, eliminated[chosen][:, None] + np.arange(len(rows)), 1)

    key, entry, kind = np.concatenate(keys), np.concatenate(entries), np.concatenate(kinds)
    unique = np.unique(key)
    found: dict[str, Array] = {"block_row": unique // num_nodes, "block_column": unique % num_nodes}
    for name, code in (("direct", 0), ("eliminated", 1)):
        at = np.searchsorted(unique, key[kind == code])
        sorted_by = np.argsort(at, kind="stable")
        found[f"{name}_first"] = _starts(np.bincount(at, minlength=len(unique)))
        found[f"{name}_entry"] = entry[kind == code][sorted_by]
    nodes = np.arange(num_nodes)
    found["diagonal_block"] = np.searchsorted(unique, nodes * num_nodes + nodes)
    found["pool_row"], found["pool_column"] = frames
    return found


def _factor(
    block_row: Ints, block_column: Ints, num_sides: int
) -> tuple[dict[str, Array], tuple[int, ...], tuple[int, ...]]:
    """Tiles of the factor with its fill, by the level at which their column can be eliminated."""
    below: list[set[int]] = [{num_sides - 1} for _ in range(num_sides)]
    row_side, column_side = block_row // SIDE_BLOCKS, block_column // SIDE_BLOCKS
    for row, column in {*zip(row_side.tolist(), column_side.tolist(), strict=True)}:
        below[column].add(row)
    for column in range(num_sides):
        below[column].discard(column)
        if below[column]:
            below[min(below[column])] |= below[column]
    before: list[list[int]] = [[] for _ in range(num_sides)]
    level = [0] * num_sides
    for column in range(num_sides):
        level[column] = 1 + max((level[k] for k in before[column]), default=-1)
        for row in below[column]:
            if row != column:
                before[row].append(column)

    columns = sorted(range(num_sides), key=lambda j: (level[j], j))
    tiles = [(i, j) for j in columns for i in (j, *sorted(below[j] - {j}))]
    number = {tile: k for k, tile in enumerate(tiles)}
    products = [[(number[i, k], number[j, k]) for k in before[j] if i == j or i in below[k]] for i, j in tiles]
    flat = np.array([pair for some in products for pair in some], np.int64).reshape(-1, 2)
    lower = [[number[i, j] for i in sorted(below[j] - {j})] for j in range(num_sides)]
    of_block = np.array([number[tile] for tile in zip(row_side.tolist(), column_side.tolist(), strict=True)])
    table: dict[str, Array] = {
        "tile_row": np.array([i for i, _ in tiles]),
        "tile_column": np.array([j for _, j in tiles]),
        "tile_first": _starts(np.array([len(some) for some in products])),
        "product_left": flat[:, 0],
        "product_right": flat[:, 1],
        "tile_block_first": _starts(np.bincount(of_block, minlength=len(tiles))),
        "tile_block": np.argsort(of_block, kind="stable"),
        "column_diagonal": np.array([number[j, j] for j in range(num_sides)]),
        "column_first": _starts(np.array([len(some) for some in lower])),
        "column_tile": np.array([tile for some in lower for tile in some], np.int64),
        "level_column": np.array(columns),
    }
    per_column = np.array([1 + len(lower[j]) for j in columns])
    sizes = np.bincount([level[j] for j in columns])
    level_columns = _starts(sizes)
    level_tiles = _starts(per_column)[level_columns]
    return table, tuple(level_tiles.tolist()), tuple(level_columns.tolist())
