"""Consensus by area: depths that views agree on, poses that most of the picture supports, and what moves."""

from __future__ import annotations

import numpy as np
import pytest
from exact_scene import GRID, ExactScene, trajectory
from numpy.typing import NDArray

from vipe_core.geometry.arrays import inverse
from vipe_core.priors.protocols import Match
from vipe_core.slam.consensus import agree, consensus_pose
from vipe_core.slam.graph import Graph
from vipe_core.slam.keyframes import KeyframeMap
from vipe_core.slam.masks import MotionMasks
from vipe_core.slam.reprojection import Reprojector
from vipe_core.slam.selection import Keyframe

SIDEWAYS = trajectory(4, (-0.12, 0.01, 0.0, 0.0, 0.004, 0.0))


def block(columns: slice, rows: slice = slice(4, 16)) -> NDArray[np.bool_]:
    """(P,) bool of a rectangle of cells."""
    cells = np.zeros((GRID.height, GRID.width), dtype=np.bool_)
    cells[rows, columns] = True
    return cells.reshape(-1)


def moved(match: Match, cells: NDArray[np.bool_], by_px: tuple[float, float], static_weight: float = 1.0) -> Match:
    """A measurement in which `cells` have moved by themselves, and everything else has little texture."""
    target_px = match.target_px.copy()
    target_px[cells] += np.float32(by_px)
    weight = np.where(cells[:, None], match.weight, static_weight * match.weight)
    return Match(target_px, weight.astype(np.float32), match.consistent)


def placed_map(scene: ExactScene, count: int) -> KeyframeMap:
    keyframes = KeyframeMap(GRID, "pinhole", scene.params)
    for k in range(count):
        keyframes.append(Keyframe(k, k), float(k), scene.cam_from_world[k], scene.inverse_depth[k])
    return keyframes


def test_one_view_gives_the_depth_that_its_measurement_triangulates_to_and_none_without_a_baseline() -> None:
    scene = ExactScene(SIDEWAYS)
    relative = (SIDEWAYS[2] @ inverse(SIDEWAYS[0]))[None]
    match = scene.measure(0, 2)
    found = agree(scene.reprojector, scene.params, relative, [match], 3.0)
    np.testing.assert_allclose(found.inverse_depth, scene.inverse_depth[0], rtol=1e-4)
    assert found.error_px[found.measured].max() < 1e-3
    relative[0, :3, 3] = 0
    turned = agree(scene.reprojector, scene.params, relative, [match], 3.0)
    assert np.isnan(turned.inverse_depth).all()
    assert np.isinf(turned.error_px).all()


def test_views_agree_on_the_true_depth_in_spite_of_one_that_is_wrong() -> None:
    scene = ExactScene(SIDEWAYS)
    relative = np.stack([pose @ inverse(SIDEWAYS[0]) for pose in SIDEWAYS[1:]])
    matches = [scene.measure(0, j) for j in (1, 2, 3)]
    matches[2] = moved(matches[2], np.ones(GRID.num_cells, dtype=np.bool_), (6.0, 5.0))
    found = agree(scene.reprojector, scene.params, relative, matches, 3.0)
    seen = found.measured[:2].all(axis=0)
    assert seen.mean() > 0.8
    np.testing.assert_allclose(found.inverse_depth[seen], scene.inverse_depth[0][seen], rtol=1e-3)
    assert (found.support(1.0)[seen] == 2).all()


def test_one_pair_cannot_tell_motion_along_its_epipolar_line_and_three_views_can() -> None:
    scene = ExactScene(trajectory(3, (-0.12, 0.0, 0.0, 0.0, 0.0, 0.0)))
    poses = scene.cam_from_world
    cells = block(slice(8, 16))
    # It walks against the camera and stops: nearer than it is in the first pair, and somewhere else in the other.
    matches = [moved(scene.measure(1, j), cells, (step, 0.0)) for j, step in ((0, 0.0), (2, -5.0))]
    relative = np.stack([poses[j] @ inverse(poses[1]) for j in (0, 2)])
    pair = agree(scene.reprojector, scene.params, relative[1:], matches[1:], 3.0)
    assert (pair.support(1.0) >= pair.votes)[cells].all()
    both = agree(scene.reprojector, scene.params, relative, matches, 3.0)
    seen = both.votes == 2
    assert (2 * both.support(1.0) <= both.votes)[cells & seen].all()
    assert not (2 * both.support(1.0) <= both.votes)[~cells & seen].any()


def test_the_pose_is_that_of_the_larger_area_however_weak_its_texture() -> None:
    scene = ExactScene(SIDEWAYS)
    keyframes = placed_map(scene, 3)
    cells = block(slice(0, 12), slice(0, 15))
    assert 0.35 < cells.mean() < 0.45
    views = [(k, moved(scene.measure(k, 3), cells, (9.0, -4.0), static_weight=0.05)) for k in (1, 2)]
    everywhere = np.ones(GRID.num_cells, dtype=np.bool_)
    found = consensus_pose(scene.reprojector, keyframes, views, [everywhere, everywhere], 1.0)
    assert found is not None
    np.testing.assert_allclose(found[0], SIDEWAYS[3], atol=2e-3)
    assert 0.5 < found[1] < 0.7


def test_too_few_cells_have_no_pose() -> None:
    scene = ExactScene(SIDEWAYS)
    nothing = np.zeros(GRID.num_cells, dtype=np.bool_)
    views = [(0, scene.measure(0, 1))]
    assert consensus_pose(scene.reprojector, placed_map(scene, 1), views, [nothing], 1.0) is None


@pytest.mark.parametrize("enabled", [True, False])
def test_masks_hold_what_moves_and_nothing_of_a_static_scene(enabled: bool) -> None:
    scene = ExactScene(SIDEWAYS)
    cells = block(slice(6, 12))
    for walks in (True, False):
        keyframes, graph = placed_map(scene, 4), Graph()
        for i in range(4):
            for j in range(4):
                if i != j:
                    step = (4.0 * (j - i), 3.0 * (j - i)) if walks else (0.0, 0.0)
                    graph.add(i, j, moved(scene.measure(i, j), cells, step))
        masks = MotionMasks(Reprojector("pinhole", GRID), keyframes, graph, 3.0, enabled=enabled)
        changed = masks.update(range(4))
        masked = ~keyframes.static(1)
        if walks and enabled:
            assert changed > 0.1
            assert masked[cells].mean() > 0.9
            assert masked[~block(slice(5, 13), slice(3, 17))].mean() < 0.02
        else:
            assert not masked.any()


def test_wrong_poses_mask_nothing() -> None:
    """Where most of the picture disagrees it is the geometry that is wrong."""
    scene = ExactScene(SIDEWAYS)
    keyframes, graph = placed_map(scene, 3), Graph()
    for i in range(3):
        for j in range(3):
            if i != j:
                graph.add(i, j, scene.measure(i, j))
    pose = SIDEWAYS[1].copy()
    pose[:3, 3] += (0.0, 0.4, 0.2)
    keyframes.set_pose(1, pose)
    MotionMasks(Reprojector("pinhole", GRID), keyframes, graph, 3.0).update([1])
    assert keyframes.static(1).all()
