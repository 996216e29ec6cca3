"""Filling along planes and edges, and telling the sky."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vipe_core.depth.completion import complete
from vipe_core.depth.sky import find_sky

HEIGHT, WIDTH = 60, 80
NOTHING = np.zeros((HEIGHT, WIDTH), np.bool_)


def filled(
    value: np.ndarray, weight: np.ndarray, rgb: np.ndarray, apart: np.ndarray = NOTHING, tolerance: float = 0.1
) -> np.ndarray:
    return complete(value.astype(np.float32), weight.astype(np.float32), rgb, apart, 0.3, 4.0, tolerance)


def plain(level: int = 90) -> np.ndarray:
    return np.full((HEIGHT, WIDTH, 3), level, np.uint8)


@settings(max_examples=15, deadline=None)
@given(across=st.floats(-0.004, 0.004), down=st.floats(-0.006, 0.006))
def test_a_blank_plane_is_continued_through_a_hole(across: float, down: float) -> None:
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    truth = 0.6 + across * (x - WIDTH / 2) + down * (y - HEIGHT / 2)
    weight = np.ones((HEIGHT, WIDTH))
    weight[15:45, 20:60] = 0
    error = np.abs(filled(np.where(weight > 0, truth, 9.0), weight, plain()) / truth - 1)
    assert error.max() < 0.02


def test_a_plane_goes_on_beyond_what_is_measured() -> None:
    y, _ = np.mgrid[:HEIGHT, :WIDTH]
    truth = 0.2 + 0.01 * y
    weight = np.zeros((HEIGHT, WIDTH))
    weight[5:40] = 1
    error = np.abs(filled(truth, weight, plain()) / truth - 1)
    assert error[40:].max() < 0.15  # a level continuation is off by 0.25


def test_filling_stops_at_an_edge() -> None:
    rgb = plain(50)
    rgb[:, 40:] = 200
    truth = np.where(rgb[..., 0] > 100, 0.2, 1.0)
    weight = np.ones((HEIGHT, WIDTH))
    weight[10:50, 25:55] = 0
    error = np.abs(filled(np.where(weight > 0, truth, 7.0), weight, rgb) / truth - 1)
    assert np.median(error[weight == 0]) < 0.02
    assert (error < 0.25).mean() > 0.98


def test_a_lone_contradiction_is_left_out() -> None:
    truth = np.full((HEIGHT, WIDTH), 0.5)
    weight = np.ones((HEIGHT, WIDTH))
    wrong = truth.copy()
    wrong[20:23, 30:33] = 2.0
    weight[20:23, 30:33] = 0.05
    assert np.abs(filled(wrong, weight, plain()) / truth - 1).max() < 0.1


def test_nothing_is_carried_out_of_what_is_apart() -> None:
    apart = NOTHING.copy()
    apart[:20] = True
    value = np.where(apart, 5.0, 0.5)
    weight = np.ones((HEIGHT, WIDTH))
    weight[20:30] = 0
    assert np.abs(filled(value, weight, plain(), apart)[20:] / 0.5 - 1).max() < 0.01


def street(sky: tuple[int, int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sky over a textured road that runs from 2 m to 50 m: picture, inverse depth and belief."""
    rng = np.random.default_rng(0)
    rgb = rng.integers(40, 140, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    rgb[:25] = sky
    inverse = np.repeat(np.linspace(0.02, 0.5, HEIGHT - 25), WIDTH).reshape(-1, WIDTH)
    inverse = np.concatenate([np.full((25, WIDTH), 0.1), inverse]).astype(np.float32)
    belief = np.zeros((HEIGHT, WIDTH), np.float32)
    belief[25:] = 0.8
    return rgb, inverse, belief


@pytest.mark.parametrize("colour", [(120, 160, 230), (255, 255, 255)])
def test_blue_and_white_sky_is_found(colour: tuple[int, int, int]) -> None:
    sky = find_sky(*street(colour), NOTHING)
    assert sky[:22].all()
    assert not sky[25:].any()


def test_what_is_not_sky() -> None:
    rgb, inverse, belief = street((120, 160, 230))
    assert not find_sky(street((130, 110, 90))[0], inverse, belief, NOTHING).any()  # a brown wall
    indoors = np.where(belief > 0, 0.3 + 0.5 * inverse, 0.3).astype(np.float32)
    assert not find_sky(rgb, indoors, belief, NOTHING).any()  # a blue ceiling: nothing is far
    assert not find_sky(rgb[::-1].copy(), inverse[::-1], belief[::-1], NOTHING).any()  # water
    measured = np.where(belief > 0, belief, 0.8).astype(np.float32)
    assert not find_sky(rgb, inverse, measured, NOTHING).any()  # a blue wall at 10 m
    assert not find_sky(rgb, inverse, np.zeros_like(belief), NOTHING).any()  # nothing is known
