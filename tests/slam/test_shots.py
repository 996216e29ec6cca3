"""Cuts are found and nothing else is taken for one, on small rendered pictures."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from vipe_core.evaluation.synthetic import courtyard_scene, render_clip, sample_camera, tiny_clip
from vipe_core.evaluation.synthetic.paths import look_at, through
from vipe_core.priors.classical.flow import DisFlowMatcher
from vipe_core.priors.protocols import WorkingFrame
from vipe_core.slam.shots import Picture, ShotSplitter

Video = NDArray[np.uint8]
WIDTH, HEIGHT = 160, 120


@pytest.fixture(scope="module")
def room() -> Video:
    return tiny_clip("orbit", 20, WIDTH, HEIGHT, noise=1.0).rgb


@pytest.fixture(scope="module")
def yard() -> Video:
    poses = look_at(through([(-0.3, -2.0, 1.65), (0.1, -0.4, 1.66)], 14), np.array([0.5, 13.0, 1.9]))
    return render_clip(courtyard_scene(), sample_camera("pinhole", WIDTH, HEIGHT), poses, noise=1.0).rgb


@dataclass
class Split:
    placed: list[int] = field(default_factory=list)
    cuts: list[int] = field(default_factory=list)


def split(video: Video) -> Split:
    matcher = DisFlowMatcher()
    splitter, found = ShotSplitter(matcher), Split()
    batches = []
    for index, rgb in enumerate(video):
        frame = WorkingFrame(index, np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), np.uint8), rgb)
        features = matcher.encode(frame)
        if not matcher.is_blank(features):
            batches.append(splitter.add(Picture.of(frame, features)))
    for batch in [*batches, splitter.finish()]:
        found.placed += [one.picture.index for one in batch]
        found.cuts += [one.picture.index for one in batch if one.cut]
    return found


def exposed(video: Video, gain: float, gamma: float = 1.0) -> Video:
    return np.clip(255 * np.clip(video * (gain / 255), 0, 1) ** gamma, 0, 255).astype(np.uint8)


def test_one_cut_and_several(room: Video, yard: Video) -> None:
    assert split(np.concatenate([room, yard])).cuts == [20]
    assert split(np.concatenate([yard[:6], room[:6], yard[6:12], room[10:15]])).cuts == [6, 12, 18]


def test_a_shot_of_two_frames_at_the_end_is_a_shot(room: Video, yard: Video) -> None:
    found = split(np.concatenate([room[:10], yard[:2]]))
    assert found.cuts == [10]
    assert found.placed == list(range(12))


def test_a_cut_behind_black_frames_is_at_the_first_picture(room: Video, yard: Video) -> None:
    found = split(np.concatenate([room[:10], np.zeros_like(room[:3]), yard[:8]]))
    assert found.cuts == [13]
    assert not {10, 11, 12} & set(found.placed)


@pytest.mark.parametrize("length", [1, 2, 4])
def test_a_flash_is_passed_over_and_no_cut(room: Video, yard: Video, length: int) -> None:
    video = room.copy()
    video[8 : 8 + length] = yard[:length]
    found = split(video)
    assert found.cuts == []
    assert found.placed == [index for index in range(20) if not 8 <= index < 8 + length]


def test_black_frames_fades_and_a_picture_of_noise_are_no_cuts(room: Video) -> None:
    black, torn = room.copy(), room.copy()
    black[7:12] = 0
    torn[9] = np.random.default_rng(0).integers(0, 256, torn[9].shape)
    light = np.concatenate([np.linspace(0.05, 1, 6), np.ones(8), np.linspace(1, 0.05, 6)])
    for video in (black, torn, (room * light[:, None, None, None]).astype(np.uint8)):
        assert split(video).cuts == []


@pytest.mark.parametrize(("gain", "gamma"), [(0.4, 1.0), (1.8, 1.0), (1.0, 0.5), (1.0, 2.0)])
def test_a_jump_of_the_exposure_is_no_cut(room: Video, gain: float, gamma: float) -> None:
    found = split(np.concatenate([room[:8], exposed(room[8:], gain, gamma)]))
    assert found.cuts == []
    assert found.placed == list(range(20))


def test_wide_steps_and_blur_are_no_cuts(room: Video) -> None:
    assert split(room[::5]).cuts == []
    blurred = room.copy()
    blurred[8:13] = [cv2.GaussianBlur(picture, (0, 0), 2.5) for picture in blurred[8:13]]
    assert split(blurred).cuts == []


def test_pictures_that_have_nothing_in_common_are_no_shots(room: Video) -> None:
    noise = np.random.default_rng(1).integers(0, 256, (8, HEIGHT, WIDTH, 3), dtype=np.uint8)
    assert split(noise).cuts == []
    assert split(np.zeros_like(room)).placed == []


@given(st.lists(st.sampled_from(["room", "yard", "black", "noise"]), min_size=1, max_size=12))
def test_pictures_come_back_in_order_and_at_most_once(kinds: list[str]) -> None:
    rng = np.random.default_rng(len(kinds))
    textures = {
        name: cv2.GaussianBlur(np.random.default_rng(seed).integers(0, 256, (48, 64, 3), np.uint8), (0, 0), 2.0)
        for seed, name in enumerate(("room", "yard"))
    }
    textures["black"] = np.zeros((48, 64, 3), np.uint8)
    video = np.stack(
        [rng.integers(0, 256, (48, 64, 3), np.uint8) if kind == "noise" else textures[kind] for kind in kinds]
    )
    found = split(video)
    assert found.placed == sorted(set(found.placed))
    assert set(found.cuts) < set(found.placed) or not found.cuts
    assert all(kinds[index] != "black" for index in found.placed)
