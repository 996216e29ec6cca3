"""The compiled loops against what they must compute."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vipe_core.cameras import Camera
from vipe_core.depth.completion import complete
from vipe_core.depth.geometry import View
from vipe_core.depth.kernels import aggregate, check, sweep_cost, upsample, winner


def camera_of(model: str) -> Camera:
    if model == "pinhole":
        return Camera.pinhole_from_fov(70, 40, 32)
    return Camera("mei", (30, 30, 20, 16, 0.7), 40, 32) if model == "mei" else Camera("equirect", (), 40, 20)


@pytest.mark.parametrize("model", ["pinhole", "mei", "equirect"])
def test_check_projects_as_the_camera_does(model: str) -> None:
    """A sphere or plane around the first camera, seen by a second one: the predicted inverse depth is the true one."""
    camera = camera_of(model)
    view = View.of(camera)
    inverse = np.full((camera.height, camera.width), 0.5, np.float32)
    shift = np.array([0.1, -0.05, 0.15])
    points = camera.rays() / 0.5 + shift
    px, imaged = camera.project(points)
    length = points[..., 2] if model == "pinhole" else np.linalg.norm(points, axis=-1)
    other = np.zeros_like(inverse)
    nearest = np.rint(px).astype(int)
    inside = imaged & (nearest >= 0).all(-1) & (nearest < (camera.width, camera.height)).all(-1)
    other[nearest[inside][:, 1], nearest[inside][:, 0]] = 1 / length[inside]
    votes, ratios = np.zeros_like(inverse), np.zeros_like(inverse)
    eye = np.eye(3, dtype=np.float32)
    check(inverse, view.rays, other, eye, shift.astype(np.float32), view.model, view.params, 0.03, votes, ratios)
    assert (votes[inside] == 1).mean() > 0.95
    assert votes[~inside].sum() == 0
    assert np.allclose(ratios[votes > 0], 1, atol=0.03)


def test_sweep_cost_is_correlation_of_the_warped_window() -> None:
    rng = np.random.default_rng(0)
    camera = Camera.pinhole_from_fov(60, 24, 20)
    view = View.of(camera)
    wide = rng.uniform(0, 255, (20, 30)).astype(np.float32)
    reference, source = wide[:, :24].copy(), (0.5 * wide[:, 3:27] + 20).copy()  # moved by 3 px, other exposure
    planes = np.array([0.0, 1.0, 2.0], np.float32)
    # Inverse depth 1 moves the picture by 3 px.
    translation = np.array([[-3 / camera.focal_px, 0, 0]], np.float32)
    eye = np.eye(3, dtype=np.float32)[None]
    base = np.zeros_like(reference)
    cost = sweep_cost(
        reference, view.rays, base, planes, source[None], eye, translation, view.model, view.params, 2, 1e-3
    )
    assert np.abs(cost[2:-2, 6:-3, 1]).max() < 1e-3
    window, other = reference[5:10, 8:13], source[5:10, 8:13]
    expected = 1 - np.corrcoef(window.ravel(), other.ravel())[0, 1]
    assert cost[7, 10, 0] == pytest.approx(expected, abs=1e-3)
    assert (cost[:, :2, 1] == 1).all()  # these windows reach outside of the source


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 1000), n=st.integers(2, 7))
def test_aggregation_without_smoothness_only_scales(seed: int, n: int) -> None:
    cost = np.random.default_rng(seed).uniform(0, 2, (5, 6, n)).astype(np.float32)
    total = aggregate(cost, np.zeros((5, 6), np.float32), 0.0, 0.0, 1.0)
    assert np.array_equal(total.argmin(-1), cost.argmin(-1))


def test_aggregation_removes_a_speck_and_keeps_a_step_at_an_edge() -> None:
    truth = np.zeros((11, 16), int)
    truth[:, 8:] = 4
    gray = np.where(truth == 4, 200, 20).astype(np.float32)
    cost = np.ones((11, 16, 6), np.float32)
    np.put_along_axis(cost, truth[..., None], 0.2, -1)
    cost[5, 3] = 1.0
    cost[5, 3, 5] = 0.1
    position, _ = winner(aggregate(cost, gray, 0.1, 1.0, 12.0), cost)
    assert np.abs(position - truth).max() < 0.5


def test_winner_is_exact_on_a_parabola() -> None:
    k = np.arange(8)
    total = ((k - 3.3) ** 2).astype(np.float32)[None, None]
    position, _ = winner(total, total)
    assert position[0, 0] == pytest.approx(3.3, abs=1e-5)


def test_upsampling_follows_the_edge_of_the_picture_without_mixing() -> None:
    gray = np.full((8, 8), 30, np.float32)
    gray[:, 4:] = 220
    inverse = np.where(gray > 100, 1.0, 0.1).astype(np.float32)
    full = np.full((32, 32), 30, np.uint8)
    full[:, 18:] = 220  # the true edge lies two pixels beside the low-resolution one
    depth, sure = upsample(inverse, np.ones_like(inverse), gray, full, 6.0, 0.05)
    assert set(np.unique(depth.round(4)).tolist()) == {1.0, 10.0}
    assert np.array_equal(depth == depth.min(), full == 220)
    assert np.allclose(sure, 1)


def test_completion_keeps_what_is_known_and_stops_at_edges() -> None:
    gray = np.full((40, 60), 50, np.float32)
    gray[:, 30:] = 200
    truth = np.where(gray > 100, 0.2, 1.0).astype(np.float32)
    weight = np.ones_like(gray)
    weight[10:30, 20:40] = 0
    broken = np.where(weight > 0, truth, 7.0).astype(np.float32)
    filled = complete(broken, weight, gray, np.full_like(gray, 9.0))
    assert np.array_equal(filled[weight > 0], truth[weight > 0])
    error = np.abs(filled / truth - 1)[weight == 0]
    assert np.median(error) < 0.02
    assert (error < 0.25).mean() > 0.95


def test_completion_without_anything_known_is_the_fallback() -> None:
    zeros = np.zeros((6, 6), np.float32)
    assert (complete(zeros, zeros, zeros, zeros + 3) == 3).all()
