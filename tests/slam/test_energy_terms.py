"""Each switch of the ablation takes its term out of the energy, and shows in the configuration's hash."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest
import torch
from exact_scene import GRID, ExactScene, trajectory

from vipe_core.errors import ConfigError
from vipe_core.pipeline.presets import Preset, resolve
from vipe_core.priors.protocols import Match, PriorFamily
from vipe_core.slam.graph import Graph
from vipe_core.slam.keyframes import KeyframeMap
from vipe_core.slam.measuring import MeasuredGraph
from vipe_core.slam.selection import Keyframe
from vipe_core.slam.settings import EnergyTerms, SlamSettings
from vipe_core.slam.system import Slam, SlamResult

ARC = (0.05, 0.006, 0.012, 0.002, -0.015, 0.001)
SHIFT_PX = 0.2
OFF = {
    "dense_flow": EnergyTerms(dense_flow=False),
    "sparse_tracks": EnergyTerms(sparse_tracks=False),
    "depth_prior": EnergyTerms(depth_prior=False),
    "motion_masks": EnergyTerms(motion_masks=False),
}


class ShiftedTracks:
    """Tracks in every third cell, a fifth of a pixel away from the dense measurement: what tells the two apart."""

    def match(self, source: int, target: int, dense: Match) -> Match:
        weight = np.zeros_like(dense.weight)
        weight[::3] = 4 * dense.weight[::3]
        return Match(dense.target_px + np.float32(SHIFT_PX), weight, 1.0)


class BlobScene(ExactScene):
    """A patch of the picture moves by itself: what the masks are for."""

    def measure(self, i: int, j: int) -> Match:
        match = super().measure(i, j)
        grid = match.target_px.reshape(18, 24, 2)
        grid[6:12, 8:16, 1] += 1.5 * (j - i)  # across the direction of travel: no depth explains it
        return match


@functools.cache
def run(terms: EnergyTerms) -> SlamResult:
    scene = BlobScene(trajectory(10, ARC))
    priors = dataclasses.replace(scene.priors(), tracker=ShiftedTracks())
    return Slam(priors, SlamSettings(terms=terms), torch.device("cpu")).run(scene, lambda *_: None)


@pytest.mark.parametrize("name", OFF)
def test_a_switch_changes_the_result(name: str) -> None:
    result = run(OFF[name])
    assert np.isfinite(result.world_from_cam).all()
    assert not np.array_equal(result.world_from_cam, run(EnergyTerms()).world_from_cam)


def test_masks_are_found_only_where_they_are_on() -> None:
    assert not run(EnergyTerms()).static.all()
    assert run(OFF["motion_masks"]).static.all()


@pytest.mark.parametrize("sparse", [True, False])
@pytest.mark.parametrize("dense_flow", [True, False])
def test_what_is_filed_in_the_graph(sparse: bool, dense_flow: bool) -> None:
    scene = ExactScene(trajectory(2, ARC))
    keyframes = KeyframeMap(GRID, "pinhole", scene.params)
    for k in range(2):
        keyframes.append(Keyframe(k, k), k / 30, np.eye(4), np.ones(GRID.num_cells))
    graph = Graph()
    tracks = ShiftedTracks() if sparse else None
    measured = MeasuredGraph(keyframes, graph, scene, tracks, None, scene.reprojector, dense_flow=dense_flow)
    measured.connect(0, 1, guided=False)
    dense = scene.measure(0, 1)
    shift_px, seen = graph[0, 1].target_px - dense.target_px, dense.weight[:, 0] > 0
    tracked = seen & (np.arange(GRID.num_cells) % 3 == 0)
    if not sparse:
        np.testing.assert_array_equal(shift_px, 0)
        np.testing.assert_array_equal(graph[0, 1].weight, dense.weight)
    elif dense_flow:
        np.testing.assert_allclose(shift_px[tracked], 0.8 * SHIFT_PX, atol=1e-4)
        np.testing.assert_array_equal(shift_px[seen & ~tracked], 0)
        assert (graph[0, 1].weight[seen] > 0).all()
    else:
        np.testing.assert_allclose(shift_px[tracked], SHIFT_PX, atol=1e-4)
        np.testing.assert_array_equal(graph[0, 1].weight[:, 0] > 0, tracked)


def test_the_hash_tells_the_terms_apart() -> None:
    base = resolve("classical")

    def preset(terms: EnergyTerms) -> Preset:
        return dataclasses.replace(base, slam=dataclasses.replace(base.slam, terms=terms))

    hashes = {preset(terms).config_hash for terms in (EnergyTerms(), *OFF.values())}
    assert len(hashes) == 5
    assert preset(EnergyTerms()).config_hash == base.config_hash


def test_something_must_be_measured() -> None:
    with pytest.raises(ConfigError, match="must be on"):
        EnergyTerms(dense_flow=False, sparse_tracks=False)
    scene = ExactScene(trajectory(3, ARC))
    priors: PriorFamily = scene.priors()
    with pytest.raises(ConfigError, match="sparse tracks"):
        Slam(priors, SlamSettings(terms=OFF["dense_flow"]), torch.device("cpu"))
