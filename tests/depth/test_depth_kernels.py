"""The compiled loops against what they must compute."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vipe_core.cameras import Camera
from vipe_core.depth.aggregation import aggregate, winner
from vipe_core.depth.geometry import View
from vipe_core.depth.kernels import check, sweep_cost
from vipe_core.depth.sweep import hypotheses, trimmed
from vipe_core.depth.upsampling import upsample


def camera_of(model: str) -> Camera:
    if model == "pinhole":
        return Camera.pinhole_from_fov(70, 40, 32)
    return Camera("mei", (30, 30, 20, 16, 0.7), 40, 32) if model == "mei" else Camera("equirect", (), 40, 20)


@pytest.mark.parametrize("model", ["pinhole", "mei", "equirect"])
def test_check_projects_as_the_camera_does(model: str) -> None:
    """A sphere or plane around the first camera, seen by a second one: the predicted inverse depth is the true one."""
    camera = camera_of(model)
    view = View.of(camera)
    inverse = np.full((camera.height, camera.width), 0.5, np.float32)
    shift = np.array([0.1, -0.05, 0.15])
    points = camera.rays() / 0.5 + shift
    px, imaged = camera.project(points)
    length = points[..., 2] if model == "pinhole" else np.linalg.norm(points, axis=-1)
    other = np.zeros_like(inverse)
    nearest = np.rint(px).astype(int)
    inside = imaged & (nearest >= 0).all(-1) & (nearest < (camera.width, camera.height)).all(-1)
    other[nearest[inside][:, 1], nearest[inside][:, 0]] = 1 / length[inside]
    eye, at = np.eye(3, dtype=np.float32), shift.astype(np.float32)

    def asked_of(seen: np.ndarray) -> list[np.ndarray]:
        answers = [np.zeros_like(inverse) for _ in range(4)]
        check(inverse, view.rays, seen, eye, at, view.model, view.params, 0.03, 0.0, *answers)
        return answers

    asked, hidden, votes, ratios = asked_of(other)
    assert (asked[inside] == 1).all()
    assert (votes[inside] == 1).mean() > 0.95
    assert asked[~inside].sum() == votes[~inside].sum() == 0
    assert np.allclose(ratios[votes > 0], 1, atol=0.03)
    asked, hidden, votes, _ = asked_of(2 * other)  # something nearer hides the surface: no contradiction
    assert (hidden[inside] == 1).mean() > 0.95
    assert not votes.any()


def moved_by_three() -> tuple[View, np.ndarray, np.ndarray, np.ndarray]:
    """A picture, the same one 3 px further at another exposure, and the translation that does so at inverse depth 1."""
    rng = np.random.default_rng(0)
    camera = Camera.pinhole_from_fov(60, 24, 20)
    wide = rng.uniform(0, 255, (20, 30)).astype(np.float32)
    reference, source = wide[:, :24].copy(), (0.5 * wide[:, 3:27] + 20).copy()
    return View.of(camera), reference, source, np.array([[-3 / camera.focal_px, 0, 0]], np.float32)


def cost_of(
    view: View, reference: np.ndarray, sources: np.ndarray, translation: np.ndarray, edge: float = 1e9, stride: int = 1
) -> np.ndarray:
    """Costs of inverse depths 0, 1 and 2; without a limit on `edge` all pixels of a window count the same."""
    count = len(sources)
    return np.asarray(
        sweep_cost(
            reference,
            view.rays,
            np.zeros_like(reference),
            np.ones_like(reference),
            np.array([0.0, 1.0, 2.0], np.float32),
            sources,
            np.tile(np.eye(3, dtype=np.float32), (count, 1, 1)),
            np.tile(translation, (count, 1)),
            view.model,
            view.params,
            2,
            stride,
            np.full(len(reference), stride),
            edge,
            1e-3,
        )
    )


def test_sweep_cost_is_correlation_of_the_warped_window() -> None:
    view, reference, source, translation = moved_by_three()
    cost = cost_of(view, reference, source[None], translation)
    assert np.abs(cost[2:-2, 6:-3, 1]).max() < 1e-3
    window, other = reference[5:10, 8:13], source[5:10, 8:13]
    expected = 1 - np.corrcoef(window.ravel(), other.ravel())[0, 1]
    assert cost[7, 10, 0] == pytest.approx(expected, abs=1e-3)
    assert (cost[:, :2, 1] == 1).all()  # these windows reach outside of the source
    sparse = cost_of(view, reference, source[None], translation, stride=2)
    expected = 1 - np.corrcoef(window[::2, ::2].ravel(), other[::2, ::2].ravel())[0, 1]
    assert sparse[7, 10, 0] == pytest.approx(expected, abs=1e-3)


def test_what_must_not_be_used_has_no_say() -> None:
    view, reference, source, translation = moved_by_three()
    masked = source.copy()
    masked[:, 12:] = np.nan
    both = cost_of(view, reference, np.stack([masked, source]), translation)
    alone = cost_of(view, reference, source[None], translation)
    assert np.array_equal(both[:, 15:], alone[:, 15:])
    assert np.isfinite(both).all()
    nothing = cost_of(view, reference, np.full_like(source, np.nan)[None], translation)
    assert (nothing == 1).all()


def test_what_only_one_of_four_sources_sees_is_not_better_for_it() -> None:
    view, reference, source, translation = moved_by_three()
    unseen = np.full_like(source, np.nan)
    all_see = cost_of(view, reference, np.stack([source] * 4), translation)
    one_sees = cost_of(view, reference, np.stack([source, unseen, unseen, unseen]), translation)
    inside = (slice(2, -2), slice(6, -3), 1)
    assert all_see[inside].max() < 1e-3
    np.testing.assert_allclose(one_sees[inside], 0.5, atol=1e-3)


def test_a_window_does_not_reach_over_an_edge() -> None:
    """Left of the edge the source shows the same, right of it something else: an adaptive window hardly cares."""
    view, reference, source, translation = moved_by_three()
    reference, source = 0.2 * reference, 0.2 * source
    reference[:, 12:] += 200
    source[:, 9:] = np.random.default_rng(1).uniform(0, 50, source[:, 9:].shape)
    adaptive = cost_of(view, reference, source[None], translation, edge=20.0)[2:-2, 10:12, 1]
    plain = cost_of(view, reference, source[None], translation)[2:-2, 10:12, 1]
    assert adaptive.max() < 0.05
    assert plain.min() > 0.2


def test_a_thing_that_is_too_wide_loses_its_rim_and_nothing_else() -> None:
    true = np.full((40, 40), 0.2, np.float32)
    true[10:30, 10:30] = 0.5
    wide = true.copy()
    wide[7:33, 7:33] = 0.5
    found = trimmed(wide, lambda d: np.abs(d - true)[..., None])
    assert (wide != true).sum() > 250
    assert (found != true).sum() <= 4, "but for the corners"
    np.testing.assert_array_equal(trimmed(true, lambda d: np.abs(d - true)[..., None]), true)
    blank = trimmed(wide, lambda d: np.ones((40, 40, 5), np.float32))
    np.testing.assert_array_equal(blank, wide)


@settings(max_examples=50, deadline=None)
@given(low=st.floats(1e-3, 1), ratio=st.floats(1.5, 200), count=st.integers(16, 64))
def test_hypotheses_cover_more_than_the_range(low: float, ratio: float, count: int) -> None:
    high = low * ratio
    planes = hypotheses(low, high, count)
    assert (np.diff(planes) > 0).all()
    assert planes[0] >= 0
    assert planes[0] <= low * (1 + 1e-5)
    assert planes[-1] >= 2 * high
    inside = planes[(planes > low) & (planes < high)]
    assert np.diff(inside).max() <= 1.01 * (high - low) / (count - 1) + 1e-6


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 1000), n=st.integers(2, 7))
def test_aggregation_without_smoothness_only_scales(seed: int, n: int) -> None:
    cost = np.random.default_rng(seed).uniform(0, 2, (5, 6, n)).astype(np.float32)
    total = aggregate(cost, np.zeros((5, 6), np.float32), 0.0, 0.0, 1.0)
    assert np.array_equal(total.argmin(-1), cost.argmin(-1))


def test_aggregation_removes_a_speck_and_keeps_a_step_at_an_edge() -> None:
    truth = np.zeros((11, 16), int)
    truth[:, 8:] = 4
    gray = np.where(truth == 4, 200, 20).astype(np.float32)
    cost = np.ones((11, 16, 6), np.float32)
    np.put_along_axis(cost, truth[..., None], 0.2, -1)
    cost[5, 3] = 1.0
    cost[5, 3, 5] = 0.1
    position, _, _ = winner(aggregate(cost, gray, 0.1, 1.0, 12.0), cost)
    assert np.abs(position - truth).max() < 0.5


def test_winner_is_exact_on_a_parabola_and_knows_its_rivals() -> None:
    k = np.arange(8)
    total = ((k - 3.3) ** 2).astype(np.float32)[None, None]
    raw = np.full((1, 1, 8), 0.9, np.float32)
    raw[0, 0, [3, 4, 7]] = 0.1, 0.2, 0.3
    position, cost, margin = winner(total, raw)
    assert position[0, 0] == pytest.approx(3.3, abs=1e-5)
    assert cost[0, 0] == pytest.approx(0.1)
    assert margin[0, 0] == pytest.approx(0.2)  # its neighbour is the same answer, the far one is not


def test_upsampling_follows_the_edge_of_the_picture_without_mixing() -> None:
    gray = np.full((8, 8), 30, np.float32)
    gray[:, 4:] = 220
    inverse = np.where(gray > 100, 1.0, 0.1).astype(np.float32)
    full = np.full((32, 32), 30, np.uint8)
    full[:, 18:] = 220  # the true edge lies two pixels beside the low-resolution one
    depth, sure = upsample(inverse, np.ones_like(inverse), gray, full, 6.0, 0.05)
    assert set(np.unique(depth.round(4)).tolist()) == {1.0, 10.0}
    assert np.array_equal(depth == depth.min(), full == 220)
    assert np.allclose(sure, 1)
