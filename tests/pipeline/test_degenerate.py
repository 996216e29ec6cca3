"""Videos that give the engine little or the wrong thing: a sensible answer, a reason, and never a NaN.

Small pictures of two rendered places, kept in memory.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from vipe_core.annotation import Quality
from vipe_core.evaluation.synthetic import SyntheticClip, courtyard_scene, render_clip, sample_camera, tiny_clip
from vipe_core.evaluation.synthetic.paths import look_at, through
from vipe_core.geometry import umeyama
from vipe_core.priors.classical import classical_priors
from vipe_core.quality import assess
from vipe_core.slam.settings import SlamSettings
from vipe_core.slam.system import Slam, SlamResult
from vipe_core.video.source import Frame, FrameStream, VideoInfo

Array = NDArray[Any]
WIDTH, HEIGHT = 192, 144


class Held:
    """A `FrameSource` whose pictures are in memory."""

    def __init__(self, rgb: Array) -> None:
        self._rgb = rgb

    @property
    def info(self) -> VideoInfo:
        height, width = self._rgb.shape[1:3]
        return VideoInfo("held", "held", width, height, 24.0, None, None, 0, "none", "rgb24", 0)

    def frames(self, size: tuple[int, int] | None = None, start: int = 0, stop: int | None = None) -> FrameStream:
        for index in range(len(self._rgb))[start:stop]:
            rgb = self._rgb[index]
            yield Frame(index, index / 24, cv2.resize(rgb, size, interpolation=cv2.INTER_AREA) if size else rgb)


@dataclass(frozen=True)
class Answer:
    result: SlamResult
    quality: Quality

    @property
    def poses(self) -> Array:
        return self.result.world_from_cam

    def error(self, truth: Array, frames: slice = slice(None)) -> float:
        """RMS of the positions after the best similarity, as a share of the path."""
        found, true = self.poses[frames, :3, 3], truth[frames, :3, 3]
        shift = umeyama(found, true).apply(found) - true
        return float(np.sqrt(np.square(shift).sum(1).mean()) / np.linalg.norm(np.diff(true, axis=0), axis=1).sum())


def run(rgb: Array) -> Answer:
    with torch.inference_mode():
        result = Slam(classical_priors(), SlamSettings(), torch.device("cpu")).run(Held(rgb), lambda *_: None)
    answer = Answer(result, assess(result, SlamSettings(), rgb.shape[2]))
    poses, count = answer.poses, len(rgb)
    assert poses.shape == (count, 4, 4)
    assert np.isfinite(poses).all()
    rotation = poses[:, :3, :3]
    np.testing.assert_allclose(rotation @ rotation.transpose(0, 2, 1), np.tile(np.eye(3), (count, 1, 1)), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(rotation), 1, atol=1e-9)
    np.testing.assert_array_equal(poses[:, 3], np.tile([0, 0, 0, 1], (count, 1)))
    assert 0 < result.camera.focal_px < 100 * rgb.shape[2]
    assert np.isfinite(result.inverse_depth).all()
    assert (result.inverse_depth > 0).all()
    return answer


@pytest.fixture(scope="module")
def room() -> SyntheticClip:
    return tiny_clip("orbit", 24, WIDTH, HEIGHT, noise=1.0)


@pytest.fixture(scope="module")
def yard() -> SyntheticClip:
    poses = look_at(
        through([(-0.3, -2.0, 1.65), (0.2, 0.6, 1.66)], 24), through([(0.3, 12.0, 1.9), (1.4, 15.0, 1.8)], 24)
    )
    return render_clip(courtyard_scene(), sample_camera("pinhole", WIDTH, HEIGHT), poses, noise=1.0)


def exposed(rgb: Array, gain: float, gamma: float = 1.0) -> Array:
    return np.clip(255 * np.clip(rgb * (gain / 255), 0, 1) ** gamma, 0, 255).astype(np.uint8)


def test_a_static_camera_does_not_drift_and_says_so() -> None:
    answer = run(tiny_clip("static", 16, WIDTH, HEIGHT, noise=1.0).rgb)
    # The median depth is 1: the unit of the result.
    assert np.linalg.norm(answer.poses[:, :3, 3], axis=1).max() < 0.005
    assert "static_camera" in answer.quality.reasons
    assert answer.quality.reliable == "doubtful"


def test_a_camera_that_only_turns_is_right_in_rotation_and_says_so() -> None:
    clip = tiny_clip("pure_rotation", 24, WIDTH, HEIGHT, noise=1.0)
    answer = run(clip.rgb)
    truth = clip.world_from_cam[0, :3, :3].T @ clip.world_from_cam[:, :3, :3]
    apart = np.linalg.norm(truth - answer.poses[:, :3, :3], axis=(1, 2)) / np.sqrt(2)
    assert np.degrees(np.sqrt(np.square(apart).mean())) < 0.2
    assert "pure_rotation" in answer.quality.reasons
    np.testing.assert_array_equal(answer.poses[:, :3, 3], 0)


def test_shots_are_right_by_themselves_and_go_on_where_the_last_one_ended(
    room: SyntheticClip, yard: SyntheticClip
) -> None:
    answer = run(np.concatenate([room.rgb[:16], yard.rgb[:12]]))
    truth = np.concatenate([room.world_from_cam[:16], yard.world_from_cam[:12]])
    assert answer.quality.cuts == (16,)
    assert answer.error(truth, slice(0, 16)) < 0.01
    assert answer.error(truth, slice(16, 28)) < 0.01
    np.testing.assert_allclose(answer.poses[16], answer.poses[15], atol=1e-12)
    assert "shot_cut" in answer.quality.reasons
    assert answer.quality.reliable == "doubtful"


def flashed(rgb: Array) -> Array:
    rgb[12] = 255
    rgb[17] = np.random.default_rng(0).integers(0, 256, rgb[17].shape)
    return rgb


def blacked(rgb: Array) -> Array:
    rgb[9:13] = 0
    return rgb


def brightened(rgb: Array) -> Array:
    return np.concatenate([rgb[:8], exposed(rgb[8:16], 0.6), exposed(rgb[16:], 1.5)])


def flickering(rgb: Array) -> Array:
    return np.stack([exposed(picture, 1 + 0.35 * (-1) ** index) for index, picture in enumerate(rgb)])


def blurred(rgb: Array) -> Array:
    rgb[8:13] = [cv2.GaussianBlur(picture, (0, 0), 2.5) for picture in rgb[8:13]]
    return rgb


def letterboxed(rgb: Array) -> Array:
    rgb[:, :24] = rgb[:, -24:] = 16
    return rgb


def pale(rgb: Array) -> Array:
    return np.clip(128 + 0.06 * (rgb.astype(float) - 128), 0, 255).astype(np.uint8)


@pytest.mark.parametrize(
    ("spoil", "lost", "limit"),
    [
        (flashed, [12, 17], 0.01),
        pytest.param(blacked, [9, 10, 11, 12], 0.01, marks=pytest.mark.long),
        pytest.param(brightened, [], 0.01, marks=pytest.mark.long),
        (flickering, [], 0.015),
        (blurred, [], 0.015),
        pytest.param(letterboxed, [], 0.015, marks=pytest.mark.long),
        pytest.param(pale, [], 0.015, marks=pytest.mark.long),
    ],
)
def test_pictures_that_are_spoilt_leave_the_path_right(
    room: SyntheticClip, spoil: Callable[[Array], Array], lost: list[int], limit: float
) -> None:
    answer = run(spoil(room.rgb.copy()))
    assert answer.error(room.world_from_cam) < limit
    assert answer.quality.cuts == ()
    assert np.flatnonzero(answer.quality.frame_interpolated).tolist() == lost
    assert ("interpolated_frames" in answer.quality.reasons) == bool(lost)
    assert answer.quality.reliable != "no"


@pytest.mark.parametrize("order", ["pulldown", "frozen"])
def test_repeated_frames_do_no_harm(room: SyntheticClip, order: str) -> None:
    index = np.repeat(np.arange(24), [2 if k % 4 == 0 else 1 for k in range(24)])
    if order == "frozen":
        index = np.r_[0:10, [10] * 10, 11:24]
    answer = run(room.rgb[index])
    assert answer.error(room.world_from_cam[index]) < 0.01
    same = np.flatnonzero(np.diff(index) == 0)
    step = np.linalg.norm(answer.poses[same + 1, :3, 3] - answer.poses[same, :3, 3], axis=1)
    assert step.max() < 0.005


def test_steps_as_wide_as_four_frames_are_followed(room: SyntheticClip) -> None:
    answer = run(room.rgb[::4])
    assert answer.error(room.world_from_cam[::4]) < 0.01
    assert "few_frames" in answer.quality.reasons


@pytest.mark.parametrize("count", [1, 2, 3, 5])
def test_a_handful_of_frames_is_never_called_reliable(room: SyntheticClip, count: int) -> None:
    answer = run(room.rgb[:count])
    assert "few_frames" in answer.quality.reasons
    assert answer.quality.reliable != "yes"


def test_nothing_to_see_is_not_reliable() -> None:
    noise = np.random.default_rng(0).integers(0, 256, (10, 96, 128, 3), dtype=np.uint8)
    assert run(noise).quality.reliable == "no"
    assert run(np.zeros_like(noise)).quality.reliable == "no"


_SPOILERS = (flashed, blacked, brightened, flickering, blurred, letterboxed, pale)


@settings(max_examples=8, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    spoilers=st.lists(st.sampled_from(_SPOILERS), max_size=3),
    order=st.lists(st.integers(0, 47), min_size=1, max_size=10),
    size=st.sampled_from([(64, 48), (96, 24), (24, 96), (40, 40), (3, 2)]),
)
def test_any_mixture_of_troubles_gives_finite_poses(
    room: SyntheticClip,
    yard: SyntheticClip,
    spoilers: list[Callable[[Array], Array]],
    order: list[int],
    size: tuple[int, int],
) -> None:
    rgb = np.concatenate([room.rgb, yard.rgb])
    for spoil in spoilers:
        rgb = spoil(rgb.copy())
    video = np.stack([cv2.resize(rgb[index], size, interpolation=cv2.INTER_AREA) for index in sorted(order)])
    quality = run(video).quality
    assert quality.reliable in ("doubtful", "no")
    assert replace(quality, reasons=()).per_frame()["interpolated_frames"] is not None
