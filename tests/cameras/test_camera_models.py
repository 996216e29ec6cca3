"""Every camera model: round trips, known pixels, and derivatives against central differences."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from vipe_core.cameras import Camera, CameraModel, projection
from vipe_core.errors import ConfigError

CAMERAS = [
    Camera("pinhole", (500.0, 480.0, 330.0, 235.0), 640, 480),
    Camera("mei", (500.0, 480.0, 330.0, 235.0, 0.0), 640, 480),
    Camera("mei", (400.0, 410.0, 315.0, 245.0, 0.6), 640, 480),
    Camera("mei", (330.0, 330.0, 320.0, 240.0, 1.0), 640, 480),
    Camera("mei", (500.0, 500.0, 320.0, 240.0, 1.15), 640, 480),
    Camera("equirect", (), 640, 320),
]
CALIBRATED = CAMERAS[:-1]


def params_of(camera: Camera) -> torch.Tensor:
    return torch.from_numpy(camera.index_params())


@pytest.mark.parametrize("camera", CAMERAS)
def test_unproject_then_project(camera: Camera) -> None:
    rays = camera.rays()
    assert rays.shape == (camera.height, camera.width, 3)
    px, valid = camera.project(rays * np.random.default_rng(0).uniform(0.1, 50, rays.shape[:2])[..., None])
    v, u = np.mgrid[: camera.height, : camera.width]
    assert valid.all()
    np.testing.assert_allclose(px, np.stack((u, v), axis=-1), atol=1e-7)


@pytest.mark.parametrize("camera", CAMERAS)
@given(point=st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(-1, 1)))
def test_project_then_unproject(camera: Camera, point: tuple[float, float, float]) -> None:
    xyz = np.array(point)
    px, valid = camera.project(xyz)
    assert np.isfinite(px).all()
    norm = np.linalg.norm(xyz)
    if not valid or norm < 1e-3 or np.abs(px).max() > 1e4:
        return
    ray = camera.unproject(px)
    np.testing.assert_allclose(ray / np.linalg.norm(ray), xyz / norm, atol=1e-6)


@pytest.mark.parametrize("camera", CAMERAS)
def test_ray_normalisation(camera: Camera) -> None:
    rays = camera.rays(40, 60)
    measure = rays[..., 2] if camera.model == "pinhole" else np.linalg.norm(rays, axis=-1)
    np.testing.assert_allclose(measure, 1, atol=1e-12)


def test_pixel_convention() -> None:
    """The centre of the image, half a pixel beyond the last index before the middle, looks straight ahead."""
    for camera in (Camera.pinhole_from_fov(90, 8, 6), Camera("equirect", (), 8, 6)):
        np.testing.assert_allclose(camera.unproject((3.5, 2.5)), (0, 0, 1), atol=1e-12)
    # The left edge of the image, -0.5 as an index, is half of the field of view away.
    np.testing.assert_allclose(Camera.pinhole_from_fov(90, 8, 6).unproject((-0.5, 2.5)), (-1, 0, 1), atol=1e-12)


def test_equirect_directions() -> None:
    camera = Camera("equirect", (), 360, 180)
    # Right is +x at +90 degrees of longitude; the top row looks up, which is -y.
    np.testing.assert_allclose(camera.unproject((269.5, 89.5)), (1, 0, 0), atol=1e-12)
    np.testing.assert_allclose(camera.unproject((89.5, 89.5)), (-1, 0, 0), atol=1e-12)
    np.testing.assert_allclose(camera.unproject((10.0, -0.5)), (0, -1, 0), atol=1e-12)
    theta, phi = math.radians(30), math.radians(60)
    expected = (math.sin(phi) * math.sin(theta), -math.cos(phi), math.sin(phi) * math.cos(theta))
    np.testing.assert_allclose(camera.unproject((180 + 30 - 0.5, 60 - 0.5)), expected, atol=1e-12)
    assert not camera.project(np.zeros(3))[1]


def test_unified_camera_without_distortion_is_pinhole() -> None:
    pinhole, mei = CAMERAS[0], CAMERAS[1]
    rays = mei.rays(30, 40)
    np.testing.assert_allclose(rays / rays[..., 2:], pinhole.rays(30, 40), atol=1e-12)
    points = np.random.default_rng(0).normal(size=(100, 3))
    np.testing.assert_array_equal(mei.project(points)[1], pinhole.project(points)[1])
    np.testing.assert_allclose(mei.project(points)[0], pinhole.project(points)[0], atol=1e-9)


def test_what_is_behind() -> None:
    behind_a_bit = np.array([1.0, 0.0, -0.4])
    assert not CAMERAS[0].project(behind_a_bit)[1]
    assert CAMERAS[2].project(behind_a_bit)[1], "a unified camera sees beyond 90 degrees"
    assert CAMERAS[3].project(behind_a_bit)[1]
    assert not CAMERAS[2].project(np.array([0.1, 0.0, -1.0]))[1]
    # For alpha > 1 the far side of the sphere would fold back onto the image.
    assert not CAMERAS[4].project(np.array([0.1, 0.0, -1.0]))[1]
    assert CAMERAS[5].project(np.array([0.1, 0.0, -1.0]))[1]


def test_pixels_off_the_image_disk_have_no_ray() -> None:
    camera = Camera("mei", (100.0, 100.0, 320.0, 240.0, 1.2), 640, 480)
    px = torch.tensor([[319.5, 239.5], [0.0, 0.0]], dtype=torch.float64)
    assert projection.on_image_disk("mei", params_of(camera), px).tolist() == [True, False]
    assert np.isfinite(camera.rays()).all()


@pytest.mark.parametrize("camera", CALIBRATED)
def test_projection_derivatives(camera: Camera) -> None:
    params = params_of(camera)
    rng = torch.Generator().manual_seed(0)
    points = torch.randn(50, 3, generator=rng, dtype=torch.float64) + torch.tensor([0.0, 0.0, 3.0])
    by_point, by_intrinsics = projection.project_jacobian(camera.model, params, points)
    step = 1e-6
    for axis in range(3):
        offset = torch.zeros(3, dtype=torch.float64)
        offset[axis] = step
        plus, _ = projection.project(camera.model, params, points + offset)
        minus, _ = projection.project(camera.model, params, points - offset)
        torch.testing.assert_close(by_point[..., axis], (plus - minus) / (2 * step), rtol=1e-6, atol=1e-5)
    for column, change in enumerate(intrinsic_changes(camera.model, params)):
        plus, _ = projection.project(camera.model, change(step), points)
        minus, _ = projection.project(camera.model, change(-step), points)
        torch.testing.assert_close(by_intrinsics[..., column], (plus - minus) / (2 * step), rtol=1e-6, atol=1e-5)
    assert by_intrinsics.shape[-1] == len(intrinsic_changes(camera.model, params))


@pytest.mark.parametrize("camera", CALIBRATED)
def test_ray_derivatives(camera: Camera) -> None:
    params = params_of(camera)
    px = torch.rand(50, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64) * torch.tensor([640, 480])
    jacobian = projection.unproject_jacobian(camera.model, params, px)
    step = 1e-6
    for column, change in enumerate(intrinsic_changes(camera.model, params)):
        plus = projection.unproject(camera.model, change(step), px)
        minus = projection.unproject(camera.model, change(-step), px)
        torch.testing.assert_close(jacobian[..., column], (plus - minus) / (2 * step), rtol=1e-6, atol=1e-8)


def intrinsic_changes(model: CameraModel, params: torch.Tensor):
    def log_focal(step: float) -> torch.Tensor:
        changed = params.clone()
        changed[:2] *= math.exp(step)
        return changed

    def alpha(step: float) -> torch.Tensor:
        changed = params.clone()
        changed[4] += step
        return changed

    return [log_focal, alpha] if model == "mei" else [log_focal]


@pytest.mark.parametrize("camera", CAMERAS)
def test_resizing_keeps_the_field_of_view(camera: Camera) -> None:
    half = camera.resized(camera.width // 2, camera.height // 2)
    corner = camera.unproject((-0.5, -0.5))
    np.testing.assert_allclose(half.unproject((-0.5, -0.5)), corner, atol=1e-12)
    assert half.fov_x_deg == pytest.approx(camera.fov_x_deg)


def test_index_params_round_trip() -> None:
    for camera in CAMERAS:
        again = Camera.from_index_params(camera.model, camera.index_params(), camera.width, camera.height)
        assert again == camera


def test_field_of_view_is_the_angle_between_edge_rays() -> None:
    camera = Camera("mei", (400.0, 400.0, 320.0, 240.0, 0.6), 640, 480)
    left, right = camera.unproject((-0.5, 239.5)), camera.unproject((639.5, 239.5))
    assert math.degrees(math.acos(left @ right)) == pytest.approx(camera.fov_x_deg)
    assert Camera.pinhole_from_fov(70, 640, 480).fov_x_deg == pytest.approx(70)


@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("fisheye", (1.0, 1.0, 0.0, 0.0)),
        ("pinhole", (1.0, 1.0, 0.0)),
        ("pinhole", (0.0, 1.0, 0.0, 0.0)),
        ("mei", (1.0, 1.0, 0.0, 0.0, math.nan)),
        ("equirect", (1.0,)),
    ],
)
def test_bad_cameras_are_refused(model: CameraModel, params: tuple[float, ...]) -> None:
    with pytest.raises(ConfigError):
        Camera(model, params, 10, 10)
