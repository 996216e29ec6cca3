"""Tracks as measurements of edges: which point speaks for a cell, and what joins the network's answer."""

from __future__ import annotations

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st

from vipe_core.ba.problem import Grid
from vipe_core.priors.protocols import TrackedPoints
from vipe_core.slam.recurrent.tracks import EdgeTracks, shared_points

GRID = Grid(6, 8)
CPU = torch.device("cpu")


def points(ids: list[int], px: list[tuple[float, float]]) -> TrackedPoints:
    return TrackedPoints(np.array(ids, np.int64), np.array(px, np.float32).reshape(-1, 2))


@given(st.integers(0, 2**32 - 1), st.integers(0, 60), st.integers(0, 60))
def test_each_cell_has_the_shared_point_nearest_to_its_sample(seed: int, first: int, second: int) -> None:
    rng = np.random.default_rng(seed)

    def frame(count: int) -> TrackedPoints:
        return TrackedPoints(rng.choice(80, count, replace=False), rng.uniform(0, 48, (count, 2)).astype(np.float32))

    source, target = frame(first), frame(second)
    found = shared_points(GRID, source, target)
    assert (np.diff(found.cells) > 0).all()
    place = dict(zip(source.ids.tolist(), source.px, strict=True))
    there = dict(zip(target.ids.tolist(), target.px, strict=True))
    best: dict[int, tuple[float, int]] = {}
    for one in sorted(place.keys() & there.keys()):
        column, row = np.rint((place[one] - np.float32(3.5)) / 8).astype(int)
        if 0 <= column < 8 and 0 <= row < 6:
            away = float(np.square((place[one] - np.float32(3.5)) / 8 - np.array([column, row])).sum())
            cell = int(row * 8 + column)
            best[cell] = min(best.get(cell, (np.inf, -1)), (away, one))
    assert found.cells.tolist() == sorted(best)
    for cell, source_px, target_px in zip(found.cells, found.source_px, found.target_px, strict=True):
        np.testing.assert_array_equal(source_px, place[best[int(cell)][1]])
        np.testing.assert_array_equal(target_px, there[best[int(cell)][1]])


def test_a_track_shares_a_cell_evenly_with_the_network_by_what_it_found_beyond_the_flow_at_its_place() -> None:
    # The flow grows by a tenth of the column; the track is 3 px right of its cell's sample and 1 px off the flow.
    own = GRID.sample_px(torch.float32)
    target_px = (own + torch.stack((0.1 * own[:, 0], torch.zeros(GRID.num_cells)), dim=1))[None]
    weight = torch.full((1, GRID.num_cells, 2), 0.25)
    x, y = 3.5 + 2 * 8 + 3, 3.5 + 8
    tracks = EdgeTracks(GRID, {0: points([7], [(x, y)]), 4: points([7], [(1.1 * x + 1, y)])}, CPU)
    tracks.add([(0, 4)])
    joined_px, joined_weight = tracks.joined(target_px, weight)
    cell = 8 + 2
    torch.testing.assert_close(joined_px[0, cell], target_px[0, cell] + torch.tensor([0.5, 0.0]), atol=1e-4, rtol=0)
    assert joined_weight[0, cell].tolist() == [0.5, 0.5]
    others = torch.arange(GRID.num_cells) != cell
    assert torch.equal(joined_px[:, others], target_px[:, others])
    assert torch.equal(joined_weight[:, others], weight[:, others])


def test_what_contradicts_the_network_or_lies_where_it_trusts_nothing_changes_nothing() -> None:
    own = GRID.sample_px(torch.float32)
    target_px, weight = own[None].clone(), torch.ones(1, GRID.num_cells, 2)
    weight[0, 9] = 0
    # The thing on the right moves by itself: what is between it and the scene belongs to neither.
    target_px[0, own[:, 0] > 35, 0] += 20
    at = {"far off": (11.5, 3.5), "not trusted": (11.5, 11.5), "on an edge": (32.0, 20.0)}
    seen = {
        0: points([0, 1, 2], list(at.values())),
        1: points([0, 1, 2], [(11.5 + 2.1, 3.5), (11.5 + 1, 11.5), (32.0 + 10, 20.0)]),
    }
    tracks = EdgeTracks(GRID, seen, CPU)
    tracks.add([(0, 1)])
    joined_px, joined_weight = tracks.joined(target_px, weight)
    assert torch.equal(joined_px, target_px)
    assert torch.equal(joined_weight, weight)


def test_rows_stay_with_their_edges_and_frames_without_tracks_have_none() -> None:
    own = GRID.sample_px(torch.float32)
    seen = {frame: points([0], [(11.5 + frame / 4, 11.5)]) for frame in (0, 1, 2)}
    tracks = EdgeTracks(GRID, seen, CPU)
    tracks.add([(0, 1), (0, 9)])
    tracks.add([(0, 2)])
    tracks.keep([1, 2])
    joined_px, _ = tracks.joined(own.repeat(2, 1, 1), torch.ones(2, GRID.num_cells, 2))
    moved = (joined_px - own)[..., 0]
    assert moved[0].abs().max() == 0
    assert moved[1, 9].item() == 0.25
    assert moved[1].count_nonzero() == 1
    tracks.keep([])
    empty = torch.zeros(0, GRID.num_cells, 2)
    assert tracks.joined(empty, empty)[0].shape == empty.shape
