"""The affine fit of video depth to the map: robust, smooth over time, and honest about what a frame does not tell."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vipe_core.depth.alignment import AffineTrack, Measurement, Samples, apply, guess, measure

RNG = np.random.default_rng


def samples_of(
    alpha: float,
    beta: float,
    *,
    near: float = 2.0,
    far: float = 0.2,
    noise: float = 0.02,
    wrong: float = 0.0,
    count: int = 800,
    patches: float = 40.0,
    seed: int = 0,
) -> Samples:
    """Inverse depths between `far` and `near`; the last `wrong` of them are of something nearer."""
    chance = RNG(seed)
    scene = chance.uniform(far, near, count)
    video = (scene * (1 + noise * chance.standard_normal(count)) - beta) / alpha
    video[count - int(wrong * count) :] += 0.8 * (near - far) / alpha
    return Samples(video, scene, np.full(count, patches / count))


def solution(found: Measurement | None) -> np.ndarray:
    assert found is not None
    return np.linalg.solve(found.information, found.vector)


@given(
    alpha=st.floats(0.01, 100),
    shift=st.floats(-1, 1),
    wrong=st.floats(0, 0.35),
    seed=st.integers(0, 5),
)
def test_the_affine_map_is_recovered_in_spite_of_wrong_regions(
    alpha: float, shift: float, wrong: float, seed: int
) -> None:
    found = measure(samples_of(alpha, shift, wrong=wrong, seed=seed), (1.0, 0.0))
    assert found is not None
    assert found.regime == "affine"
    a, b = solution(found)
    assert a == pytest.approx(alpha, rel=0.03)
    assert b == pytest.approx(shift, abs=0.03)
    assert found.sigma < 0.08
    assert found.inliers < 1 - 0.7 * wrong


def test_units_do_not_matter() -> None:
    one = samples_of(2.0, 0.3, wrong=0.2)
    far_away = Samples(one.video, one.scene / 1000, one.weight)
    first, second = measure(one, (1.0, 0.0)), measure(far_away, (0.001, 0.0))
    assert solution(second) == pytest.approx(solution(first) / 1000, rel=1e-3)


def test_too_small_a_range_of_depth_tells_one_number_only() -> None:
    flat = measure(samples_of(2.0, 0.3, near=1.01, far=0.99, noise=0.03), (1.5, 0.1))
    assert flat is not None
    assert flat.regime == "scale"
    # What it does tell is the inverse depth in the middle of its samples.
    video = float(np.median(samples_of(2.0, 0.3, near=1.01, far=0.99, noise=0.03).video))
    track = AffineTrack(0.02)
    track.add((1.5, 0.1), flat, 1.0)
    (alpha, beta), sigma = track.smoothed_first()
    assert alpha > 0
    assert alpha * video + beta == pytest.approx(1.0, rel=0.02)
    assert sigma < 0.05


def test_nothing_to_fit_is_no_measurement() -> None:
    empty = Samples(np.zeros(0), np.zeros(0), np.zeros(0))
    blind = samples_of(1.0, 0.0)
    assert measure(empty, (1.0, 0.0)) is None
    assert measure(Samples(np.full(800, np.nan), blind.scene, blind.weight), (1.0, 0.0)) is None
    assert measure(Samples(blind.video, blind.scene, 0 * blind.weight), (1.0, 0.0)) is None


@pytest.mark.parametrize(
    "video", [np.linspace(0.1, 3, 50), np.linspace(-5, 5, 50), np.full(50, 7.0), np.full(50, np.nan)]
)
def test_a_guess_is_positive_with_the_wanted_median(video: np.ndarray) -> None:
    alpha, beta = guess(video, 0.5)
    assert alpha > 0
    if np.isfinite(video).any():
        inverse = alpha * video + beta
        assert np.median(inverse) == pytest.approx(0.5, rel=1e-6)
        assert np.quantile(inverse, 0.02) > 0


def run(measured: list[Samples | None], lag: int = 8, drift: float = 0.02) -> np.ndarray:
    """(n, 2) smoothed (alpha, beta), as the depth stage asks for them."""
    track, held, out = AffineTrack(drift), 0, []
    for samples in measured:
        start = track.predicted(np.linspace(0, 1, 9), 1.0)
        track.add(start, None if samples is None else measure(samples, start), 1.0)
        held += 1
        if held > lag:
            out.append(track.smoothed_first()[0])
            track.drop_first()
            held -= 1
    for _ in range(held):
        out.append(track.smoothed_first()[0])
        track.drop_first()
    return np.array(out)


def levels(found: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Logarithm of the inverse depth found over the true one, at inverse depth 1."""
    video = (1 - wanted[:, 1]) / wanted[:, 0]
    return np.log(found[:, 0] * video + found[:, 1])


def drifting(count: int, step: float = 0.01, seed: int = 4) -> np.ndarray:
    walk = RNG(seed).standard_normal((2, count)).cumsum(axis=1) * step
    return np.stack((3 * np.exp(walk[0]), 0.2 + walk[1]), axis=-1)


def test_a_drifting_scale_is_followed_smoothly() -> None:
    wanted = drifting(60)
    found = run([samples_of(a, b, noise=0.1, patches=20, seed=i) for i, (a, b) in enumerate(wanted)])
    level = levels(found, wanted)
    assert np.abs(level).max() < 0.05
    assert np.abs(np.diff(level)).max() < 0.03


def test_regimes_change_without_a_jump() -> None:
    """Affine, then too flat to tell both, then nothing at all, then affine again."""
    wanted = drifting(60, step=0.003)
    measured: list[Samples | None] = []
    for i, (a, b) in enumerate(wanted):
        flat = 20 <= i < 32
        samples = samples_of(a, b, near=1.05 if flat else 2.0, far=0.95 if flat else 0.2, seed=i)
        measured.append(None if 32 <= i < 40 else samples)
    level = levels(run(measured), wanted)
    assert np.abs(level).max() < 0.04
    assert np.abs(np.diff(level)).max() < 0.012


def test_one_odd_frame_changes_little_and_a_lasting_change_is_believed() -> None:
    wanted = np.tile([2.0, 0.1], (40, 1))
    odd = [samples_of(a, b, seed=i) for i, (a, b) in enumerate(wanted)]
    odd[20] = samples_of(3.2, 0.1, seed=20)
    assert np.abs(levels(run(odd), wanted)).max() < 0.05
    changed = wanted.copy()
    changed[20:, 0] = 3.2
    found = run([samples_of(a, b, seed=i) for i, (a, b) in enumerate(changed)])
    assert np.abs(levels(found, changed)[27:]).max() < 0.03
    assert np.abs(levels(found, changed)[:13]).max() < 0.03


def test_what_comes_before_the_first_measurement_follows_it() -> None:
    wanted = np.tile([2.0, 0.1], (20, 1))
    found = run([None] * 5 + [samples_of(a, b, seed=i) for i, (a, b) in enumerate(wanted[5:])])
    assert np.abs(levels(found, wanted)).max() < 0.03


def test_infinity_is_kept_at_bay() -> None:
    assert apply(np.array([0.0, 1.0], np.float32), (2.0, -1.0), 0.25).tolist() == [0.25, 1.0]
