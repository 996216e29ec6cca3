"""The page of conventions (`vipe_core/CONVENTIONS.md`), sentence by sentence."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from vipe_core.ba import Grid
from vipe_core.cameras import Camera
from vipe_core.formats.artifacts import disk_intrinsics
from vipe_core.geometry import matrix_from_quaternion, se3

PINHOLE = Camera("pinhole", (300.0, 310.0, 160.0, 120.0), 320, 240)
MEI = Camera("mei", (150.0, 150.0, 160.0, 120.0, 0.6), 320, 240)
EQUIRECT = Camera("equirect", (), 512, 256)


def test_axes_are_x_right_y_down_z_forward() -> None:
    for camera in (PINHOLE, MEI, EQUIRECT):
        centre = np.array([camera.width / 2 - 0.5, camera.height / 2 - 0.5])
        px, _ = camera.project(np.array([[0.0, 0, 2], [0.1, 0, 2], [0, 0.1, 2]]))
        assert px[0] == pytest.approx(centre)
        assert px[1, 0] > centre[0]
        assert px[2, 1] > centre[1]


def test_a_twist_is_translation_then_rotation_and_acts_on_the_left() -> None:
    cam_from_world = se3.exp(torch.tensor([0.0, 0, 0, 0, 0.5, 0], dtype=torch.float64))
    step = torch.tensor([1.0, 0, 0, 0, 0, 0], dtype=torch.float64)
    moved = se3.exp(step) @ cam_from_world
    assert moved[:3, 3].tolist() == pytest.approx([1, 0, 0])  # along the camera's x axis, not the world's
    assert torch.allclose(moved[:3, :3], cam_from_world[:3, :3])


def test_quaternions_are_xyzw() -> None:
    half = np.sqrt(0.5)
    turn = np.asarray(matrix_from_quaternion(torch.tensor([0.0, 0, half, half], dtype=torch.float64)))
    assert turn[:3, :3] @ np.array([1.0, 0, 0]) == pytest.approx(np.array([0.0, 1, 0]))


def test_a_resize_multiplies_half_pixel_parameters() -> None:
    half = PINHOLE.resized(160, 60)
    assert half.params == pytest.approx((150.0, 77.5, 80.0, 30.0))
    # The same ray: pixel (i, j) of the small image covers four by two of the large one, around their common centre.
    small = half.unproject(np.array([[10.0, 20.0]]))
    large = PINHOLE.unproject(np.array([[(10.5 * 2) - 0.5, (20.5 * 4) - 0.5]]))
    assert small == pytest.approx(large)


def test_the_half_pixel_is_subtracted_for_integer_indices_and_not_on_disk() -> None:
    assert PINHOLE.index_params() == pytest.approx([300, 310, 159.5, 119.5])
    assert disk_intrinsics(PINHOLE) == pytest.approx([300, 310, 160, 120])


def test_rays_have_unit_depth_or_unit_length() -> None:
    assert PINHOLE.rays()[..., 2] == pytest.approx(1.0)
    assert np.linalg.norm(MEI.rays(), axis=-1) == pytest.approx(1.0)
    assert np.linalg.norm(EQUIRECT.rays(), axis=-1) == pytest.approx(1.0)


def test_a_panorama_looks_forward_in_the_middle_and_up_at_the_top() -> None:
    rays = EQUIRECT.rays()
    assert rays[128, 256] == pytest.approx([0, 0, 1], abs=0.02)
    assert rays[0, 256] == pytest.approx([0, -1, 0], abs=0.02)
    assert rays[128, 384] == pytest.approx([1, 0, 0], abs=0.02)


def test_the_unified_projection_is_the_papers() -> None:
    point = np.array([0.4, -0.2, 0.9])
    px, valid = MEI.project(point[None])
    expected = 150.0 * point[:2] / (point[2] + 0.6 * np.linalg.norm(point)) + np.array([159.5, 119.5])
    assert valid.all()
    assert px[0] == pytest.approx(expected)


def test_a_cell_samples_the_middle_of_its_pixels() -> None:
    cells = Grid(2, 3).sample_px().reshape(2, 3, 2)
    assert cells[1, 2].tolist() == [8 * 2 + 3.5, 8 * 1 + 3.5]
