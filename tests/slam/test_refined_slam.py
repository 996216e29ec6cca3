"""The SLAM stage where measurements are refined in turns with the map, by a network that knows the answer in part."""

from __future__ import annotations

from dataclasses import replace

import exact_room
import numpy as np
import pytest
import torch
from exact_refiner import GRID, RoomDepth, RoomFollower, RoomRefiner
from numpy.typing import NDArray

from vipe_core.cameras.calibration import Calibration
from vipe_core.geometry import umeyama
from vipe_core.geometry.arrays import inverse
from vipe_core.priors.protocols import MetricDepth, PointFollower
from vipe_core.slam.adjustment import Adjuster, FocalPrior
from vipe_core.slam.graph import Graph
from vipe_core.slam.keyframes import KeyframeMap
from vipe_core.slam.recurrent.edges import RefinedEdges
from vipe_core.slam.recurrent.linking import Reach, distances, links
from vipe_core.slam.recurrent.settings import RefinementSettings
from vipe_core.slam.recurrent.tracking import RefinedTracker
from vipe_core.slam.selection import Keyframe
from vipe_core.slam.settings import EnergyTerms, SlamSettings
from vipe_core.slam.system import Slam, SlamResult

# The whole schedule with fewer updates, which an answer that is half right each time makes up for.
SHORT = RefinementSettings(global_updates=(2, 3, 6), first_updates=6, fill_updates=5)


def walk(count: int) -> NDArray[np.float64]:
    """(N, 4, 4) world_from_cam of a walk through the room."""
    steps = np.linspace(0, 1, count)
    return np.stack(
        [exact_room.pose(-1.2 + 2.4 * s, -0.4 + 0.3 * np.sin(3 * s), -2.4 + 0.8 * s, 12 - 24 * s) for s in steps]
    )


def run(
    refiner: RoomRefiner,
    fov_deg: float,
    sigma: float,
    schedule: RefinementSettings = SHORT,
    metric: MetricDepth | None = None,
    follower: PointFollower | None = None,
    terms: EnergyTerms = EnergyTerms(),
) -> SlamResult:
    settings = SlamSettings(refinement=schedule, terms=terms)
    priors = refiner.priors(fov_deg, sigma, metric, follower)
    return Slam(priors, settings, torch.device("cpu")).run(refiner, lambda *_: None)


def position_error(result: SlamResult, refiner: RoomRefiner) -> float:
    """RMS of the positions after the best similarity, as a share of the path."""
    truth, found = refiner.world_from_cam[:, :3, 3], result.world_from_cam[:, :3, 3]
    error = umeyama(found, truth).apply(found) - truth
    path = np.linalg.norm(np.diff(truth, axis=0), axis=1).sum()
    return float(np.sqrt(np.square(error).sum(axis=1).mean()) / path)


def test_updates_and_adjustments_in_turns_find_the_exact_trajectory_and_focal_length() -> None:
    refiner = RoomRefiner(walk(30))
    result = run(refiner, fov_deg=68.0, sigma=1.0)
    assert result.motion == "general"
    assert position_error(result, refiner) < 2e-3
    assert result.camera.fov_x_deg == pytest.approx(75.0, abs=1.0)
    assert result.map.residual_px < 0.3
    assert result.map.inlier_ratio > 0.99
    assert (result.trajectory.inlier_ratio > 0.9).all()
    # The window is refined with volumes of correlation, whole graphs (one on the way, two at the end) without.
    assert refiner.lean.count(True) == 3
    assert set(refiner.lean) == {True, False}


def test_lean_settings_refine_nothing_with_volumes_and_answers_of_any_error_are_averaged() -> None:
    refiner = RoomRefiner(walk(14), noise_px=0.5)
    result = run(refiner, fov_deg=75.0, sigma=0.05, schedule=replace(SHORT, lean=True))
    assert all(refiner.lean)
    assert position_error(result, refiner) < 1e-2


def test_keyframes_that_turn_out_redundant_are_dropped() -> None:
    poses = walk(14)
    short = replace(SHORT, global_updates=(1, 1, 2), first_updates=3, fill_updates=2)
    all_kept = run(RoomRefiner(poses), 75.0, 0.05, replace(short, redundant_px=0.0))
    thinned = run(RoomRefiner(poses), 75.0, 0.05, replace(short, redundant_px=80.0))
    assert 8 <= len(thinned.keyframes) < len(all_kept.keyframes)
    assert set(thinned.keyframes) < set(all_kept.keyframes)
    assert position_error(thinned, RoomRefiner(poses)) < 5e-3


@pytest.mark.parametrize("count", [1, 2, 3])
def test_a_handful_of_frames_is_enough_for_finite_poses(count: int) -> None:
    refiner = RoomRefiner(walk(48)[: 8 * count : 8])
    result = run(refiner, fov_deg=75.0, sigma=0.1)
    assert result.world_from_cam.shape == (count, 4, 4)
    assert np.isfinite(result.world_from_cam).all()
    assert (result.inverse_depth > 0).all()


def test_a_camera_that_only_turns_or_stands_still_is_seen_as_such() -> None:
    turning = np.stack([exact_room.pose(0, 0, -2.4, 1.0 * k) for k in range(14)])
    result = run(RoomRefiner(turning), fov_deg=75.0, sigma=0.1, schedule=replace(SHORT, fill_updates=2))
    assert result.motion == "rotation"
    np.testing.assert_array_equal(result.world_from_cam[:, :3, 3], 0)
    still = run(RoomRefiner(np.tile(exact_room.POSES[0], (4, 1, 1))), fov_deg=75.0, sigma=0.1)
    assert still.motion == "static"


def placed(count: int) -> tuple[RoomRefiner, KeyframeMap, Adjuster]:
    """Keyframes at their true poses and depths."""
    refiner = RoomRefiner(walk(count))
    keyframes = KeyframeMap(GRID, "pinhole", refiner.camera.index_params())
    for k, pose in enumerate(refiner.world_from_cam):
        keyframes.append(Keyframe(k, k), k / 30, inverse(pose), refiner.inverse_depth[k])
    prior = FocalPrior(float(np.log(refiner.camera.focal_px)), 0.1)
    return refiner, keyframes, Adjuster(SlamSettings(), torch.device("cpu"), prior, 1.0)


def test_edges_keep_their_measurements_when_they_retire_and_follow_the_numbers_of_keyframes() -> None:
    refiner, keyframes, adjuster = placed(6)
    edges = RefinedEdges(refiner, keyframes, adjuster, lean=False)
    edges.add([(0, 1), (1, 0), (2, 4), (4, 2)])
    edges.update()
    edges.add([(4, 5), (3, 5)], most=4)
    assert edges.active == [(2, 4), (4, 2), (4, 5), (3, 5)]
    assert sorted(edges.stored) == [(0, 1), (1, 0)]
    true, seen = refiner.exact(0, 1)
    error = edges.stored[0, 1][0].numpy() - true
    assert np.abs(error[seen]).max() < 1.0
    edges.update()
    edges.remove_keyframe(3)
    keyframes.remove(3)
    assert edges.active == [(2, 3), (3, 2), (3, 4)]
    assert keyframes.frame_index == [0, 1, 2, 4, 5]
    edges.retire(oldest=1)
    assert edges.active == [(3, 4)]
    edges.update()
    assert edges.adjust(1, 3, stored_from=0) is not None
    graph = Graph()
    edges.file(graph)
    assert list(graph) == [(3, 4)]


def test_a_map_grows_in_the_memory_of_its_window_and_forgetting_changes_nothing() -> None:
    poses = walk(26)
    settings = replace(
        SHORT, redundant_px=0.0, first_updates=1, updates=1, more_updates=1, oldest=4, window=6, recent=3
    )

    def grown() -> tuple[KeyframeMap, list[int]]:
        refiner = RoomRefiner(poses)
        keyframes = KeyframeMap(GRID, "pinhole", refiner.camera.index_params())
        adjuster = Adjuster(SlamSettings(), torch.device("cpu"), FocalPrior(float(np.log(100.0)), 0.1), 1.0)
        tracker = RefinedTracker(refiner, keyframes, adjuster, refiner.reprojector, settings, 0.2)
        tracker.start([Keyframe(k, k) for k in range(4)], [k / 30 for k in range(4)])
        stored = []
        for k in range(4, 26):
            tracker.add(Keyframe(k, k), k / 30)
            stored.append(len(tracker._edges.stored))
        return keyframes, stored

    found, stored = grown()
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(RefinedEdges, "forget", lambda *_: None)
        everything, all_stored = grown()
    assert max(stored[12:]) <= max(stored[:12]) < 0.5 * all_stored[-1]
    np.testing.assert_array_equal(found.poses(), everything.poses())
    np.testing.assert_array_equal(found.depths(), everything.depths())


def test_links_are_to_neighbours_and_to_the_nearest_others_at_a_distance_from_each_other() -> None:
    refiner, keyframes, _ = placed(24)
    settings = RefinementSettings()
    pairs = [(10, 9), (10, 7), (20, 3)]
    apart = distances(refiner.reprojector, keyframes, pairs, settings)
    assert apart[0] < apart[1] < apart[2]
    everyone = range(24)
    found = links(refiner.reprojector, keyframes, everyone, everyone, (), Reach(3, 20.0, 2, 400), settings)
    assert len(set(found)) == len(found)
    assert {(j, i) for i, j in found} == set(found)
    for i in everyone:
        assert set(range(max(0, i - 3), i)) <= {j for a, j in found if a == i}
    far = [(i, j) for i, j in found if i - j > 3]
    assert far
    assert all(
        abs(a - i) + abs(b - j) > 2 for i, j in far for a, b in far if (a, b) != (i, j) and min(a - b, i - j) > 4
    )
    assert (distances(refiner.reprojector, keyframes, far, settings) <= 20.0).all()
    again = links(refiner.reprojector, keyframes, everyone, everyone, found, Reach(3, 20.0, 2, 400), settings)
    assert not again


def depth_error(result: SlamResult, refiner: RoomRefiner) -> float:
    """Mean error of the logarithm of the inverse depths of all cells, in one scale for all of them."""
    truth = np.stack([refiner.inverse_depth[index] for index in result.keyframes])
    error = np.log(result.inverse_depth / truth)
    return float(np.abs(error - np.median(error)).mean())


def test_metric_depth_tells_the_shape_of_what_the_network_cannot_see_and_is_asked_anew_once() -> None:
    """Half of every picture has no weight: only the prior knows how far away it is."""
    short = replace(SHORT, global_updates=(1, 1, 6), first_updates=4)
    poses = walk(16)
    blind = RoomRefiner(poses, blind_cells=GRID.num_cells // 2)
    without = run(blind, 68.0, 1.0, short)
    blind = RoomRefiner(poses, blind_cells=GRID.num_cells // 2)
    metric = RoomDepth(blind)
    found = run(blind, 68.0, 1.0, short, metric)
    assert depth_error(without, blind) > 0.08
    assert depth_error(found, blind) < 0.01
    assert position_error(found, blind) < 5e-3
    # Every keyframe is shown twice, the second time with the camera as it was found, which is held from then on.
    frames = [index for index, _ in metric.shown]
    assert all(frames.count(index) == 2 for index in found.keyframes)
    again = metric.shown[-len(found.keyframes) :]
    assert again == [(index, found.camera.focal_px) for index in found.keyframes]


def test_metric_depth_is_asked_once_where_the_camera_is_known() -> None:
    refiner = RoomRefiner(walk(16))
    metric = RoomDepth(refiner)
    short = replace(SHORT, global_updates=(1, 1, 2), first_updates=2)
    settings = SlamSettings(refinement=short)
    known = Calibration(refiner.camera)
    slam = Slam(refiner.priors(60.0, 1.0, metric), settings, torch.device("cpu"))
    found = slam.run(refiner, lambda *_: None, known)
    assert found.camera.focal_px == pytest.approx(refiner.camera.focal_px, rel=1e-9)
    frames = [index for index, _ in metric.shown]
    assert len(set(frames)) == len(frames) >= len(found.keyframes)


def test_tracks_are_followed_where_their_term_is_on_and_only_where_something_moves() -> None:
    refiner = RoomRefiner(walk(3))
    follower = RoomFollower(refiner)
    run(refiner, 75.0, 0.05, follower=follower, terms=EnergyTerms(sparse_tracks=False))
    standing = RoomRefiner(np.repeat(walk(3)[:1], 3, axis=0))
    run(standing, 75.0, 0.05, follower=follower)
    assert follower.followed == []


def test_tracks_mend_what_the_network_says_of_static_things_and_are_taken_back_where_they_contradict_it() -> None:
    def error(follower: RoomFollower | None) -> float:
        refiner = RoomRefiner(walk(14), noise_px=0.8)
        return position_error(run(refiner, 75.0, 0.05, follower=follower), refiner)

    walked = RoomRefiner(walk(14))
    follower = RoomFollower(walked)
    without, with_tracks = error(None), error(follower)
    assert with_tracks < 0.7 * without
    # Shot by shot and frame by frame, from the first keyframe to the last.
    assert follower.followed == [list(range(14))]
    # What slips by three pixels a frame is further from every answer than anything that is believed.
    assert error(RoomFollower(walked, wrong_px=3.0)) == pytest.approx(without, rel=0.3)
