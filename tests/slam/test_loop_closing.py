"""Loops: recognising a place, relaxing a pose graph with scale drift, closing a drifted map, refusing a false loop."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from exact_scene import GRID, ExactScene, trajectory
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from vipe_core.geometry import umeyama
from vipe_core.geometry.arrays import inverse
from vipe_core.geometry.sim3 import Sim3
from vipe_core.priors.protocols import Correspondences
from vipe_core.slam.adjustment import Adjuster, FocalPrior
from vipe_core.slam.closing import LoopCloser
from vipe_core.slam.graph import Graph
from vipe_core.slam.guessing import displacement_guess
from vipe_core.slam.keyframes import KeyframeMap
from vipe_core.slam.measuring import MeasuredGraph
from vipe_core.slam.places import similarity
from vipe_core.slam.posegraph import SimLink, relax
from vipe_core.slam.selection import Keyframe
from vipe_core.slam.settings import SlamSettings


def _unit(values: NDArray[np.float32]) -> NDArray[np.float32]:
    return values / np.linalg.norm(values, axis=1, keepdims=True)


class Places:
    """A matcher of points that recognises frames by the number of the place they were told to show."""

    def __init__(self, scene: ExactScene, places: list[int], *, shift_px: float = 0.0) -> None:
        self.scene, self.places, self.shift_px = scene, places, shift_px

    def overview(self, features: int) -> NDArray[np.float32]:
        shared = np.random.default_rng(1000 + self.places[features]).normal(size=(80, 32))
        noise = np.random.default_rng(features).normal(size=(80, 32))
        return _unit((shared + 0.1 * noise).astype(np.float32))

    def correspond(self, source: int, target: int) -> Correspondences:
        if self.places[source] != self.places[target]:
            return Correspondences.none()
        match = self.scene.measure(source, target)
        seen = match.weight[:, 0] > 0
        return Correspondences(GRID.sample_px().numpy()[seen].astype(np.float32), match.target_px[seen])


def there_and_back(half: int) -> NDArray[np.float64]:
    out = trajectory(half, (0.16, 0.0, 0.01, 0.0, -0.03, 0.0))
    return np.concatenate([out, out[::-1]])


class Drifted:
    """A map of a walk there and back whose every step is right in itself but a little too long and turned.

    Args:
        lie: Shift of the loop's measurement, pixels: a false loop that only looks right.
    """

    def __init__(self, half: int, scale_per_step: float, turn_per_step: float, lie: bool = False) -> None:
        self.truth = there_and_back(half)
        count = len(self.truth)
        self.scene = ExactScene(self.truth)
        self.keyframes = KeyframeMap(GRID, "pinhole", self.scene.params)
        graph = Graph()
        places = [min(k, count - 1 - k) // 2 for k in range(count)]
        adjuster = Adjuster(
            SlamSettings(), torch.device("cpu"), FocalPrior(float(np.log(self.scene.params[0])), 0.05), 1.0
        )
        reprojector = self.scene.reprojector
        matcher = _Liar(self.scene, half) if lie else self.scene
        measured = MeasuredGraph(self.keyframes, graph, matcher, None, Places(self.scene, places), reprojector)
        node = Sim3(1.0, self.truth[0][:3, :3], self.truth[0][:3, 3])
        drift = Rotation.from_rotvec([0, turn_per_step, 0]).as_matrix()
        for k in range(count):
            if k > 0:
                step = self.truth[k] @ inverse(self.truth[k - 1])
                node = Sim3(scale_per_step, drift @ step[:3, :3], step[:3, 3]) @ node
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = node.rotation, node.translation / node.scale
            self.keyframes.append(Keyframe(k, k), k / 30.0, pose, self.scene.inverse_depth[k] * node.scale)
        for k in range(1, count):
            for i in range(max(0, k - 2), k):
                measured.connect(i, k, guided=False)
        self.measured = measured
        self.closer = LoopCloser(measured, adjuster, reprojector)

    def error(self) -> float:
        """RMS of the positions after the best similarity, share of the path."""
        truth, found = inverse(self.truth)[:, :3, 3], inverse(self.keyframes.poses())[:, :3, 3]
        path = np.linalg.norm(np.diff(truth, axis=0), axis=1).sum()
        apart = umeyama(found, truth).apply(found) - truth
        return float(np.sqrt(np.square(apart).sum(axis=1).mean()) / path)


class _Liar(ExactScene):
    """Measures loops between other places than it shows: consistent in itself, and wrong."""

    def __init__(self, scene: ExactScene, half: int) -> None:
        self.__dict__.update(scene.__dict__)
        self._half = half

    def match(self, source: int, target: int, guess_px: object = None):
        there, back = self.measure(source, target), self.measure(target, source)
        if abs(target - source) > 2:
            wrong = (source + 5) % self._half
            there, back = self.measure(wrong, target), self.measure(target, wrong)
        return there, back


def test_a_drifted_map_closes_its_loop_with_its_scale() -> None:
    drifted = Drifted(12, 1.03, 0.006)
    before = drifted.error()
    assert before > 0.02
    assert drifted.closer.run() >= 1
    assert drifted.error() < 0.05 * before


def test_a_map_that_agrees_with_its_loops_is_not_moved() -> None:
    drifted = Drifted(12, 1.0, 0.0)
    poses = drifted.keyframes.poses()
    assert drifted.closer.run() == 0
    np.testing.assert_array_equal(drifted.keyframes.poses(), poses)


def test_a_false_loop_is_refused_and_leaves_no_trace() -> None:
    drifted = Drifted(12, 1.0, 0.0, lie=True)
    poses, depths, edges = drifted.keyframes.poses(), drifted.keyframes.depths(), list(drifted.measured.graph)
    assert drifted.closer.run() == 0
    np.testing.assert_array_equal(drifted.keyframes.poses(), poses)
    np.testing.assert_array_equal(drifted.keyframes.depths(), depths)
    assert list(drifted.measured.graph) == edges


def test_the_same_place_is_the_most_similar() -> None:
    scene = ExactScene(trajectory(2, (0, 0, 0, 0, 0, 0)))
    order = [3, 1, 4, 0, 2, 4, 1, 0, 2, 3]
    looks = Places(scene, order)
    alike = similarity(len(order), looks.overview)
    np.fill_diagonal(alike, -np.inf)
    assert [order[k] for k in alike.argmax(axis=1)] == order


def test_frames_without_features_resemble_nothing() -> None:
    blank = np.zeros((0, 32), np.float32)
    assert not similarity(2, lambda _: blank).any()


@pytest.mark.filterwarnings("error")
def test_frames_that_all_look_the_same_are_no_trouble() -> None:
    descriptors = np.tile(np.eye(8, dtype=np.float32), (4, 1))
    alike = similarity(3, lambda _: descriptors)
    assert np.isfinite(alike).all()


def nodes_on_a_circle(count: int) -> list[Sim3]:
    angles = 2 * np.pi * np.arange(count) / count
    turn = Rotation.from_rotvec(np.stack([0 * angles, angles, 0 * angles], axis=1)).as_matrix()
    return [Sim3(1.0, turn[k], np.array([np.sin(a), 0.1 * k, np.cos(a)])) for k, a in enumerate(angles)]


@pytest.mark.parametrize("drift", [1.0, 1.05])
def test_a_pose_graph_without_contradiction_comes_out_exact(drift: float) -> None:
    truth = nodes_on_a_circle(12)
    pairs = [(k, k + 1) for k in range(11)] + [(0, 11), (2, 9)]
    links = [SimLink(i, j, truth[j] @ truth[i].inverse(), 1.0) for i, j in pairs]
    rng = np.random.default_rng(0)
    start = truth[:1] + [
        Sim3(drift, Rotation.from_rotvec(rng.normal(0, 0.1, 3)).as_matrix(), rng.normal(0, 0.1, 3)) @ node
        for node in truth[1:]
    ]
    for found, node in zip(relax(start, links), truth, strict=True):
        assert found.scale == pytest.approx(node.scale, abs=1e-4)
        np.testing.assert_allclose(found.rotation, node.rotation, atol=1e-4)
        np.testing.assert_allclose(found.translation, node.translation, atol=1e-4)


def test_a_guess_follows_an_affine_field_and_is_unknown_far_off() -> None:
    rng = np.random.default_rng(0)
    source = rng.uniform((0, 0), (80, 140), (300, 2)).astype(np.float32)
    affine = np.array([[1.05, 0.03], [-0.04, 0.97]])
    target = (source @ affine.T + (30, -12)).astype(np.float32)
    guess = displacement_guess(Correspondences(source, target), GRID)
    cells = GRID.sample_px().numpy()
    near = cells[:, 0] < 70
    np.testing.assert_allclose(guess[near], cells[near] @ affine.T + (30, -12), atol=0.8)
    assert np.isnan(guess[cells[:, 0] > 160]).all()
