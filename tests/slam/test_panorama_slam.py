"""A panorama's poses and map from its six faces."""

from __future__ import annotations

import numpy as np
import pytest

from vipe_core.cameras import Camera
from vipe_core.cameras.cube import CubeFaces
from vipe_core.slam.panorama import FaceBlender, panorama_size

PANORAMA = Camera("equirect", (), 512, 256)
FACES = CubeFaces.of_size(128)


def box_inverse(rays: np.ndarray) -> np.ndarray:
    """Inverse length along `rays` to the walls of a box around the camera."""
    walls = np.array([[2.0, 3.0], [1.5, 2.5], [4.0, 2.0]])
    reach = np.where(rays > 0, walls[:, 1], walls[:, 0])
    return np.asarray((np.abs(rays) / reach).max(axis=-1))


def faces_of_box() -> np.ndarray:
    rays = FACES.camera.rays(16, 16).reshape(-1, 3)
    return np.stack([box_inverse(rays @ pose[:3, :3].T) for pose in FACES.panorama_from_face]).astype(np.float32)


def test_faces_become_distances_all_round() -> None:
    value, trust = FaceBlender(FACES, PANORAMA).distances(faces_of_box(), np.full((6, 256), 0.7, np.float32))
    truth = box_inverse(PANORAMA.rays(32, 64))
    assert value.shape == trust.shape == (32, 64)
    np.testing.assert_allclose(trust, 0.7, rtol=1e-5)
    # Inverse depth is linear on a wall; cells over an edge between two are interpolated across it.
    error = np.abs(value / truth - 1)
    assert np.median(error) < 1e-5
    assert error.max() < 0.06


def test_faces_that_know_nothing_are_not_asked() -> None:
    value = faces_of_box()
    trust = np.full((6, 256), 0.7, np.float32)
    trust[4] = 0
    value[4] = 100
    blended, sure = FaceBlender(FACES, PANORAMA).distances(value, trust)
    truth = box_inverse(PANORAMA.rays(32, 64))
    assert not sure[0].any()
    assert (sure[16] > 0).all()
    assert np.abs(blended / truth - 1)[sure > 0].max() < 0.06


def test_a_face_that_contradicts_the_surer_one_has_no_say() -> None:
    value, trust = faces_of_box(), np.full((6, 256), 0.7, np.float32)
    value[0] *= 3
    trust[0] = 0.01
    blended, _ = FaceBlender(FACES, PANORAMA).distances(value, trust)
    truth = box_inverse(PANORAMA.rays(32, 64))
    overlap = FACES.seen(PANORAMA.rays(32, 64))[1][0]
    shared = (overlap > 0) & (overlap < 0.9)
    assert np.abs(blended / truth - 1)[shared].max() < 0.06


def test_labels_come_from_the_face_that_sees_a_cell_best() -> None:
    labels = np.repeat(np.arange(6, dtype=np.int8)[:, None], 256, axis=1)
    found = FaceBlender(FACES, PANORAMA).labels(labels).reshape(32, 64)
    assert (found[0] == 4).all()
    assert (found[-1] == 5).all()
    assert found[16, 32] == 0
    assert found[16, 48] == 1
    assert found[16, 0] == found[16, 63] == 2
    assert found[16, 16] == 3


@pytest.mark.parametrize(
    ("width", "size"), [(1024, (1024, 512)), (1280, (1104, 552)), (7680, (1104, 552)), (250, (240, 120)), (8, (64, 32))]
)
def test_the_working_size_is_two_to_one_and_bounded(width: int, size: tuple[int, int]) -> None:
    assert panorama_size(width, 614400).size == size
