"""The schedule of refinement: the numbers of DROID-SLAM (Teed & Deng, NeurIPS 2021), as the paper takes them over.

Lengths are pixels of a working image that is 640 wide, like those of `SlamSettings`; there they are cells of an image
512 wide, and a cell of that is 10 pixels here.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class RefinementSettings:
    """Settings of the map where measurements are refined in turns with it.

    Attributes:
        first_neighbours: Keyframes on either side that each of the first ones is linked with.
        first_updates: Updates of the first keyframes, before and after close ones are linked.
        updates: Updates after a new keyframe.
        more_updates: Further updates if it stays.
        iterations: Gauss-Newton steps after each update.
        redundant_px: The keyframe before the newest is dropped when it is nearer than this to the one before.
        rotation_share: How much of a distance is the whole displacement; the rest is what translation alone makes.
        least_seen: Least share of cells in front of the other camera for there to be a distance at all.
        neighbours: Keyframes before that each is linked with in any case.
        recent: New links start at so many of the last keyframes ...
        window: ... and end at so many.
        window_px: Farthest pair that is linked in the window.
        window_gap: Links are kept this many steps apart.
        window_edges: Most edges that are refined at a time.
        oldest: Edges are refined for so many updates; then they keep what they measured.
        reused: Edges that are not refined any more take part when both ends are at most this far before the window.
        global_px: Farthest pair that is linked in a global adjustment.
        global_gap: Links there are kept this many steps apart.
        global_edges: Most edges per keyframe there ...
        global_most_edges: ... and in all, but for those to neighbours: bounds the memory of long videos.
        global_updates: Updates of a global adjustment on the way, of the first and of the second at the end.
        global_iterations: Gauss-Newton steps after each of these updates.
        fill_updates: Updates of the frames between keyframes.
        metric_information: Information of metric depth, where there is any, on an inverse depth in units of the map's
            median: the paper's 0.001 per (1/m)^2, beside 0.001 per squared cell, for a median depth of 3 m.
        lean: The low-memory profile: the window and the frames between keyframes, too, go without volumes of
            correlation, and the states of whole graphs lie on the host; see `Refiner.begin`.
    """

    first_neighbours: int = 3
    first_updates: int = 8
    updates: int = 4
    more_updates: int = 2
    iterations: int = 3
    redundant_px: float = 40.0
    rotation_share: float = 0.3
    least_seen: float = 0.75
    neighbours: int = 3
    recent: int = 5
    window: int = 25
    window_px: float = 160.0
    window_gap: int = 1
    window_edges: int = 48
    oldest: int = 25
    reused: int = 3
    global_px: float = 220.0
    global_gap: int = 3
    global_edges: int = 16
    global_most_edges: int = 6000
    global_updates: tuple[int, int, int] = (5, 7, 24)
    global_iterations: int = 8
    fill_updates: int = 10
    metric_information: float = 7.0
    lean: bool = False
