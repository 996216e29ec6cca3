"""Lenses with measured distortion: against OpenCV, round trips, and where they end."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vipe_core.cameras import Camera

BARREL = Camera("opencv", (310.0, 305.0, 330.0, 228.0, -0.28, 0.07, 1e-3, -5e-4, -0.006, 0, 0, 0), 640, 480)
RATIONAL = Camera("opencv", (400.0, 400.0, 320.0, 240.0, 0.6, 0.1, 0, 0, 0.01, 0.9, 0.3, 0.02), 640, 480)
FISHEYE = Camera("opencv_fisheye", (200.0, 202.0, 322.0, 238.0, 0.05, -0.01, 0.003, -0.0008), 640, 480)
LENSES = (BARREL, RATIONAL, FISHEYE)


@pytest.mark.parametrize("camera", LENSES)
@given(at=st.tuples(st.floats(-0.9, 0.9), st.floats(-0.7, 0.7)))
def test_projects_as_opencv_does(camera: Camera, at: tuple[float, float]) -> None:
    point = np.array([*at, 1.0])
    fx, fy, cx, cy = camera.index_params()[:4]
    matrix, lens = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), np.array(camera.params[4:])
    if camera.model == "opencv":
        expected = cv2.projectPoints(point[None], np.zeros(3), np.zeros(3), matrix, lens)[0].reshape(2)
    else:
        expected = cv2.fisheye.projectPoints(point[None, None], np.zeros(3), np.zeros(3), matrix, lens)[0].reshape(2)
    px, imaged = camera.project(3.7 * point)
    assert imaged
    np.testing.assert_allclose(px, expected, atol=1e-9)


@pytest.mark.parametrize("camera", LENSES)
def test_every_pixel_with_a_ray_comes_back(camera: Camera) -> None:
    v, u = np.mgrid[: camera.height : 7, : camera.width : 7]
    px = np.stack((u, v), axis=-1).astype(float)
    there = camera.has_ray(px)
    assert there.all()
    rays = camera.unproject(px)
    back, imaged = camera.project(rays * 2.5)
    assert imaged.all()
    np.testing.assert_allclose(back, px, atol=1e-6)
    measure = rays[..., 2] if camera.model == "opencv" else np.linalg.norm(rays, axis=-1)
    np.testing.assert_allclose(measure, 1, atol=1e-12)


def test_a_fisheye_sees_beyond_ninety_degrees() -> None:
    px, imaged = FISHEYE.project([[1.0, 0.0, -0.2], [0.0, 0.0, -1.0]])
    # The polynomial turns round before it comes to the direction straight back.
    assert imaged.tolist() == [True, False]
    assert px[0, 0] > FISHEYE.width / 2
    assert np.isfinite(px).all()
    assert FISHEYE.fov_x_deg > 150


def test_what_lies_beyond_the_turn_of_the_polynomial_is_not_imaged() -> None:
    turning = Camera("opencv", (200.0, 200.0, 320.0, 240.0, -0.3, 0, 0, 0, 0, 0, 0, 0), 640, 480)
    # x (1 - 0.3 x^2) turns round at x = 1.054, where it is 0.703: 140 pixels from the centre.
    px = np.array([[320 + 130.0, 239.5], [320 + 150.0, 239.5]])
    assert turning.has_ray(px).tolist() == [True, False]
    imaged = turning.project([[1.0, 0, 1], [1.2, 0, 1], [0, 0, -1]])[1]
    assert imaged.tolist() == [True, False, False]
    assert np.isfinite(turning.rays(48, 64)).all()


def test_a_resize_scales_pixels_and_keeps_rays() -> None:
    for camera in LENSES:
        half = camera.resized(320, 240)
        np.testing.assert_allclose(half.unproject([50.0, 60.0]), camera.unproject([100.5, 120.5]), atol=1e-9)
        assert half.fov_x_deg == pytest.approx(camera.fov_x_deg)


def test_the_field_of_view_counts_the_principal_point() -> None:
    assert Camera("pinhole", (100.0, 100.0, 0.0, 50.0), 100, 100).fov_x_deg == pytest.approx(45)
    assert Camera("pinhole", (100.0, 100.0, 50.0, 50.0), 100, 100).fov_x_deg == pytest.approx(53.130102)
