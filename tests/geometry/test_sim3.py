"""Similarity alignment."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vipe_core.geometry import Sim3, arrays, umeyama


def similarity(seed: int, scale: float) -> Sim3:
    rng = np.random.default_rng(seed)
    return Sim3(scale, arrays.exp(rng.normal(size=6))[:3, :3], rng.normal(size=3) * 10)


@given(st.integers(0, 1000), st.floats(1e-3, 1e3))
def test_recovers_the_similarity(seed: int, scale: float) -> None:
    truth = similarity(seed, scale)
    src = np.random.default_rng(seed + 1).normal(size=(12, 3))
    found = umeyama(src, truth.apply(src))
    assert found.scale == pytest.approx(scale, rel=1e-9)
    np.testing.assert_allclose(found.matrix, truth.matrix, atol=1e-8 * (1 + scale))


@given(st.integers(0, 1000), st.floats(1e-2, 1e2))
def test_products_and_inverses_are_those_of_the_matrices(seed: int, scale: float) -> None:
    first, second = similarity(seed, scale), similarity(seed + 1, 1.5)
    np.testing.assert_allclose((first @ second).matrix, first.matrix @ second.matrix, atol=1e-9 * (1 + scale))
    np.testing.assert_allclose((first @ first.inverse()).matrix, np.eye(4), atol=1e-9)


def test_without_scale_it_is_rigid() -> None:
    truth = similarity(3, 2.0)
    src = np.random.default_rng(0).normal(size=(20, 3))
    found = umeyama(src, truth.apply(src), with_scale=False)
    assert found.scale == 1.0
    np.testing.assert_allclose(found.rotation, truth.rotation, atol=1e-12)


def test_planar_points_do_not_give_a_reflection() -> None:
    truth = similarity(5, 1.5)
    src = np.random.default_rng(0).normal(size=(10, 3)) * [1, 1, 0]
    found = umeyama(src, truth.apply(src))
    assert np.linalg.det(found.rotation) == pytest.approx(1)
    np.testing.assert_allclose(found.apply(src), truth.apply(src), atol=1e-10)


def test_mirrored_points_get_a_proper_rotation() -> None:
    src = np.random.default_rng(0).normal(size=(10, 3))
    assert np.linalg.det(umeyama(src, src * [1, 1, -1]).rotation) == pytest.approx(1)


def test_a_straight_path_is_aligned() -> None:
    src = np.linspace(0, 1, 5)[:, None] * [1.0, 2.0, 3.0]
    truth = similarity(7, 4.0)
    found = umeyama(src, truth.apply(src))
    np.testing.assert_allclose(found.apply(src), truth.apply(src), atol=1e-10)
    assert np.linalg.det(found.rotation) == pytest.approx(1)


@given(st.integers(0, 200))
def test_it_is_the_least_squares_answer(seed: int) -> None:
    """No nearby similarity does better on noisy points."""
    rng = np.random.default_rng(seed)
    src = rng.normal(size=(15, 3))
    dst = similarity(seed, 2.0).apply(src) + 0.1 * rng.normal(size=(15, 3))
    weights = rng.uniform(0.1, 1, 15)
    found = umeyama(src, dst, weights=weights)

    def cost(candidate: Sim3) -> float:
        return float(weights @ ((candidate.apply(src) - dst) ** 2).sum(axis=1))

    best = cost(found)
    for _ in range(20):
        delta = arrays.exp(1e-3 * rng.normal(size=6))
        other = Sim3(
            found.scale * np.exp(1e-3 * rng.normal()),
            delta[:3, :3] @ found.rotation,
            found.translation + delta[:3, 3],
        )
        assert cost(other) >= best


def test_a_point_without_weight_has_no_say() -> None:
    truth = similarity(1, 3.0)
    src = np.random.default_rng(1).normal(size=(8, 3))
    dst = truth.apply(src)
    dst[0] += 100
    weights = np.ones(8)
    weights[0] = 0
    np.testing.assert_allclose(umeyama(src, dst, weights=weights).matrix, truth.matrix, atol=1e-9)


def test_inverse_and_poses() -> None:
    transform = similarity(2, 0.5)
    poses = arrays.exp(np.random.default_rng(2).normal(size=(4, 6)))
    moved = transform.apply_to_poses(poses)
    np.testing.assert_allclose(np.linalg.det(moved[:, :3, :3]), 1)
    np.testing.assert_allclose(transform.inverse().apply_to_poses(moved), poses, atol=1e-12)
    np.testing.assert_allclose(transform.inverse().matrix @ transform.matrix, np.eye(4), atol=1e-12)


@pytest.mark.parametrize(
    ("src", "dst"),
    [
        (np.zeros((0, 3)), np.zeros((0, 3))),
        (np.zeros((4, 2)), np.zeros((4, 2))),
        (np.zeros((4, 3)), np.zeros((5, 3))),
        (np.zeros((4, 3)), np.eye(4, 3)),
        (np.eye(4, 3), np.zeros((4, 3))),
        (np.full((4, 3), np.nan), np.eye(4, 3)),
    ],
)
def test_nothing_to_align(src: np.ndarray, dst: np.ndarray) -> None:
    with pytest.raises(ValueError, match="umeyama"):
        umeyama(src, dst)
