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
# Source frames of a part of the global pass, and edges out of each.
_LEAN_EDGES = 8 * 16
# What torch, cuDNN and the context of a process take on a GPU, and the network with its workspace.
_PROCESS_BYTES = 900 << 20


@dataclass(frozen=True, slots=True)
class MemoryPlan:
    """Bytes of a clip on its device.

    Attributes:
        process_bytes: Of the process, whatever it works on.
        keyframe_bytes: Features and contexts of all keyframes, and of the frames that are kept.
        graph_bytes: States and measurements of the global graph.
        work_bytes: The largest of what the window, the global pass and the frames in between need for a time.
    """

    process_bytes: int
    keyframe_bytes: int
    graph_bytes: int
    work_bytes: int

    @property
    def total_bytes(self) -> int:
        return self.process_bytes + self.keyframe_bytes + self.graph_bytes + self.work_bytes

    def slots(self, device_bytes: int) -> int:
        """Clips like this one that fit on a device at once; 0 where not even one does."""
        return int(0.9 * device_bytes) // self.total_bytes


def volumes_fit(grid: Grid, edges: int, device_bytes: int) -> bool:
    """Whether volumes of correlation of so many edges leave most of a device to others."""
    return 4 * edges * _volume_bytes(grid, 2) <= device_bytes


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
        lean: Without volumes of correlation; see `Refiner.begin`.
        value_bytes: Of a feature: 2 on a GPU.
    """
    cells = grid.num_cells
    volume_bytes = 0 if lean else _volume_bytes(grid, value_bytes)
    update_bytes = cells * (value_bytes * (_LIVE_CHANNELS + NUM_CHANNELS) + 4 * 8)
    at_once = max(window_edges, 2 * fill_frames)
    graph_edges = min(edges_per_keyframe * keyframes, max(most_edges, 6 * keyframes))
    return MemoryPlan(
        process_bytes=_PROCESS_BYTES,
        keyframe_bytes=cache_bytes + keyframes * cells * (3 * 128 * value_bytes + 8),
        graph_bytes=graph_edges * cells * (128 * value_bytes + 2 * 16),
        work_bytes=max(at_once * (update_bytes + 2 * volume_bytes), _LEAN_EDGES * update_bytes),
    )


def _volume_bytes(grid: Grid, value_bytes: int) -> int:
    """Of one edge's correlations, with their pyramid."""
    return grid.num_cells * value_bytes * sum(grid.num_cells >> (2 * level) for level in range(LEVELS))
