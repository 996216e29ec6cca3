"""What lines say about the focal length, and what becomes of claims that agree and that do not."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from vipe_core.ba.problem import Grid
from vipe_core.cameras import Camera
from vipe_core.priors.classical import CombinedFocalInit, FocalClaim, VanishingFocal
from vipe_core.priors.classical.claims import combine
from vipe_core.priors.protocols import WorkingFrame

WIDTH, HEIGHT = 640, 480


def working(picture: NDArray[np.uint8], index: int = 0) -> WorkingFrame:
    return WorkingFrame(index=index, rgb=np.repeat(picture[..., None], 3, axis=2), gray=picture)


def building(fov_deg: float, yaw_deg: float, pitch_deg: float, index: int) -> WorkingFrame:
    """The inside of a box of squared paper, drawn line by line."""
    focal = Camera.pinhole_from_fov(fov_deg, WIDTH, HEIGHT).focal_px
    picture = np.full((HEIGHT, WIDTH), 90, np.uint8)
    turn = Rotation.from_euler("xy", [pitch_deg, yaw_deg], degrees=True).as_matrix()
    steps = np.linspace(-2, 2, 6)
    for axis in range(3):
        for a in steps:
            for b in (-2.0, 2.0):
                for other in ((a, b), (b, a)):
                    ends = np.insert(np.tile(other, (2, 1)), axis, [-2.0, 2.0], axis=1)
                    ends += np.array([0.2, 0.1, 0.3])
                    points = np.linspace(ends[0], ends[1], 400) @ turn.T
                    points = points[points[:, 2] > 0.2]
                    if len(points) < 2:
                        continue
                    px = focal * points[[0, -1], :2] / points[[0, -1], 2:] + [WIDTH / 2, HEIGHT / 2]
                    first, last = (tuple(int(v) for v in np.clip(np.rint(16 * p), -(2**18), 2**18)) for p in px)
                    cv2.line(picture, first, last, 220, 2, cv2.LINE_AA, 4)
    return working(picture, index)


def log_focal(fov_deg: float) -> float:
    return math.log(Camera.pinhole_from_fov(fov_deg, WIDTH, HEIGHT).focal_px)


@pytest.mark.parametrize("fov_deg", [45.0, 60.0, 80.0])
def test_a_building_tells_the_focal_length_without_motion(fov_deg: float) -> None:
    claim = VanishingFocal().claim([building(fov_deg, 33 + 2 * k, 14, k) for k in range(3)])
    assert claim is not None
    assert abs(claim.log_focal - log_focal(fov_deg)) < 2 * claim.sigma
    assert claim.sigma < 0.2


def test_a_wall_seen_straight_on_tells_nothing() -> None:
    picture = np.full((HEIGHT, WIDTH), 90, np.uint8)
    picture[::40] = picture[:, ::40] = 220
    assert VanishingFocal().claim([working(picture)] * 3) is None


def test_pictures_without_straight_lines_tell_nothing() -> None:
    rng = np.random.default_rng(0)
    noise = cv2.GaussianBlur(rng.integers(0, 255, (HEIGHT, WIDTH), dtype=np.uint8), (0, 0), 6)
    picture = cv2.normalize(noise, None, 0, 255, cv2.NORM_MINMAX)
    assert VanishingFocal().claim([working(picture)] * 3) is None


def test_lines_on_masked_pixels_are_not_asked() -> None:
    seen = [building(60, 33 + 2 * k, 14, k) for k in range(3)]
    masked = [WorkingFrame(f.index, f.gray, f.rgb, np.zeros(f.gray.shape, np.bool_)) for f in seen]
    assert VanishingFocal().claim(seen) is not None
    assert VanishingFocal().claim(masked) is None


def test_claims_that_agree_are_surer_together() -> None:
    one, two = FocalClaim("one", 6.30, 0.10, 5), FocalClaim("two", 6.36, 0.05, 5)
    mean, sigma, rivals = combine([one, two], 6.33, 0.3)
    assert 6.30 < mean < 6.36
    assert sigma < 0.05
    assert rivals == ()


def test_a_contradiction_becomes_a_rival_that_the_sigma_reaches() -> None:
    sure, other = FocalClaim("sure", 6.3, 0.04, 5), FocalClaim("other", 6.8, 0.08, 5)
    mean, sigma, rivals = combine([other, sure], 6.3, 0.3)
    assert mean == pytest.approx(6.3, abs=0.02)
    assert rivals == (6.8,)
    assert mean + sigma >= 6.8


claim_lists = st.lists(st.tuples(st.floats(4, 9), st.floats(0.03, 0.5)), max_size=4)


@given(claims=claim_lists)
def test_whatever_is_claimed_the_answer_is_finite_and_within_the_claims(claims: list[tuple[float, float]]) -> None:
    found = [FocalClaim("any", value, sigma, 1) for value, sigma in claims]
    mean, sigma, rivals = combine(found, 6.0, 0.3)
    values = [6.0, *(value for value, _ in claims)]
    assert min(values) - 1e-9 <= mean <= max(values) + 1e-9
    assert math.isfinite(sigma)
    assert sigma > 0
    assert set(rivals) <= set(values)


class _Says:
    def __init__(self, claim: FocalClaim | None) -> None:
        self._claim = claim

    def claim(self, frames: Sequence[WorkingFrame]) -> FocalClaim | None:
        return self._claim


def test_the_camera_is_the_combined_claim_with_its_rivals() -> None:
    witnesses = [
        _Says(None),
        _Says(FocalClaim("a", log_focal(50), 0.03, 4)),
        _Says(FocalClaim("b", log_focal(80), 0.1, 3)),
    ]
    estimate = CombinedFocalInit(witnesses).estimate([building(60, 30, 10, 0)], Grid(HEIGHT // 8, WIDTH // 8))
    assert estimate.camera.fov_x_deg == pytest.approx(50, abs=0.5)
    assert estimate.num_pairs == 7
    assert [math.log(rival) for rival in estimate.rivals_px] == pytest.approx([log_focal(80)])
