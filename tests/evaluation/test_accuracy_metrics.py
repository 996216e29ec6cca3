"""Metrics: hand-made cases, invariances, and the numbers of an independent scorer."""

from __future__ import annotations

import importlib.util
import math
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from vipe_core.cameras import Camera
from vipe_core.evaluation.metrics import (
    camera_errors,
    convert_depth,
    depth_errors,
    depth_pose_scale_ratio,
    mask_errors,
    sample_depth,
    trajectory_errors,
    z_from_ray,
)
from vipe_core.evaluation.truth import GroundTruth, sample_at_truth

CAMERAS = {
    "pinhole": Camera("pinhole", (210.0, 212.0, 128.0, 96.0), 256, 192),
    "mei": Camera("mei", (180.0, 181.0, 128.0, 96.0, 0.66), 256, 192),
    "equirect": Camera("equirect", (), 256, 128),
}


def walk(num: int, seed: int) -> NDArray[np.float64]:
    rng = np.random.default_rng(seed)
    poses = np.repeat(np.eye(4)[None], num, axis=0)
    poses[:, :3, 3] = rng.normal(size=(num, 3)).cumsum(axis=0) * 0.1
    poses[:, :3, :3] = Rotation.from_rotvec(rng.normal(size=(num, 3)).cumsum(axis=0) * 0.02).as_matrix()
    return poses


def moved(poses: NDArray[np.float64], scale: float, seed: int) -> NDArray[np.float64]:
    world = np.eye(4)
    world[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    world[:3, 3] = (1.0, -2.0, 3.0)
    result: NDArray[np.float64] = world @ poses
    result[:, :3, 3] *= scale
    return result


@settings(deadline=None, max_examples=30)
@given(scale=st.floats(0.05, 20.0), seed=st.integers(0, 1000))
def test_a_similar_trajectory_has_no_error(scale: float, seed: int) -> None:
    truth = walk(12, seed)
    errors = trajectory_errors(moved(truth, scale, seed), truth)
    assert errors.scale == pytest.approx(1 / scale)
    for value in (errors.ate_rmse, errors.rte_rmse, errors.rre_rmse_deg, errors.rotation_rmse_deg):
        assert value == pytest.approx(0.0, abs=1e-6)


def test_one_lifted_corner() -> None:
    """A square with the corners lifted alternately by h: the best similarity leaves exactly h at each corner."""
    truth = np.repeat(np.eye(4)[None], 4, axis=0)
    truth[:, :2, 3] = [(0, 0), (1, 0), (1, 1), (0, 1)]
    estimate = truth.copy()
    estimate[:, 2, 3] = (0.1, -0.1, 0.1, -0.1)
    # Scaling by s trades height against size: minimise (1 - s)^2 / 2 + (0.1 s)^2.
    s = 0.5 / (0.5 + 0.01)
    errors = trajectory_errors(estimate, truth)
    assert errors.scale == pytest.approx(s)
    assert errors.ate_rmse == pytest.approx(math.sqrt((1 - s) ** 2 / 2 + (0.1 * s) ** 2))
    assert errors.path_length == pytest.approx(3.0)


def test_relative_rotation_of_one_turned_frame() -> None:
    truth = walk(5, 1)
    estimate = truth.copy()
    estimate[2, :3, :3] = estimate[2, :3, :3] @ Rotation.from_rotvec([0, 0, math.radians(3)]).as_matrix()
    errors = trajectory_errors(estimate, truth)
    assert errors.rre_rmse_deg == pytest.approx(3 * math.sqrt(2 / 4), rel=1e-6)
    assert errors.ate_rmse == pytest.approx(0.0, abs=1e-9)


def test_pairs_across_a_gap_do_not_count() -> None:
    truth = walk(4, 2)
    estimate = truth.copy()
    turned = moved(truth[2:], 1.0, 5)
    estimate[2:, :3, :3] = turned[:, :3, :3]
    assert trajectory_errors(estimate, truth, np.array([0, 1, 5, 6])).rre_rmse_deg == pytest.approx(0.0, abs=1e-6)
    assert trajectory_errors(estimate, truth).rre_rmse_deg > 1.0
    assert trajectory_errors(estimate, truth, np.array([0, 2, 5, 7])).rre_rmse_deg is None


def test_standing_still() -> None:
    truth = walk(6, 3)
    still = np.repeat(np.eye(4)[None], 6, axis=0)
    errors = trajectory_errors(still, truth)
    centres = truth[:, :3, 3]
    assert errors.ate_rmse == pytest.approx(math.sqrt(((centres - centres.mean(0)) ** 2).sum(1).mean()))
    assert errors.scale is None
    against_still = trajectory_errors(truth, still)
    assert against_still.ate_rmse is None
    assert against_still.rte_percent is None
    assert against_still.rotation_rmse_deg > 0


def test_a_straight_path_uses_the_rotations() -> None:
    truth = np.repeat(np.eye(4)[None], 5, axis=0)
    truth[:, 2, 3] = np.arange(5.0)
    errors = trajectory_errors(moved(truth, 3.0, 4), truth)
    assert errors.ate_rmse == pytest.approx(0.0, abs=1e-9)
    assert errors.scale == pytest.approx(1 / 3)


def test_trajectories_must_fit() -> None:
    with pytest.raises(ValueError, match="needed"):
        trajectory_errors(walk(3, 0), walk(4, 0))


def test_camera_errors() -> None:
    truth = Camera.pinhole_from_fov(60.0, 640, 480)
    errors = camera_errors(Camera.pinhole_from_fov(63.0, 640, 480), truth)
    assert errors is not None
    assert errors.fov_x_deg == pytest.approx(3.0)
    tangent = math.tan(math.radians(31.5)) / math.tan(math.radians(30.0))
    assert errors.focal_percent == pytest.approx(100 * abs(1 / tangent - 1))
    assert camera_errors(Camera("equirect", (), 640, 480), truth) is None
    with pytest.raises(ValueError, match="sizes"):
        camera_errors(Camera.pinhole_from_fov(60.0, 320, 240), truth)


def test_depth_errors_by_hand() -> None:
    truth = np.array([[1.0, 2.0, 4.0, 0.0, 8.0]], np.float32)
    estimate = np.array([[0.5, 1.0, 2.0, 3.0, 8.0]], np.float32)
    everything = np.ones(truth.shape, np.bool_)
    errors = depth_errors([(estimate, truth, everything)])
    assert errors is not None
    assert errors.scale == pytest.approx(2.0)
    assert errors.abs_rel == pytest.approx(0.25)
    assert errors.log_rmse == pytest.approx(math.log(2.0) / 2)
    assert errors.delta125 == pytest.approx(0.75)
    static = np.array([[True, True, True, True, False]])
    only_static = depth_errors([(estimate, truth, static)])
    assert only_static is not None
    assert only_static.abs_rel == pytest.approx(0.0)
    missing = depth_errors([(np.where(truth > 3, np.nan, estimate).astype(np.float32), truth, everything)])
    assert missing is not None
    assert missing.density == pytest.approx(0.5)
    assert depth_errors([(np.zeros((1, 5), np.float32), truth, everything)]) is None


def test_depth_resampling_is_exact_on_planes_and_ignores_holes() -> None:
    x = (np.arange(64) + 0.5) / 64
    plane = (1 / (0.5 + 0.3 * x[None] + 0.2 * x[:48, None])).astype(np.float32)
    small = (np.arange(16) + 0.5) / 16
    exact = 1 / (0.5 + 0.3 * small[None] + 0.2 * (small[:12, None]))
    np.testing.assert_allclose(sample_depth(plane, 12, 16), exact, rtol=1e-5)
    holed = plane.copy()
    holed[1, 1] = 0
    assert sample_depth(holed, 12, 16)[0, 0] == pytest.approx(exact[0, 0], rel=0.02)


def test_a_sensor_beside_the_camera_is_compared_along_its_own_directions() -> None:
    camera, sensor = Camera.pinhole_from_fov(60, 64, 48), Camera.pinhole_from_fov(50, 64, 48)
    planes = [
        (1 / (lens.resized(width, height).rays() @ (0.1, 0.05, 0.4))).astype(np.float32)
        for lens, width, height in ((camera, 256, 192), (sensor, 32, 24))
    ]
    poses, index = np.eye(4)[None], np.zeros(1, np.int64)
    truth = GroundTruth(poses, index, camera, planes[1][None], "z", None, sensor)
    np.testing.assert_allclose(sample_at_truth(planes[0], truth), planes[1], rtol=0.01)
    registered = GroundTruth(poses, index, camera, planes[1][None], "z", None)
    assert np.abs(sample_at_truth(planes[0], registered) / planes[1] - 1).max() > 0.02


@pytest.mark.parametrize("kind", ["pinhole", "mei"])
def test_depth_kinds_convert_back(kind: str) -> None:
    camera = CAMERAS[kind]
    depth = np.random.default_rng(0).uniform(1, 5, (48, 64)).astype(np.float32)
    ray = convert_depth(depth, camera, "z", "ray")
    assert (ray >= depth * (1 - 1e-6)).all()
    np.testing.assert_allclose(convert_depth(ray, camera, "ray", "z"), depth, rtol=1e-5)


def load_scorer(shared_data: Path) -> ModuleType:
    path = shared_data.parent / "bench" / "score.py"
    if not path.is_file():
        pytest.skip("the independent scorer is not beside the checkout")
    spec = importlib.util.spec_from_file_location("independent_score", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("kind", ["pinhole", "mei", "equirect"])
def test_agrees_with_the_independent_scorer(shared_data: Path, kind: str) -> None:
    scorer = load_scorer(shared_data)
    rng = np.random.default_rng(7)
    camera = CAMERAS[kind]
    rows, columns = camera.height // 4, camera.width // 4
    truth = walk(20, 5)
    true_kind = "z" if kind == "pinhole" else "ray"
    depth = rng.uniform(1, 6, (20, rows, columns)).astype(np.float32)
    depth[:, :3] = 0
    dynamic = rng.random(depth.shape) < 0.2
    gt: dict[str, Any] = {
        "cam_to_world": truth,
        "intrinsics": np.array(camera.params or (0.0,) * 4),
        "camera": np.array(kind),
        "depth": depth.astype(np.float16),
        "depth_kind": np.array(true_kind),
        "dynamic": dynamic,
        "width": np.array(camera.width),
        "height": np.array(camera.height),
    }
    noisy = truth.copy()
    noisy[:, :3, 3] += rng.normal(size=(20, 3)) * 0.02
    noisy[:, :3, :3] = noisy[:, :3, :3] @ Rotation.from_rotvec(rng.normal(size=(20, 3)) * 0.01).as_matrix()
    estimate = moved(noisy, 0.4, 3)
    estimated_camera = camera
    if camera.params:
        fx, fy, *rest = camera.params
        estimated_camera = Camera(camera.model, (1.03 * fx, 1.02 * fy, *rest), camera.width, camera.height)
    estimated_depth = (0.4 * depth * np.exp(rng.normal(size=depth.shape) * 0.15)).astype(np.float32)
    estimated_depth[:, :, :2] = np.nan
    index = np.r_[0:8, 10:20]
    estimated_kind = true_kind if kind == "equirect" else "z"
    prediction = {
        "cam_to_world": estimate[index],
        "frame_index": index,
        "intrinsics": np.array(estimated_camera.params or (0.0,) * 4),
        "depth": estimated_depth[index],
        "depth_kind": estimated_kind,
    }
    theirs = scorer.score(gt, prediction)

    ours = trajectory_errors(estimate[index], truth[index], index)
    assert ours.ate_rmse == pytest.approx(theirs["ate_rmse"], rel=1e-6)
    assert ours.scale == pytest.approx(theirs["sim3_scale"], rel=1e-6)
    assert ours.rte_rmse == pytest.approx(theirs["rte_rmse"], rel=1e-6)
    assert ours.rte_percent == pytest.approx(theirs["rte_pct"], rel=1e-6)
    assert ours.rre_rmse_deg == pytest.approx(theirs["rre_rmse_deg"], rel=1e-6)
    assert ours.rotation_rmse_deg == pytest.approx(theirs["aro_rmse_deg"], rel=1e-6)
    camera_part = camera_errors(estimated_camera, camera)
    if kind == "equirect":
        assert camera_part is None
    else:
        assert camera_part is not None
        assert camera_part.fov_x_deg == pytest.approx(theirs["fov_x_err"], rel=1e-6)
        assert camera_part.fov_y_deg == pytest.approx(theirs["fov_y_err"], rel=1e-6)
    # The scorer brings the truth to the estimate's kind of depth.
    factor = z_from_ray(camera, rows, columns) if estimated_kind != true_kind else 1.0
    stored = gt["depth"].astype(np.float64) * factor
    depth_part = depth_errors((estimated_depth[i], stored[i].astype(np.float32), ~dynamic[i]) for i in index)
    assert depth_part is not None
    assert depth_part.abs_rel == pytest.approx(theirs["depth_static"]["abs_rel"], rel=1e-5)
    assert depth_part.log_rmse == pytest.approx(theirs["depth_static"]["log_rmse"], rel=1e-5)
    assert depth_part.delta125 == pytest.approx(theirs["depth_static"]["delta125"], rel=1e-3)
    assert depth_part.scale == pytest.approx(theirs["depth_raw_scale"], rel=1e-5)
    assert depth_pose_scale_ratio(depth_part, ours) == pytest.approx(theirs["depth_pose_scale"], rel=1e-5)


def test_scale_and_shift_undo_scale_and_shift() -> None:
    rng = np.random.default_rng(3)
    truth = rng.uniform(2, 30, (4, 20, 30)).astype(np.float32)
    estimate = (truth - 1.5) / 4
    use = np.ones(truth.shape[1:], np.bool_)
    # A tenth of the values is far too near: least absolute errors do not follow them.
    estimate[:, :2] *= 0.3
    pairs = [(e, t, use) for e, t in zip(estimate, truth, strict=True)]
    errors = depth_errors(pairs, "scale_shift")
    assert errors is not None
    assert errors.scale == pytest.approx(4, rel=1e-3)
    assert errors.shift == pytest.approx(1.5, rel=1e-2)
    assert errors.delta125 == pytest.approx(0.9, abs=0.02)
    metric = depth_errors(pairs, "metric")
    assert metric is not None
    assert (metric.scale, metric.shift) == (1.0, 0.0)
    assert metric.abs_rel > 0.5


def test_depth_beyond_the_limit_is_not_judged() -> None:
    truth = np.array([[1.0, 2.0, 500.0]], np.float32)
    estimate = np.array([[1.0, 2.0, 3.0]], np.float32)
    use = np.ones((1, 3), np.bool_)
    limited = depth_errors([(estimate, truth, use)], max_depth=70.0)
    assert limited is not None
    assert (limited.abs_rel, limited.density) == (0.0, 1.0)
    # An estimate beyond the limit counts as one at the limit.
    far = depth_errors(
        [(np.array([[1.0, 2.0, 1e4]], np.float32), np.array([[1.0, 2.0, 50.0]], np.float32), use)], "metric", 70
    )
    assert far is not None
    assert far.abs_rel == pytest.approx((70 - 50) / 50 / 3)


def test_masks_by_hand() -> None:
    truth = np.zeros((4, 4), np.bool_)
    truth[:, :2] = True
    mask = np.zeros((8, 8), np.uint8)  # twice the size, one column to the right
    mask[:, 2:6] = 3
    errors = mask_errors([(mask, truth)])
    assert errors is not None
    assert errors.iou == pytest.approx(4 / 12)
    assert errors.recall == pytest.approx(0.5)
    assert errors.false_alarms == pytest.approx(0.5)
    # Pixels of all frames weigh the same: a second frame that is right halves the errors.
    second = mask_errors([(mask, truth), (truth.astype(np.uint8), truth)])
    assert second is not None
    assert second.iou == pytest.approx(12 / 20)
    assert second.false_alarms == pytest.approx(0.25)


def test_masks_where_nothing_or_everything_moves() -> None:
    still, all_moving = np.zeros((3, 5), np.bool_), np.ones((3, 5), np.bool_)
    nothing = mask_errors([(still.astype(np.uint8), still)])
    assert nothing is not None
    assert (nothing.iou, nothing.recall, nothing.false_alarms) == (None, None, 0.0)
    everything = mask_errors([(still.astype(np.uint8), all_moving)])
    assert everything is not None
    assert (everything.iou, everything.recall, everything.false_alarms) == (0.0, 0.0, None)
    assert mask_errors([]) is None
