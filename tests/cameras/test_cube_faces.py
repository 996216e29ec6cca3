"""The six faces of a panorama: they see every direction, agree with it, and share what they see twice."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vipe_core.cameras import Camera
from vipe_core.cameras.cube import FACES, CubeFaces

PANORAMAS = [Camera("equirect", (), 512, 256), Camera("equirect", (), 640, 360)]
DIRECTIONS = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: math.hypot(*v) > 1e-3)


@given(direction=DIRECTIONS)
def test_every_direction_is_seen_where_the_faces_say(direction: tuple[float, float, float]) -> None:
    faces = CubeFaces.of_size(64)
    ray = np.array(direction) / math.hypot(*direction)
    px, weight, cosine = faces.seen(ray)
    assert weight.sum() == pytest.approx(1)
    assert (weight >= 0).all()
    for face in np.flatnonzero(weight):
        assert (px[face] >= 0).all()
        assert (px[face] <= faces.size - 1).all()
        along = faces.camera.unproject(px[face])
        np.testing.assert_allclose(faces.panorama_from_face[face, :3, :3] @ along * cosine[face], ray, atol=1e-9)


@given(direction=DIRECTIONS, turn=st.floats(-1e-6, 1e-6))
def test_weights_have_no_step(direction: tuple[float, float, float], turn: float) -> None:
    faces = CubeFaces.of_size(64)
    _, weight, _ = faces.seen(np.array(direction))
    _, beside, _ = faces.seen(np.array(direction) + turn * math.hypot(*direction))
    np.testing.assert_allclose(weight, beside, atol=1e-4)


@pytest.mark.parametrize("panorama", PANORAMAS)
def test_pixels_of_the_faces_lie_in_the_panorama_where_their_rays_go(panorama: Camera) -> None:
    faces = CubeFaces.of_size(64)
    px = faces.panorama_px(panorama)
    assert px.shape == (6, 64, 64, 2)
    rays = panorama.unproject(px)
    for face, pose in enumerate(faces.panorama_from_face):
        local = rays[face] @ pose[:3, :3]
        np.testing.assert_allclose(local / local[..., 2:], faces.camera.rays(), atol=1e-9)
    assert (px >= -0.5).all()
    assert (px <= np.array([panorama.width, panorama.height]) - 0.5).all()


def test_faces_are_called_by_where_they_look() -> None:
    looks = CubeFaces.of_size(64).panorama_from_face[:, :3, 2]
    expected = {"front": (0, 0, 1), "right": (1, 0, 0), "back": (0, 0, -1), "left": (-1, 0, 0)}
    expected |= {"up": (0, -1, 0), "down": (0, 1, 0)}
    for name, axis in zip(FACES, looks, strict=True):
        np.testing.assert_array_equal(axis, expected[name])
    np.testing.assert_allclose(np.linalg.det(CubeFaces.of_size(64).panorama_from_face), 1)


@pytest.mark.parametrize(
    ("width", "area_px", "size"), [(1024, 10**6, 256), (1280, 10**6, 320), (7680, 614400, 320), (100, 10**6, 64)]
)
def test_faces_are_sized_to_the_source(width: int, area_px: int, size: int) -> None:
    faces = CubeFaces.for_panorama(width, area_px)
    assert faces.size == size
    assert 95 < faces.camera.fov_x_deg < 100


@pytest.mark.parametrize("panorama", PANORAMAS)
@given(azimuth=st.floats(-math.pi, math.pi), height=st.floats(1e-3, 10), out=st.floats(0, 1e-12))
def test_poles_and_the_seam_are_exact(panorama: Camera, azimuth: float, height: float, out: float) -> None:
    """Straight up and down lie on the border of the picture whatever the azimuth, and both ends look the same way."""
    x, z = out * math.sin(azimuth), out * math.cos(azimuth)
    up, imaged = panorama.project((x, -height, z))
    down, _ = panorama.project((x, height, z))
    assert imaged
    assert up[1] == pytest.approx(-0.5, abs=1e-6)
    assert down[1] == pytest.approx(panorama.height - 0.5, abs=1e-6)
    v = (height / 10) * panorama.height - 0.5
    left, right = panorama.unproject((-0.5, v)), panorama.unproject((panorama.width - 0.5, v))
    np.testing.assert_allclose(left, right, atol=1e-12)
    px, _ = panorama.project(left)
    assert min(abs(px[0] + 0.5), abs(px[0] - panorama.width + 0.5)) < 1e-6
