"""The principal point: found where the camera turns, left alone where it is right."""

from __future__ import annotations

import numpy as np
import torch
from exact_scene import GRID, WIDTH, ExactScene, trajectory

from vipe_core.slam.adjustment import REFINE, Adjuster, FocalPrior
from vipe_core.slam.centring import refine_principal_point
from vipe_core.slam.graph import Graph
from vipe_core.slam.keyframes import KeyframeMap
from vipe_core.slam.selection import Keyframe
from vipe_core.slam.settings import SlamSettings

COUNT = 12


def adjusted(offset_px: float, count: int = COUNT) -> tuple[KeyframeMap, Graph, Adjuster]:
    """A map of exact measurements by a turning camera, adjusted with a principal point that is off by `offset_px`."""
    scene = ExactScene(trajectory(count, (0.12, 0.01, 0.02, 0.004, -0.05, 0.003)))
    intrinsics = np.array(scene.params)
    intrinsics[2] += offset_px
    keyframes, graph = KeyframeMap(GRID, "pinhole", intrinsics), Graph()
    noise = np.random.default_rng(0)
    for k in range(count):
        keyframes.append(Keyframe(k, k), k / 30.0, scene.cam_from_world[k], scene.inverse_depth[k])
        for i in range(max(0, k - 3), k):
            for source, target in ((i, k), (k, i)):
                match = scene.measure(source, target)
                match.target_px[:] += noise.normal(0, 0.05, match.target_px.shape).astype(np.float32)
                graph.add(source, target, match)
    prior = FocalPrior(float(np.log(scene.params[0])), 0.05)
    adjuster = Adjuster(SlamSettings(), torch.device("cpu"), prior, WIDTH / 640)
    adjuster.adjust(keyframes, graph, range(count), (0,), REFINE, free_focal=True)
    return keyframes, graph, adjuster


def test_a_principal_point_that_is_off_is_found() -> None:
    keyframes, graph, adjuster = adjusted(3.0)
    truth = (WIDTH - 1) / 2
    assert refine_principal_point(keyframes, graph, adjuster)
    assert abs(keyframes.intrinsics[2] - truth) < 1.5


def test_a_right_principal_point_and_a_short_map_stay_as_they_are() -> None:
    for offset_px, count in ((0.0, COUNT), (3.0, 5)):
        keyframes, graph, adjuster = adjusted(offset_px, count)
        before = keyframes.snapshot()
        assert not refine_principal_point(keyframes, graph, adjuster)
        np.testing.assert_array_equal(keyframes.poses(), before.poses)
        np.testing.assert_array_equal(keyframes.depths(), before.depths)
        np.testing.assert_array_equal(keyframes.intrinsics, before.intrinsics)


def test_what_the_halves_of_a_map_do_not_agree_on_moves_nothing() -> None:
    keyframes, graph, adjuster = adjusted(0.0)
    noise = np.random.default_rng(1)
    # Something else than the lens bends each half its own way.
    for i, j in list(graph):
        match = graph[i, j]
        radius = (match.target_px[:, 0] - WIDTH / 2) / WIDTH
        sign = 1.0 if i + j < COUNT - 1 else -1.0
        match.target_px[:, 0] += (sign * 2.0 * radius**2 + noise.normal(0, 0.02, radius.shape)).astype(np.float32)
    before = keyframes.intrinsics[2]
    refine_principal_point(keyframes, graph, adjuster)
    assert abs(keyframes.intrinsics[2] - before) < 1.0
