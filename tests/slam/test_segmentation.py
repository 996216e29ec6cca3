"""From labelled cells to the pixels of a moving thing."""

from __future__ import annotations

from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from vipe_core.ba.problem import Grid
from vipe_core.priors.protocols import Match
from vipe_core.slam.segmentation import MOVING, STATIC, UNKNOWN, carried, segment

GRID = Grid(24, 32)


def picture() -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """A red thing before a grey wall, at twice the working size, and where the thing is."""
    rng = np.random.default_rng(0)
    rgb = rng.integers(110, 130, (384, 512, 3)).astype(np.uint8)
    thing = np.zeros((384, 512), dtype=np.bool_)
    thing[96:320, 160:288] = True
    rgb[thing] = rng.integers(0, 20, (int(thing.sum()), 3)).astype(np.uint8) + np.array([200, 10, 10], np.uint8)
    return rgb, thing


def labels_of(thing: NDArray[np.bool_]) -> NDArray[Any]:
    return np.where(thing[8::16, 8::16], MOVING, STATIC).reshape(-1)


def test_what_geometry_leaves_open_goes_with_what_looks_like_it() -> None:
    rgb, thing = picture()
    labels = labels_of(thing).reshape(24, 32).copy()
    labels[12:, 8:20] = UNKNOWN
    mask = segment(rgb, labels.reshape(-1), GRID)
    assert mask.shape == thing.shape
    overlap = (mask > 0) & thing
    assert overlap.sum() / ((mask > 0) | thing).sum() > 0.9
    np.testing.assert_array_equal(mask, segment(rgb, labels.reshape(-1), GRID))


def test_a_few_scattered_labels_decide_about_the_hole_that_they_are_in() -> None:
    """What a thing that changes its shape leaves: hardly a measurement on it, static ones around it."""
    rgb, thing = picture()
    labels = np.where(thing[8::16, 8::16], UNKNOWN, STATIC)
    labels[7:20:3, 11:18:3] = MOVING
    mask = segment(rgb, labels.reshape(-1), GRID)
    overlap = (mask > 0) & thing
    assert overlap.sum() / ((mask > 0) | thing).sum() > 0.9


def test_specks_and_a_static_picture_make_no_mask() -> None:
    rgb, thing = picture()
    labels = np.full(GRID.num_cells, STATIC)
    assert not segment(rgb, labels, GRID).any()
    labels[[40, 200, 333]] = MOVING
    assert not segment(rgb, labels, GRID).any()
    assert not segment(rgb, np.full(GRID.num_cells, UNKNOWN), GRID).any()
    assert not segment(rgb, np.where(labels_of(thing) == MOVING, UNKNOWN, STATIC), GRID).any()


def test_labels_that_all_around_outvote_make_no_mask() -> None:
    """Crumbs in a static picture: enough of them for a thing, none that what is around them believes."""
    rgb, _ = picture()
    labels = np.full((24, 32), STATIC)
    for row in range(3, 21, 6):
        labels[row : row + 2, 4:28:6] = MOVING
        labels[row : row + 2, 5:29:6] = MOVING
        labels[row, 6:30:6] = MOVING
    assert not segment(rgb, labels.reshape(-1), GRID).any()


def test_a_thin_strip_and_a_picture_that_moves_as_a_whole_make_no_mask() -> None:
    rgb, _ = picture()
    labels = np.full((24, 32), STATIC)
    labels[10:12, 8:16] = MOVING
    assert not segment(rgb, labels.reshape(-1), GRID).any()
    labels = np.full((24, 32), MOVING)
    labels[10, 8] = STATIC
    assert not segment(rgb, labels.reshape(-1), GRID).any()


@settings(max_examples=50)
@given(
    hnp.arrays(np.int8, (12, 16), elements=st.sampled_from([MOVING, UNKNOWN, STATIC, STATIC]), fill=st.just(STATIC)),
    st.sampled_from([0, 128, 255]),
)
def test_any_labels_of_a_plain_picture_give_a_mask(labels: NDArray[Any], level: int) -> None:
    mask = segment(np.full((96, 128, 3), level, np.uint8), labels.reshape(-1), Grid(12, 16))
    assert mask.shape == (96, 128)
    assert mask.max() <= 1


def test_labels_travel_with_their_measurements() -> None:
    grid = Grid(3, 4)
    labels = np.array([MOVING, STATIC, UNKNOWN, STATIC] * 3)
    centres = grid.sample_px().numpy()
    weight = np.ones((12, 2), dtype=np.float32)
    weight[1] = 0
    votes = carried(labels, Match((centres + np.array([8, 0])).astype(np.float32), weight, 1.0), grid).reshape(3, 4)
    np.testing.assert_array_equal(votes[0], [0, 1, 0, 0])
    np.testing.assert_array_equal(votes[1], [0, 1, -1, 0])
