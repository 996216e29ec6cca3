"""Clips that nobody films on purpose: every one ends with finite poses and positive depth, or with a typed error."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from vipe_core.formats import read_artifacts, write_artifacts
from vipe_core.pipeline.annotator import Annotator

Picture = NDArray[np.uint8]


def texture(width: int, height: int, shift: int = 0, seed: int = 0) -> Picture:
    noise = np.random.default_rng(seed).integers(0, 256, (height, width + 200, 3), dtype=np.uint8)
    smooth = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 1.5), np.empty_like(noise), 0, 255, cv2.NORM_MINMAX)
    return np.ascontiguousarray(smooth[:, shift : shift + width])


def pan(width: int, height: int, index: int) -> Picture:
    return texture(width, height, 4 * index)


def still(width: int, height: int, index: int) -> Picture:
    return texture(width, height)


def each_frame_thrice(width: int, height: int, index: int) -> Picture:
    return texture(width, height, 8 * (index // 3))


def cut_in_the_middle(width: int, height: int, index: int) -> Picture:
    return texture(width, height, 4 * index, seed=int(index >= 6))


def a_new_scene_each_frame(width: int, height: int, index: int) -> Picture:
    return texture(width, height, seed=index)


def noise(width: int, height: int, index: int) -> Picture:
    return np.random.default_rng(index).integers(0, 256, (height, width, 3), dtype=np.uint8)


def spiral(width: int, height: int, index: int) -> Picture:
    turn = cv2.getRotationMatrix2D((width / 2, height / 2), 3 * index, 1 + 0.05 * index)
    return np.asarray(cv2.warpAffine(texture(width, height), turn, (width, height)), np.uint8)


def constant(level: int) -> Callable[[int, int, int], Picture]:
    return lambda width, height, index: np.full((height, width, 3), level, np.uint8)


def flashes(width: int, height: int, index: int) -> Picture:
    return (constant(0) if index % 4 == 3 else pan)(width, height, index)


def half_black(width: int, height: int, index: int) -> Picture:
    picture = pan(width, height, index)
    picture[:, : width // 2] = 0
    return picture


@dataclass(frozen=True)
class Odd:
    draw: Callable[[int, int, int], Picture]
    width: int = 96
    height: int = 64
    frames: int = 6
    fps: Fraction = Fraction(24)


ODD = {
    "one pixel": Odd(pan, 1, 1, 3),
    "odd": Odd(pan, 33, 17),
    "tiny": Odd(pan, 64, 48),
    "portrait": Odd(spiral, 61, 107),
    "a strip": Odd(pan, 400, 8, 3),
    "a pillar": Odd(pan, 8, 400, 3),
    "huge": Odd(pan, 4096, 2160, 1),
    "one frame": Odd(pan, frames=1),
    "two frames": Odd(pan, frames=2),
    "three frames": Odd(pan, frames=3),
    "black": Odd(constant(0)),
    "white": Odd(constant(255)),
    "grey": Odd(constant(128)),
    "flashes": Odd(flashes, frames=8),
    "half black": Odd(half_black),
    "still": Odd(still),
    "repeats": Odd(each_frame_thrice, frames=9),
    "a cut": Odd(cut_in_the_middle, frames=10),
    "cuts only": Odd(a_new_scene_each_frame, 64, 48, 6),
    "noise": Odd(noise, 64, 48, 6),
    "a frame an hour": Odd(pan, frames=3, fps=Fraction(1, 3600)),
    "240 frames a second": Odd(pan, fps=Fraction(240)),
}


@pytest.fixture(scope="module")
def annotator() -> Annotator:
    return Annotator()


# Of these, `test_degenerate.py` or another of them is the like.
ALIKE = {"portrait", "huge", "three frames", "white", "grey", "flashes", "repeats", "a cut", "240 frames a second"}


@pytest.mark.slow
@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.long] * (n in ALIKE)) for n in ODD])
def test_an_odd_clip_has_finite_poses_and_positive_depth(annotator: Annotator, tmp_path: Path, name: str) -> None:
    odd = ODD[name]
    path = tmp_path / "odd.mkv"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=odd.fps)
        stream.width, stream.height, stream.pix_fmt = odd.width, odd.height, "bgr0"
        for index in range(odd.frames):
            container.mux(
                stream.encode(av.VideoFrame.from_ndarray(odd.draw(odd.width, odd.height, index), format="rgb24"))
            )
        container.mux(stream.encode(None))
    write_artifacts(annotator.annotate(path), tmp_path / "out")
    artifacts = read_artifacts(tmp_path / "out", "odd")
    assert artifacts.num_frames == odd.frames
    rotation = artifacts.world_from_cam[:, :3, :3]
    np.testing.assert_allclose(
        rotation @ rotation.transpose(0, 2, 1), np.tile(np.eye(3), (odd.frames, 1, 1)), atol=1e-5
    )
    assert np.isfinite(artifacts.world_from_cam).all()
    assert artifacts.info["quality"]["reliable"] != "yes"
    with artifacts.open_depth() as depths:
        for depth in depths:
            assert depth.shape == (odd.height, odd.width)
            assert np.isfinite(depth).all()
            assert (depth > 0).all()
