"""Panoramas are told from other pictures by their borders."""

from __future__ import annotations

import numpy as np
import pytest

from vipe_core.evaluation.synthetic import tiny_clip
from vipe_core.priors.classical.panoramic import ends_apart, looks_panoramic


def test_a_panorama_is_recognised_whatever_the_shape_of_its_pixels() -> None:
    clip = tiny_clip("sideways", 2, 256, 128, model="equirect")
    assert looks_panoramic(list(clip.rgb))
    assert looks_panoramic([np.repeat(picture, 2, axis=0) for picture in clip.rgb])
    assert looks_panoramic([np.roll(picture, 77, axis=1) for picture in clip.rgb])


@pytest.mark.parametrize("model", ["pinhole", "mei"])
def test_other_cameras_are_not(model: str) -> None:
    clip = tiny_clip("sideways", 2, 128, 96, model="pinhole" if model == "pinhole" else "mei")
    assert not looks_panoramic(list(clip.rgb))


def test_half_a_panorama_and_a_cropped_one_are_not() -> None:
    picture = tiny_clip("sideways", 1, 256, 128, model="equirect").rgb[0]
    assert not looks_panoramic([picture[:, :192]])
    assert not looks_panoramic([picture[20:108]])
    assert ends_apart([picture[:, :192]])
    assert not ends_apart([picture])


def test_plain_borders_are_no_evidence() -> None:
    frame = np.zeros((96, 192, 3), np.uint8)
    assert not looks_panoramic([frame])
    frame[30:60, 50:120] = np.random.default_rng(0).integers(0, 255, (30, 70, 3))
    assert not looks_panoramic([frame])
    assert not looks_panoramic([])
    assert not ends_apart([frame])
    assert not ends_apart([])
