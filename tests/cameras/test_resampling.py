"""Resampling of distorted pictures: the two ways fit each other, and everything that the lens sees is kept."""

from __future__ import annotations

import numpy as np
import pytest

from vipe_core.cameras import Camera
from vipe_core.cameras.resampling import Resampling
from vipe_core.evaluation.synthetic import sample_camera

BARREL = sample_camera("opencv", 160, 120)
FISHEYE = sample_camera("opencv_fisheye", 160, 120)
ROUND = Camera("opencv_fisheye", (46.0, 46.0, 80.0, 60.0, 0.02, -0.008, 0.001, -1e-4), 160, 120)  # 200 degrees


@pytest.mark.parametrize(("lens", "model"), [(BARREL, "pinhole"), (FISHEYE, "mei"), (ROUND, "mei")])
def test_there_and_back(lens: Camera, model: str) -> None:
    found = Resampling.of(lens)
    assert found.ideal.model == model
    v, u = np.mgrid[: lens.height, : lens.width].astype(np.float64)
    there = found.ideal_px(np.stack((u, v), axis=-1))
    # Every pixel of the lens is in the ideal picture.
    assert there.min() > -0.6
    assert (there[..., 0] < found.ideal.width - 0.4).all()
    assert (there[..., 1] < found.ideal.height - 0.4).all()
    np.testing.assert_allclose(np.moveaxis(found.back.xy, 0, -1), there, atol=1e-3)
    back = found.lens.project(found.ideal.unproject(there))[0]
    np.testing.assert_allclose(back, np.stack((u, v), axis=-1), atol=1e-6)


@pytest.mark.parametrize("lens", [BARREL, FISHEYE, ROUND])
def test_the_middle_keeps_its_scale_and_the_picture_its_size(lens: Camera) -> None:
    found = Resampling.of(lens)
    cx, cy = lens.index_params()[2:4]
    middle = found.ideal_px(np.array([[cx, cy], [cx + 1, cy]]))
    assert np.linalg.norm(middle[1] - middle[0]) == pytest.approx(1.0, abs=0.25)
    assert found.ideal.width < 1.7 * lens.width
    assert found.ideal.height < 1.7 * lens.height


def test_outside_of_the_lens_nothing_is_claimed() -> None:
    found = Resampling.of(BARREL)
    assert 0.02 < found.forward.outside.mean() < 0.3
    assert not found.forward.outside[found.ideal.height // 2, found.ideal.width // 2]


def test_a_polynomial_that_turns_round_in_the_corners_costs_the_corners() -> None:
    lens = Camera("opencv", (100.0, 100.0, 80.0, 60.0, -0.22, 0, 0, 0, 0, 0, 0, 0), 160, 120)
    assert not lens.has_ray([0.0, 0.0])
    found = Resampling.of(lens)
    assert found.ideal.width <= 2 * lens.width
    assert (found.back.xy[:, 0, 0] < -1e5).all()
    assert found.back.xy[0, 60, 80] > 0


@pytest.mark.parametrize("lens", [BARREL, FISHEYE])
def test_a_refined_camera_becomes_the_lens_with_its_rays(lens: Camera) -> None:
    found = Resampling.of(lens)
    assert found.refined(found.ideal).params == pytest.approx(lens.params, rel=1e-4, abs=1e-4)
    ideal = found.ideal.zoomed(1.03)
    refined = found.refined(ideal)
    px = np.array([[20.0, 30.0], [80.0, 60.0], [150.0, 100.0]])
    rays, wanted = refined.unproject(px), ideal.unproject(found.ideal_px(px))
    rays, wanted = (r / np.linalg.norm(r, axis=-1, keepdims=True) for r in (rays, wanted))
    assert np.degrees(np.abs(rays - wanted).max()) < 0.03
