"""How much memory a clip takes on its device: planned from sizes, before anything is allocated.

What grows with the clip is keyframes alone: their features, contexts and depths. The window, the global pass and the
frames between keyframes have bounds of their own; the largest of the three counts.
"""

from __future__ import annotations

from dataclasses import dataclass

from vipe_core.ba.problem import Grid
from vipe_core.priors.droid.correlation import LEVELS, NUM_CHANNELS

# Channels of an edge that live through an update: state, context, both inputs of the GRU and its gates.
_LIVE_CHANNELS = 128 * 2 + 448 * 2 + 128 * 4
# Channels of what captured graphs keep beside that, for numbers of edges that are not captured yet need their own: the
# inputs, what they work in, and an answer for each of a few numbers of edges. `benchmarks.gpu_memory` counts them.
_CAPTURED_CHANNELS = 128 * 2 + NUM_CHANNELS + 4 + _LIVE_CHANNELS + 5 * 128
# Features and context of a keyframe, and the copies of the features that products on the fly are made of.
_KEYFRAME_CHANNELS = 128 * (3 + 7 / 3)
# Source frames of a part of the global pass, and edges out of each.
_LEAN_EDGES = 8 * 16
# What torch, cuDNN and the context of a process take on a GPU, with their workspace.
_PROCESS_BYTES = 900 << 20
# Of a cell of an edge in the global graph: where it was seen, its weight, and the rows of the elimination.
_MEASURED_BYTES = 2 * 16


@dataclass(frozen=True, slots=True)
class MemoryPlan:
    """Bytes of a clip on its device.

    Attributes:
        process_bytes: Of the process, whatever it works on.
        weight_bytes: Of networks, which stay.
        keyframe_bytes: Features and contexts of all keyframes, and of the frames that are kept.
        graph_bytes: States and measurements of the global graph.
        work_bytes: The largest of what the window, the global pass, the frames in between and other networks need for a
            time.
    """

    process_bytes: int
    weight_bytes: int
    keyframe_bytes: int
    graph_bytes: int
    work_bytes: int

    @property
    def total_bytes(self) -> int:
        return self.process_bytes + self.weight_bytes + self.keyframe_bytes + self.graph_bytes + self.work_bytes


def plan_memory(
    grid: Grid,
    *,
    keyframes: int,
    window_edges: int,
    edges_per_keyframe: int,
    most_edges: int,
    fill_frames: int,
    cache_bytes: int,
    lean: bool,
    refined: bool = True,
    weight_bytes: int = 0,
    other_work_bytes: int = 0,
    value_bytes: int = 2,
) -> MemoryPlan:
    """The plan of a clip.

    Args:
        grid: Cells of its working pictures.
        keyframes: That it will have, about.
        window_edges: Most edges of the window.
        edges_per_keyframe: Most edges of the global graph ...
        most_edges: ... and of all of it, but for those to the three keyframes on either side.
        fill_frames: Frames between keyframes that are posed at once, from two keyframes each.
        cache_bytes: Of features of frames that are kept from pass to pass.
        lean: In the low-memory profile: without volumes of correlation, and the states of the global graph on the host.
        refined: Measurements are the network's; else only bundle adjustment is on the device.
        weight_bytes: Of all networks.
        other_work_bytes: What networks other than this one work in, which is before or after it.
        value_bytes: Of a feature: 2 on a GPU.
    """
    cells = grid.num_cells
    graph_edges = min(edges_per_keyframe * keyframes, max(most_edges, 6 * keyframes))
    if not refined:
        return MemoryPlan(_PROCESS_BYTES, weight_bytes, 0, graph_edges * cells * _MEASURED_BYTES, other_work_bytes)
    volume_bytes = 0 if lean else _volume_bytes(grid, value_bytes)
    update_bytes = cells * (value_bytes * (_LIVE_CHANNELS + NUM_CHANNELS + _CAPTURED_CHANNELS) + 4 * 8)
    at_once = max(window_edges, 2 * fill_frames)
    work_bytes = max(at_once * (update_bytes + 2 * volume_bytes), _LEAN_EDGES * update_bytes, other_work_bytes)
    return MemoryPlan(
        process_bytes=_PROCESS_BYTES,
        weight_bytes=weight_bytes,
        keyframe_bytes=cache_bytes + int(keyframes * cells * (_KEYFRAME_CHANNELS * value_bytes + 8)),
        graph_bytes=graph_edges * cells * (_MEASURED_BYTES + (0 if lean else 128 * value_bytes)),
        work_bytes=work_bytes,
    )


def _volume_bytes(grid: Grid, value_bytes: int) -> int:
    """Of one edge's correlations, with their pyramid."""
    return grid.num_cells * value_bytes * sum(grid.num_cells >> (2 * level) for level in range(LEVELS))
