"""Moving things stand where they meet the static scene; saturated hypotheses and contradictions do not count."""

from __future__ import annotations

import numpy as np

from vipe_core.cameras import Camera
from vipe_core.depth.consistency import confirm
from vipe_core.depth.geometry import Prior, View
from vipe_core.depth.moving import stand, unrefuted
from vipe_core.depth.sweep import RawDepth
from vipe_core.depth.types import DepthSettings

HEIGHT, WIDTH = 60, 80


def floor_and_wall() -> np.ndarray:
    """Inverse depth of a wall at 5 m over a floor that comes up to 1 m."""
    inverse = np.full((HEIGHT, WIDTH), 0.2, np.float32)
    inverse[30:] = np.linspace(0.2, 1.0, HEIGHT - 30, dtype=np.float32)[:, None]
    return inverse


def test_a_thing_stands_on_the_ground_below_it() -> None:
    scene = floor_and_wall()
    thing = np.zeros((HEIGHT, WIDTH), np.bool_)
    thing[10:45, 20:35] = True
    found = stand(scene, thing, ~thing)
    assert np.ptp(found[thing]) == 0
    assert abs(found[thing][0] / scene[46, 0] - 1) < 0.1
    assert np.array_equal(found[~thing], scene[~thing])


def test_a_thing_that_the_picture_cuts_off_is_as_near_as_the_nearer_part_of_what_is_around_it() -> None:
    scene = floor_and_wall()
    thing = np.zeros((HEIGHT, WIDTH), np.bool_)
    thing[20:, 20:35] = True
    value = stand(scene, thing, ~thing)[thing][0]
    assert scene[45, 0] < value <= scene.max()


def test_what_is_measured_as_static_stays() -> None:
    scene = floor_and_wall()
    thing = np.zeros((HEIGHT, WIDTH), np.bool_)
    thing[10:45, 20:35] = True
    assert np.array_equal(stand(scene, thing, np.ones_like(thing)), scene)


def test_a_mask_over_what_is_measured_as_static_is_refuted() -> None:
    rng = np.random.default_rng(0)
    moving = np.zeros((HEIGHT, WIDTH), np.bool_)
    moving[:, 10:30] = moving[:, 50:70] = True
    measured = rng.random((HEIGHT, WIDTH)) < np.where(np.arange(WIDTH) < 40, 0.8, 0.03)
    found = unrefuted(moving, measured)
    assert not found[:, 10:30].any()
    assert np.array_equal(found[:, 50:70], moving[:, 50:70])
    assert not found[~moving].any()


def test_other_frames_refute_a_mask_only_where_enough_of_them_agree() -> None:
    view = View.of(Camera.pinhole_from_fov(60, WIDTH, HEIGHT))
    ones = np.ones((HEIGHT, WIDTH), np.float32)
    prior = Prior(0.5 * ones[:8, :8], ones[:8, :8], 0.3, 0.8)
    raw = RawDepth(0.5 * ones, 0.9 * ones, 0.4 * ones, True)
    masked = np.zeros((HEIGHT, WIDTH), np.bool_)
    masked[10:50, 10:60] = True
    two, three = (confirm(raw, [(np.eye(4), raw)] * n, view, prior, masked, DepthSettings()) for n in (2, 3))
    assert np.array_equal(two.moving, masked)
    assert not two.belief[masked].any()
    assert not three.moving.any()
    assert (three.belief > 0.8).all()


def test_only_what_others_agree_with_is_believed() -> None:
    view = View.of(Camera.pinhole_from_fov(60, WIDTH, HEIGHT))
    rng = np.random.default_rng(0)
    ones = np.ones((HEIGHT, WIDTH), np.float32)
    prior = Prior(0.5 * ones[:8, :8], ones[:8, :8], 0.3, 0.8)
    nothing_moves = np.zeros((HEIGHT, WIDTH), np.bool_)

    def raw(left: float, score: float = 0.9) -> RawDepth:
        inverse = np.where(np.arange(WIDTH) < 40, left, 0.5) * ones
        return RawDepth(inverse.astype(np.float32), score * ones, 0.4 * ones, True)

    still = np.eye(4)
    # Three frames from the same place: they agree on the right half, on the left each says something else.
    others = [(still, raw(float(left))) for left in rng.uniform(0.1, 0.2, 3)]
    found = confirm(raw(0.5), others, view, prior, nothing_moves, DepthSettings())
    assert (found.belief[:, 42:] > 0.8).all()
    assert not found.belief[:, :38].any()
    assert not found.weight[:, :38].any()
    # What others cannot see behind something nearer is not contradicted: it counts a little if it correlates well.
    nearer = [(still, raw(float(left))) for left in rng.uniform(0.8, 2.0, 3)]
    hidden, doubtful = (
        confirm(raw(0.31, score), nearer, view, prior, nothing_moves, DepthSettings()) for score in (0.9, 0.6)
    )
    assert not hidden.belief[:, :38].any()
    assert 0 < hidden.weight[:, :38].min() <= hidden.weight[:, :38].max() < 0.1
    assert not doubtful.weight[:, :38].any()
    unsure = confirm(raw(0.3, score=0.1), others, view, prior, nothing_moves, DepthSettings())
    assert not unsure.belief.any()
    alone = confirm(raw(0.9), [], view, prior, nothing_moves, DepthSettings())
    assert not alone.belief.any()
    assert 0 < alone.weight[:, 40:].max() < 0.2
    assert not alone.weight[:, :40].any(), "nearer than anything that is known"
