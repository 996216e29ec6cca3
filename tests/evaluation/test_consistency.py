"""Errors without ground truth: shuttle and Sampson, on hand-made motion and on rendered pictures."""

from __future__ import annotations

import math

import numpy as np
import pytest
from clip_source import ClipSource
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from vipe_core.cameras import Camera, CameraModel
from vipe_core.errors import ConfigError
from vipe_core.evaluation.consistency import (
    sampson_errors,
    sampson_px,
    shuttle_errors,
)
from vipe_core.evaluation.matching import SiftMatcher, point_matcher
from vipe_core.evaluation.synthetic import sample_camera, tiny_clip

CAMERA = Camera("pinhole", (300.0, 310.0, 160.0, 120.0), 320, 240)


def walk(count: int, seed: int) -> NDArray[np.float64]:
    rng = np.random.default_rng(seed)
    poses = np.repeat(np.eye(4)[None], count, axis=0)
    poses[:, :3, 3] = rng.normal(size=(count, 3)).cumsum(axis=0)
    poses[:, :3, :3] = Rotation.from_rotvec(rng.normal(size=(count, 3)).cumsum(axis=0) * 0.05).as_matrix()
    return poses


@settings(max_examples=30)
@given(scale=st.floats(0.01, 100), seed=st.integers(0, 500))
def test_the_same_path_backwards_has_no_shuttle_error(scale: float, seed: int) -> None:
    forward = walk(9, seed)
    world = np.eye(4)
    world[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    world[:3, 3] = (3, 1, -2)
    backward = (world @ forward)[::-1].copy()
    backward[:, :3, 3] *= scale
    errors = shuttle_errors(forward, CAMERA, backward, CAMERA)
    assert errors.ate == pytest.approx(0, abs=1e-9)
    assert errors.rte == pytest.approx(0, abs=1e-9)
    assert errors.rre_deg == pytest.approx(0, abs=1e-5)
    assert errors.fov_deg == 0


def test_shuttle_error_is_in_path_lengths_and_not_rescaled() -> None:
    """Two straight paths of length 1, one evenly paced and one not: a scale would hide part of the difference."""
    forward = np.repeat(np.eye(4)[None], 3, axis=0)
    forward[:, 0, 3] = (0, 5, 10)
    backward = forward[::-1].copy()
    backward[:, 0, 3] = (1.0, 0.6, 0.0)
    errors = shuttle_errors(forward, CAMERA, backward, Camera.pinhole_from_fov(CAMERA.fov_x_deg + 2, 320, 240))
    # Centres 0, .5, 1 against 0, .6, 1 with the means taken away.
    expected = np.array([0, 0.6, 1]) - np.array([0, 0.5, 1])
    assert errors.ate == pytest.approx(float(np.std(expected)))
    assert errors.rte == pytest.approx(0.1)
    assert errors.fov_deg == pytest.approx(2)


def test_shuttle_of_a_camera_that_stands_still() -> None:
    still = np.repeat(np.eye(4)[None], 4, axis=0)
    errors = shuttle_errors(still, CAMERA, still, CAMERA)
    assert (errors.ate, errors.rte, errors.rre_deg) == (None, None, 0.0)


def test_points_on_their_epipolar_lines_have_no_error() -> None:
    rng = np.random.default_rng(0)
    first, second = walk(2, 3)
    relative = np.linalg.inv(second) @ first
    points = rng.uniform((-1, -1, 3), (1, 1, 9), (50, 3))
    x = CAMERA.project(points)[0]
    y = CAMERA.project(points @ relative[:3, :3].T + relative[:3, 3])[0]
    distance = sampson_px(relative, CAMERA, x, y)
    np.testing.assert_allclose(distance, 0, atol=1e-8)


def test_sampson_distance_of_a_sideways_step() -> None:
    """Moving along x the epipolar lines are rows: an offset of h pixels down is a distance of h / sqrt(2)."""
    relative = np.eye(4)
    relative[0, 3] = 0.2
    square = Camera("pinhole", (300.0, 300.0, 160.0, 120.0), 320, 240)
    x = np.array([[10.0, 20.0], [200.0, 90.0]])
    y = x + np.array([[7.0, 0.5], [-4.0, 2.0]])
    distance = sampson_px(relative, square, x, y)
    np.testing.assert_allclose(distance, np.array([0.5, 2.0]) / math.sqrt(2), rtol=1e-9)


@pytest.mark.parametrize("model", ["mei", "opencv", "opencv_fisheye", "equirect"])
def test_of_a_bent_lens_the_distance_is_from_the_epipolar_curve(model: CameraModel) -> None:
    camera = sample_camera(model, 320, 240)
    rng = np.random.default_rng(1)
    first, second = walk(2, 3)
    relative = np.linalg.inv(second) @ first
    points = camera.unproject(rng.uniform((40, 60), (280, 180), (40, 2))) * rng.uniform(1, 5, 40)[:, None]
    (x, seen_x), (y, seen_y) = (camera.project(p) for p in (points, points @ relative[:3, :3].T + relative[:3, 3]))
    both = seen_x & seen_y
    assert both.sum() > 20
    np.testing.assert_allclose(sampson_px(relative, camera, x[both], y[both]), 0, atol=1e-8)
    # A match that is off by a little lies between nothing and that far from its curve.
    away = sampson_px(relative, camera, x[both], y[both] + rng.normal(0, 0.3, (both.sum(), 2)))
    assert 0.03 < np.median(away) < 0.4


def test_sampson_error_tells_true_poses_from_wrong_ones() -> None:
    clip = tiny_clip("orbit", 4, 320, 240)
    source, matcher = ClipSource(clip.rgb), SiftMatcher()
    true = sampson_errors(source, clip.world_from_cam, clip.camera, matcher)
    assert true is not None
    assert (true.pairs, true.matcher) == (3, "SIFT")
    assert true.matches > 100
    assert true.median_px < 0.3
    tilted = clip.world_from_cam.copy()
    for k, pose in enumerate(tilted):
        pose[:3, :3] = pose[:3, :3] @ Rotation.from_euler("x", 1.0 * k, degrees=True).as_matrix()
    wrong = sampson_errors(source, tilted, clip.camera, matcher)
    assert wrong is not None
    assert wrong.median_px > 5 * true.median_px
    assert wrong.mean_px > true.mean_px


def test_sampson_error_of_a_camera_that_stands_still() -> None:
    clip = tiny_clip("orbit", 3, 160, 120)
    assert (
        sampson_errors(ClipSource(clip.rgb), np.repeat(np.eye(4)[None], 3, axis=0), clip.camera, SiftMatcher()) is None
    )


def test_sift_finds_nothing_in_a_blank_picture() -> None:
    matcher = SiftMatcher()
    blank = matcher.detect(np.zeros((60, 80, 3), np.uint8))
    first, second = matcher.match(blank, blank)
    assert first.shape == second.shape == (0, 2)


def test_matchers_by_name() -> None:
    assert point_matcher("sift").name == "SIFT"
    with pytest.raises(ConfigError, match="unknown matcher"):
        point_matcher("orb")
