"""A change of the focal length within a shot, from exact measurements with a little noise."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
import torch

from vipe_core.ba.problem import Grid
from vipe_core.cameras import Camera
from vipe_core.geometry.arrays import exp, inverse
from vipe_core.priors.protocols import Match
from vipe_core.slam.adjustment import REFINE, Adjuster, FocalPrior
from vipe_core.slam.graph import Graph
from vipe_core.slam.keyframes import KeyframeMap
from vipe_core.slam.selection import Keyframe
from vipe_core.slam.settings import SlamSettings
from vipe_core.slam.zoom import Zoom, find_zoom

GRID = Grid(15, 20, 16.0, 7.5)
CAMERA = Camera.pinhole_from_fov(60.0, 320, 240)
COUNT = 9
AROUND = (-0.12, 0.01, 0.03, 0.0, 0.06, 0.01)
TURN = (0.0, 0.0, 0.0, 0.01, 0.05, 0.0)
AHEAD = (0.0, 0.0, -0.15, 0.0, 0.0, 0.0)


def zoom_of(step: Sequence[float], focal: Sequence[float], camera: Camera = CAMERA) -> Zoom:
    """Of a map with one focal length, of a camera that makes `step` (a twist) from keyframe to keyframe, its focal
    length times `focal`."""
    rng = np.random.default_rng(4)
    poses = [exp(np.array(step) * k) for k in range(COUNT)]
    keyframes, graph = KeyframeMap(GRID, camera.model, camera.index_params()), Graph()
    px = GRID.sample_px().numpy().astype(np.float64)
    for k, pose in enumerate(poses):
        distance = rng.uniform(1, 4, (GRID.num_cells, 1))
        points = camera.zoomed(focal[k]).unproject(px) * distance
        keyframes.append(Keyframe(k, None), k / 10, pose, 1 / distance[:, 0])
        for j in (k - 2, k - 1, k + 1, k + 2):
            if 0 <= j < COUNT:
                target_from_source = poses[j] @ inverse(pose)
                moved = points @ target_from_source[:3, :3].T + target_from_source[:3, 3]
                seen, imaged = camera.zoomed(focal[j]).project(moved)
                seen += rng.normal(0, 0.1, seen.shape)
                weight = np.repeat(np.where(imaged, 4.0, 0.0)[:, None], 2, axis=1).astype(np.float32)
                graph.add(k, j, Match(seen.astype(np.float32), weight, 1.0))
    settings = SlamSettings()
    prior = FocalPrior(math.log(camera.focal_px), 0.1)
    adjuster = Adjuster(settings, torch.device("cpu"), prior, 0.5)
    adjuster.adjust(keyframes, graph, range(COUNT), [0], REFINE, free_focal=True)
    return find_zoom(keyframes, graph, adjuster, 0.5)


@pytest.mark.parametrize("step", [AROUND, TURN, (0.0,) * 6])
def test_a_zoom_is_told_from_none(step: Sequence[float]) -> None:
    zooming = zoom_of(step, np.geomspace(1, 1.5, COUNT))
    assert zooming.changes
    assert zooming.ratio == pytest.approx(1.5, abs=0.1)
    assert not zoom_of(step, [1.0] * COUNT).changes


def test_zooming_out_is_a_zoom_too_and_a_bent_lens_can_zoom() -> None:
    camera = Camera("mei", (220.0, 220.0, 160.0, 120.0, 0.6), 320, 240)
    assert zoom_of(AROUND, np.geomspace(1.5, 1, COUNT), camera).changes
    assert not zoom_of(AROUND, [1.0] * COUNT, camera).changes


def test_travelling_ahead_is_no_zoom() -> None:
    assert not zoom_of(AHEAD, [1.0] * COUNT).changes


def test_a_shot_of_one_keyframe_has_none() -> None:
    keyframes = KeyframeMap(GRID, "pinhole", CAMERA.index_params())
    keyframes.append(Keyframe(0, None), 0.0, np.eye(4), np.ones(GRID.num_cells))
    adjuster = Adjuster(SlamSettings(), torch.device("cpu"), FocalPrior(0.0, 0.1), 0.5)
    found = find_zoom(keyframes, Graph(), adjuster, 0.5)
    assert (found.ratio, found.changes) == (1.0, False)
    assert math.isnan(found.sigma)
