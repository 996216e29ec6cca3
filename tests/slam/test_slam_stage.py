"""The SLAM stage on exact measurements: what it must recover, and how it meets cameras that do not travel."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
import torch
from exact_scene import ExactScene, trajectory

from vipe_core.geometry import umeyama
from vipe_core.geometry.arrays import inverse
from vipe_core.slam.settings import SlamSettings
from vipe_core.slam.system import Slam, SlamResult


def run(scene: ExactScene, fov_deg: float = 60.0, sigma: float = 0.1, rivals_deg: Sequence[float] = ()) -> SlamResult:
    settings = SlamSettings()
    return Slam(scene.priors(fov_deg, sigma, rivals_deg), settings, torch.device("cpu")).run(scene, lambda *_: None)


def position_error(result: SlamResult, scene: ExactScene) -> float:
    """RMS of the positions after the best similarity, as a share of the path."""
    truth, found = inverse(scene.cam_from_world)[:, :3, 3], result.world_from_cam[:, :3, 3]
    error = umeyama(found, truth).apply(found) - truth
    path = np.linalg.norm(np.diff(truth, axis=0), axis=1).sum()
    return float(np.sqrt(np.square(error).sum(axis=1).mean()) / path)


ARC = (0.05, 0.006, 0.012, 0.002, -0.015, 0.001)


def test_exact_measurements_give_the_exact_trajectory_and_focal_length() -> None:
    scene = ExactScene(trajectory(30, ARC))
    result = run(scene, fov_deg=54.0, sigma=1.0)
    assert result.motion == "general"
    assert position_error(result, scene) < 2e-3
    assert result.camera.fov_x_deg == pytest.approx(60.0, abs=0.3)
    assert result.map.residual_px < 0.05
    assert result.map.inlier_ratio > 0.99


def test_the_right_one_of_two_focal_lengths_is_found_when_the_likelier_is_wrong() -> None:
    scene = ExactScene(trajectory(16, ARC))
    result = run(scene, fov_deg=100.0, sigma=0.7, rivals_deg=(58.0,))
    assert position_error(result, scene) < 2e-3
    assert result.camera.fov_x_deg == pytest.approx(60.0, abs=0.5)


def test_driving_straight_on_hardly_shows_the_focal_length_and_says_so() -> None:
    result = run(ExactScene(trajectory(16, (0.0, 0.0, 0.06, 0.0, 0.0, 0.0))), sigma=0.3)
    assert result.focal_sigma_ratio > 0.1


@pytest.mark.parametrize("outliers", [0.08, pytest.param(0.33, marks=pytest.mark.slow)])
def test_wrong_measurements_are_survived_and_counted(outliers: float) -> None:
    scene = ExactScene(trajectory(24, ARC), outliers=outliers)
    result = run(scene)
    assert position_error(result, scene) < 1e-2
    assert result.map.inlier_ratio == pytest.approx(1 - outliers, abs=0.06)


def test_every_frame_is_posed_and_the_world_is_the_first_camera() -> None:
    scene = ExactScene(trajectory(17, ARC))
    result = run(scene)
    assert result.world_from_cam.shape == (17, 4, 4)
    np.testing.assert_allclose(result.world_from_cam[0], np.eye(4), atol=1e-12)
    rotation = result.world_from_cam[:, :3, :3]
    np.testing.assert_allclose(rotation @ rotation.transpose(0, 2, 1), np.tile(np.eye(3), (17, 1, 1)), atol=1e-9)
    assert (result.trajectory.inlier_ratio > 0.9).all()
    assert result.keyframes[0] == 0
    assert (np.diff(result.keyframes) > 0).all()


def test_a_camera_that_stands_still_gets_identity_poses() -> None:
    result = run(ExactScene(trajectory(12, (0, 0, 0, 0, 0, 0))))
    assert result.motion == "static"
    np.testing.assert_array_equal(result.world_from_cam, np.tile(np.eye(4), (12, 1, 1)))


def test_a_camera_that_only_turns_gets_rotations_and_its_focal_length() -> None:
    scene = ExactScene(trajectory(30, (0, 0, 0, 0.004, 0.03, 0.002)))
    result = run(scene, fov_deg=54.0, sigma=1.0)
    assert result.motion == "rotation"
    np.testing.assert_array_equal(result.world_from_cam[:, :3, 3], 0)
    truth = inverse(scene.cam_from_world)
    truth = inverse(truth[0]) @ truth
    angle = np.linalg.norm(result.world_from_cam[:, :3, :3] - truth[:, :3, :3], axis=(1, 2))
    assert np.degrees(angle.max()) < 0.3
    assert result.camera.fov_x_deg == pytest.approx(60.0, abs=0.3)


@pytest.mark.parametrize("count", [1, 2, 3, 5])
def test_a_handful_of_frames_is_enough_for_finite_poses(count: int) -> None:
    result = run(ExactScene(trajectory(count, ARC)))
    assert result.world_from_cam.shape == (count, 4, 4)
    assert np.isfinite(result.world_from_cam).all()
    assert np.isfinite(result.inverse_depth).all()
    assert (result.inverse_depth > 0).all()


def test_a_hard_prior_holds_the_focal_length() -> None:
    result = run(ExactScene(trajectory(20, ARC)), fov_deg=56.0, sigma=1e-7)
    assert result.camera.fov_x_deg == pytest.approx(56.0, abs=0.05)


def test_what_the_report_raises_ends_the_run() -> None:
    class Cancelled(Exception):
        pass

    def report(stage: str, done: int, total: int | None) -> None:
        if stage == "track":
            raise Cancelled

    scene = ExactScene(trajectory(12, ARC))
    with pytest.raises(Cancelled):
        Slam(scene.priors(), SlamSettings(), torch.device("cpu")).run(scene, report)


def test_the_global_adjustment_shows_signs_of_life_and_can_be_cancelled_in_between() -> None:
    scene = ExactScene(trajectory(12, ARC))
    signs = 0

    def report(stage: str, done: int, total: int | None) -> None:
        nonlocal signs
        signs += stage == "backend"
        if signs == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Slam(scene.priors(), SlamSettings(), torch.device("cpu")).run(scene, report)
    assert signs == 3
