"""The SLAM stage with a bent lens: poses and both numbers of the unified model from exact measurements."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from exact_scene import GRID, HEIGHT, WIDTH, ExactScene, trajectory
from hypothesis import given, settings
from hypothesis import strategies as st

from vipe_core.cameras import Camera
from vipe_core.cameras.ideal import ideal_camera, ideal_px
from vipe_core.geometry import umeyama
from vipe_core.geometry.arrays import exp, inverse
from vipe_core.priors.protocols import Match
from vipe_core.slam.consensus import agree
from vipe_core.slam.lens import focal_sigma_ratio
from vipe_core.slam.reprojection import Reprojector
from vipe_core.slam.settings import SlamSettings
from vipe_core.slam.system import Slam, SlamResult


def bent(fov_deg: float, alpha: float) -> Camera:
    half = math.radians(fov_deg) / 2
    focal_px = WIDTH / 2 * (math.cos(half) + alpha) / math.sin(half)
    return Camera("mei", (focal_px, focal_px, WIDTH / 2, HEIGHT / 2, alpha), WIDTH, HEIGHT)


WIDE = bent(118.0, 0.66)
ARC = (0.08, 0.006, 0.012, 0.002, -0.02, 0.001)


def run(scene: ExactScene, camera: Camera) -> SlamResult:
    priors = scene.priors(sigma=0.2, camera=camera)
    return Slam(priors, SlamSettings(), torch.device("cpu")).run(scene, lambda *_: None)


def test_path_field_of_view_and_bend_come_out_of_a_wrong_start() -> None:
    scene = ExactScene(trajectory(24, ARC), camera=WIDE, ripple=0.2)
    result = run(scene, bent(108.0, 0.5))
    truth, found = inverse(scene.cam_from_world)[:, :3, 3], result.world_from_cam[:, :3, 3]
    error = umeyama(found, truth).apply(found) - truth
    path = np.linalg.norm(np.diff(truth, axis=0), axis=1).sum()
    assert np.sqrt(np.square(error).sum(axis=1).mean()) < 3e-3 * path
    assert result.camera.model == "mei"
    assert result.camera.fov_x_deg == pytest.approx(118.0, abs=0.5)
    assert result.camera.params[4] == pytest.approx(0.66, abs=0.03)
    assert result.focal_sigma_ratio < 0.1


def test_turning_on_the_spot_with_a_bent_lens() -> None:
    scene = ExactScene(trajectory(24, (0, 0, 0, 0.004, 0.04, 0.002)), camera=WIDE, ripple=0.2)
    result = run(scene, WIDE)
    assert result.motion == "rotation"
    truth = inverse(scene.cam_from_world)[:, :3, :3]
    relative = truth[0] @ result.world_from_cam[:, :3, :3]
    angle = np.degrees(
        np.arccos(np.clip((np.trace(np.swapaxes(relative, 1, 2) @ truth, axis1=1, axis2=2) - 1) / 2, -1, 1))
    )
    assert angle.max() < 0.3


@settings(max_examples=40, deadline=None)
@given(st.floats(0, 1.1), st.floats(50, 200), st.integers(0, 10_000))
def test_agreement_gives_exact_depths_with_any_lens(alpha: float, fov_deg: float, seed: int) -> None:
    half = math.radians(fov_deg) / 2
    if math.cos(half) + alpha < 0.1:
        return
    camera, rng = bent(fov_deg, alpha), np.random.default_rng(seed)
    reprojector = Reprojector("mei", GRID)
    depth = rng.uniform(0.2, 1.0, GRID.num_cells)
    poses = np.stack([exp(np.concatenate((0.15 * rng.normal(size=3), 0.05 * rng.normal(size=3)))) for _ in range(2)])
    params = camera.index_params()
    seen = [reprojector.induced(params, pose, depth) for pose in poses]
    matches = [
        Match(np.nan_to_num(s.target_px), np.repeat(s.visible[:, None], 2, axis=1).astype(np.float32), 1.0)
        for s in seen
    ]
    found = agree(reprojector, params, poses, matches, 0.5)
    both = seen[0].visible & seen[1].visible
    # Along the line between the cameras no depth follows from float32 pixels.
    parallax_deg = reprojector.parallax_deg(params, poses[0], depth)
    sure = both & (parallax_deg > 1)
    assert (found.error_px[:, sure] < 0.05).all()
    np.testing.assert_allclose(found.inverse_depth[sure], depth[sure], rtol=0.02)


@given(st.floats(0, 1.2), st.floats(30, 200), st.floats(-0.6, 0.6), st.floats(-0.6, 0.6))
def test_the_ideal_pinhole_keeps_rays_and_scale(alpha: float, fov_deg: float, x: float, y: float) -> None:
    half = math.radians(fov_deg) / 2
    if math.cos(half) + alpha < 0.1:
        return
    camera = bent(fov_deg, alpha)
    point = np.array([[x, y, 1.0]])
    px, _ = camera.project(point)
    ideal, ahead = ideal_px(camera, px)
    fx, fy, cx, cy = ideal_camera(camera)["params"]
    assert ahead[0]
    np.testing.assert_allclose(ideal, [[fx * x + cx, fy * y + cy]], atol=1e-6)
    near, _ = camera.project(np.array([[1e-4, 0.0, 1.0]]))
    assert (near[0, 0] - cx) * 1e4 == pytest.approx(fx, rel=1e-3)
    behind, seen = ideal_px(bent(200.0, 1.0), np.array([[0.0, HEIGHT / 2]]))
    assert not seen[0]
    assert np.isfinite(behind).all()


def test_the_angle_of_view_can_be_sure_where_its_two_numbers_are_not() -> None:
    along = np.array([WIDE.zoomed(math.exp(1e-4)).fov_x_deg - WIDE.fov_x_deg, 0.0])
    more = Camera("mei", (*WIDE.params[:4], WIDE.params[4] + 1e-4), WIDTH, HEIGHT)
    along[1] = more.fov_x_deg - WIDE.fov_x_deg
    tangent = np.array([-along[1], along[0]]) / np.linalg.norm(along)  # a change that leaves the angle
    covariance = 0.04 * np.outer(tangent, tangent)
    pair = ((float(covariance[0, 0]), float(covariance[0, 1])), (float(covariance[1, 0]), float(covariance[1, 1])))
    assert math.sqrt(covariance[0, 0]) > 0.05
    found = focal_sigma_ratio(WIDE, pair)
    assert math.isnan(found) or found < 1e-3
    assert focal_sigma_ratio(Camera.pinhole_from_fov(60, 64, 48), ((0.01, 0.0), (0.0, 0.0))) == pytest.approx(0.1)
