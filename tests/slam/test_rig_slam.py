"""The SLAM stage of rigs on exact measurements: one rigid path, the scale of the rig, and its extrinsics."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from exact_rig import CAMERA, ExactRig, ExactRigSource, fan_of_cameras
from exact_scene import GRID, trajectory
from numpy.typing import NDArray

from vipe_core.cameras.rig import angle_between_deg
from vipe_core.errors import ConfigError
from vipe_core.geometry import umeyama
from vipe_core.geometry.arrays import exp, inverse
from vipe_core.priors.protocols import Match
from vipe_core.slam.crossviews import CrossViews
from vipe_core.slam.graph import Graph
from vipe_core.slam.keyframes import KeyframeMap
from vipe_core.slam.measuring import MeasuredGraph
from vipe_core.slam.rig_system import RigCameras, RigSlam, RigSlamResult
from vipe_core.slam.selection import Keyframe
from vipe_core.slam.settings import SlamSettings

PATH = trajectory(14, [-0.08, 0.01, -0.01, 0.0, 0.008, 0.002])


def run(rig: ExactRig, cameras: RigCameras) -> RigSlamResult:
    with torch.inference_mode():
        slam = RigSlam(rig.priors(), SlamSettings(), torch.device("cpu"))
        return slam.run(ExactRigSource(rig), cameras, lambda *_: None)


def path_error(rig: ExactRig, found: RigSlamResult) -> tuple[float, float]:
    """ATE of all views together as a share of the path, and the length of a unit of the map."""
    truth = inverse(rig.cam_from_world).reshape(-1, rig.num_views, 4, 4)
    actual = np.concatenate([view.world_from_cam[:, :3, 3] for view in found.views])
    expected = np.concatenate([truth[:, view, :3, 3] for view in range(rig.num_views)])
    fit = umeyama(actual, expected)
    length = float(np.linalg.norm(np.diff(truth[:, 0, :3, 3], axis=0), axis=1).sum())
    error = float(np.sqrt(np.square(fit.apply(actual) - expected).sum(axis=1).mean()))
    return error / length, fit.scale


class HalfBlindRig(ExactRig):
    """Its second view never moves."""

    def motion_px(self, source: int, target: int) -> float:
        return 0.0 if source % self.num_views else super().motion_px(source, target)


class AskedRig(ExactRig):
    """Remembers which pictures were matched."""

    def __init__(self, rig_from_world: NDArray[np.float64], cam_from_rig: NDArray[np.float64]) -> None:
        super().__init__(rig_from_world, cam_from_rig)
        self.asked: list[tuple[int, int]] = []

    def match(self, source: int, target: int, guess_px: object = None) -> tuple[Match, Match]:
        self.asked.append((source, target))
        return super().match(source, target, guess_px)


def turned(mounts: NDArray[np.float64], angle_deg: float) -> NDArray[np.float64]:
    off = mounts.copy()
    off[1] = exp(np.array([0, 0, 0, *(math.radians(angle_deg) * np.array([0.6, -0.48, 0.64]))])) @ mounts[1]
    return off


def test_a_stereo_pair_has_the_path_the_scale_and_its_own_shape() -> None:
    rig = ExactRig(PATH, fan_of_cameras(2, 0.2, 0.0))
    found = run(rig, RigCameras(rig.cam_from_rig, (CAMERA, CAMERA)))
    error, unit = path_error(rig, found)
    assert error < 1e-3
    assert found.rig_units == pytest.approx(unit, rel=0.01)
    assert found.scale_sigma_ratio < 0.05
    left, right = found.views
    between = inverse(right.world_from_cam) @ left.world_from_cam
    np.testing.assert_allclose(between, np.broadcast_to(between[0], between.shape), atol=1e-9)
    assert not left.trajectory.interpolated.any()


def test_wrong_extrinsics_are_found_out() -> None:
    rig = ExactRig(PATH, fan_of_cameras(2, 0.2, 10.0))
    found = run(rig, RigCameras(turned(rig.cam_from_rig, 2.0), (CAMERA, CAMERA), refine=True))
    assert path_error(rig, found)[0] < 2e-3
    assert angle_between_deg(found.cam_from_rig[0], rig.cam_from_rig[0]) < 1e-4
    assert angle_between_deg(found.cam_from_rig[1], rig.cam_from_rig[1]) < 0.1


def test_a_view_that_stands_still_while_the_other_moves_is_left_out() -> None:
    rig = HalfBlindRig(PATH, fan_of_cameras(2, 0.2, 0.0))
    found = run(rig, RigCameras(rig.cam_from_rig, (CAMERA, CAMERA)))
    assert [view.rig.blind for view in found.views if view.rig] == [False, True]
    # One view alone says nothing of the scale, and so of the place of the other one.
    truth = inverse(rig.cam_from_world)[::2, :3, 3]
    fit = umeyama(found.views[0].world_from_cam[:, :3, 3], truth)
    np.testing.assert_allclose(fit.apply(found.views[0].world_from_cam[:, :3, 3]), truth, atol=1e-3)
    assert found.scale_sigma_ratio > 0.2
    assert found.views[1].map.coverage == 0
    assert not found.views[1].trajectory.interpolated.any()


def test_cameras_in_one_place_turn_as_one_and_tell_no_scale() -> None:
    rig = ExactRig(PATH, fan_of_cameras(2, 0.0, 40.0))
    found = run(rig, RigCameras(rig.cam_from_rig, (CAMERA, CAMERA)))
    assert path_error(rig, found)[0] < 1e-3
    assert math.isinf(found.scale_sigma_ratio)


@pytest.mark.parametrize(("distance", "at_one_instant"), [(1.0, False), (10.0, True)])
def test_views_are_linked_by_what_their_depths_say_that_they_see_of_one_another(
    distance: float, at_one_instant: bool
) -> None:
    """Two views side by side on a sideways path: what the right one sees, the left one sees six instants later. Were
    everything far away, they would see the same at once."""
    rig = AskedRig(trajectory(8, [-0.5, 0, 0, 0, 0, 0]), fan_of_cameras(2, 3.0, 0.0))
    keyframes, graph = KeyframeMap(GRID, "pinhole", CAMERA.index_params(), rig.cam_from_rig), Graph()
    for k, (pose, depth) in enumerate(zip(rig.cam_from_world, rig.inverse_depth, strict=True)):
        keyframes.append(Keyframe(k // 2, k), k // 2 / 30, pose, depth / distance)
    measured = MeasuredGraph(keyframes, graph, rig, None, None, rig.reprojector)
    CrossViews(measured, rig.reprojector).connect([0, 1])
    assert ((0, 1) in rig.asked) is at_one_instant
    # View 1 of instant 0 stands where view 0 stands at instant 6.
    assert (frozenset((1, 12)) in map(frozenset, graph)) is not at_one_instant
    assert all(i % 2 != j % 2 for i, j in rig.asked)


def test_views_and_videos_must_be_as_many() -> None:
    rig = ExactRig(PATH[:2], fan_of_cameras(2, 0.2, 0.0))
    with pytest.raises(ConfigError, match="3 views"):
        run(rig, RigCameras(np.tile(np.eye(4), (3, 1, 1)), (CAMERA,) * 3))
