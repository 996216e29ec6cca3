"""The sweep over unified cameras on exact correspondences, and the choice between a pinhole and a bent lens."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from vipe_core.ba.problem import Grid
from vipe_core.cameras import Camera
from vipe_core.geometry.arrays import exp
from vipe_core.priors.classical.pairs import FramePair
from vipe_core.priors.classical.unified import UnifiedInit, sweep
from vipe_core.priors.protocols import IntrinsicsEstimate, WorkingFrame

WIDTH, HEIGHT = 640, 480
PINHOLE = Camera("pinhole", (500.0, 500.0, 320.0, 240.0), WIDTH, HEIGHT)


def camera(fov_deg: float, alpha: float) -> Camera:
    half = math.radians(fov_deg) / 2
    focal_px = WIDTH / 2 * (math.cos(half) + alpha) / math.sin(half)
    return Camera("mei", (focal_px, focal_px, WIDTH / 2, HEIGHT / 2, alpha), WIDTH, HEIGHT)


def pairs_of(truth: Camera, *, travel: float = 0.4, noise_px: float = 0.2, count: int = 3) -> list[FramePair]:
    """What pairs of frames of a scattered scene would be matched to; a fifth of it wrongly."""
    rng = np.random.default_rng(7)
    pairs = []
    for number in range(count):
        px = rng.uniform((0, 0), (WIDTH - 1, HEIGHT - 1), (500, 2))
        rays = truth.unproject(px)
        points = rays / np.linalg.norm(rays, axis=1, keepdims=True) * rng.uniform(1.5, 5, (len(px), 1))
        pose = exp(np.concatenate((travel * rng.normal(size=3), 0.1 * rng.normal(size=3))))
        seen, valid = truth.project(points @ pose[:3, :3].T + pose[:3, 3])
        inside = valid & ((seen >= 0) & (seen <= (WIDTH - 1, HEIGHT - 1))).all(axis=1)
        seen = seen + noise_px * rng.normal(size=seen.shape)
        wrong = rng.random(len(seen)) < 0.2
        seen[wrong] += rng.normal(scale=20, size=(int(wrong.sum()), 2))
        motion_px = float(np.median(np.linalg.norm(seen - px, axis=1)[inside]))
        pairs.append(FramePair(number, number + 1, px[inside], seen[inside], 1.0, motion_px))
    return pairs


@pytest.mark.parametrize(
    ("fov_deg", "alpha"),
    [pytest.param(60, 0.0, marks=pytest.mark.long), pytest.param(118, 0.66, marks=pytest.mark.long), (185, 1.0)],
)
def test_the_sweep_finds_field_of_view_and_bend(fov_deg: float, alpha: float) -> None:
    found = sweep(pairs_of(camera(fov_deg, alpha)), WIDTH, HEIGHT)
    assert found is not None
    assert found.camera.fov_x_deg == pytest.approx(fov_deg, rel=0.08)
    assert found.camera.params[4] == pytest.approx(alpha, abs=0.25)
    assert (found.gain > 0.3) == (alpha > 0)


class Frames:
    """A picker that was told its pairs, and a pinhole initialiser that says who it is."""

    def __init__(self, pairs: list[FramePair]) -> None:
        self._pairs = pairs

    def pairs(self, frames: Sequence[WorkingFrame]) -> list[FramePair]:
        return self._pairs

    def estimate(self, frames: Sequence[WorkingFrame], grid: Grid) -> IntrinsicsEstimate:
        return IntrinsicsEstimate(PINHOLE, 0.05, len(self._pairs))


def estimate(truth: Camera, *, automatic: bool, pairs: list[FramePair] | None = None) -> IntrinsicsEstimate:
    told = Frames(pairs_of(truth) if pairs is None else pairs)
    blank: NDArray[np.uint8] = np.zeros((HEIGHT, WIDTH), np.uint8)
    frames = [WorkingFrame(0, blank, np.repeat(blank[..., None], 3, axis=2), None)]
    return UnifiedInit(told if automatic else None, told).estimate(frames, Grid(HEIGHT // 8, WIDTH // 8))


def test_a_straight_lens_is_left_to_the_pinhole_and_a_bent_one_is_not() -> None:
    assert estimate(camera(60, 0.0), automatic=True).camera is PINHOLE
    bent = estimate(camera(130, 0.7), automatic=True).camera
    assert bent.model == "mei"
    assert estimate(camera(60, 0.0), automatic=False).camera.model == "mei"


def test_without_pairs_it_is_the_default() -> None:
    assert estimate(PINHOLE, automatic=True, pairs=[]).camera is PINHOLE
    default = estimate(PINHOLE, automatic=False, pairs=[])
    assert default.camera.model == "mei"
    assert default.num_pairs == 0
    assert default.log_focal_sigma >= 0.3
