"""Panoramas in the depth stage: the seam is a place like any other, and so are the poles."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from clip_source import ClipSource, scene_of
from hypothesis import given
from hypothesis import strategies as st

from vipe_core.cameras import Camera
from vipe_core.depth.seam import Seam
from vipe_core.depth.stream import DenseDepth
from vipe_core.depth.types import DepthFrame, DepthSettings
from vipe_core.evaluation.synthetic import SyntheticClip, tiny_clip

SETTINGS = dataclasses.replace(DepthSettings.fast(), window_frames=6, check_frames=(2,))


@given(cells=st.integers(2, 40), scale=st.integers(1, 4), rows=st.integers(1, 3), channels=st.sampled_from([(), (3,)]))
def test_the_other_end_is_added_and_taken_away(cells: int, scale: int, rows: int, channels: tuple[int, ...]) -> None:
    seam = Seam(Camera("equirect", (), 8 * cells, 8 * cells))
    values = np.random.default_rng(0).random((rows, scale * cells, *channels)).astype(np.float32)
    around = seam.around(values)
    added = (around.shape[1] - values.shape[1]) // 2
    assert added > 0
    np.testing.assert_array_equal(
        around,
        np.roll(np.concatenate([values] * 3, axis=1), 0, axis=1)[
            :, values.shape[1] - added : 2 * values.shape[1] + added
        ],
    )
    np.testing.assert_array_equal(seam.inside(around), values)
    np.testing.assert_allclose(seam.joined(around), values, rtol=1e-6)


def test_what_was_found_twice_fades_from_one_into_the_other() -> None:
    seam = Seam(Camera("equirect", (), 512, 256))
    around = seam.around(np.zeros((1, 256), np.float32))
    around += np.linspace(0, 1, around.shape[1], dtype=np.float32)
    joined = seam.joined(around)[0]
    closed = np.append(joined, joined[0])
    # Without the fading, the step at the seam is nearly 1.
    assert np.abs(np.diff(closed)).max() < 0.1


def test_other_cameras_have_no_seam() -> None:
    seam = Seam(Camera.pinhole_from_fov(60, 64, 48))
    values = np.zeros((6, 8), np.float32)
    assert not seam.closed
    assert seam.around(values) is values
    assert seam.inside(values) is values
    assert seam.joined(values) is values


@pytest.fixture(scope="module")
def clip() -> SyntheticClip:
    return tiny_clip("sideways", 6, 256, 128, model="equirect")


@pytest.fixture(scope="module")
def depth(clip: SyntheticClip) -> list[DepthFrame]:
    return list(DenseDepth(SETTINGS).stream(ClipSource(clip.rgb), scene_of(clip, every=2)))


def test_distances_all_round(clip: SyntheticClip, depth: list[DepthFrame]) -> None:
    errors = np.stack([np.abs(f.depth / clip.depth[f.index] - 1) for f in depth])
    assert np.median(errors) < 0.03
    for part in (errors[:, :8], errors[:, -8:], errors[:, :, :8], errors[:, :, -8:]):
        assert np.median(part) < 0.05


def test_the_seam_is_a_place_like_any_other(clip: SyntheticClip, depth: list[DepthFrame]) -> None:
    """The same video from a camera that is turned half way round gives the same distances, half way round."""
    half = clip.camera.width // 2
    turned = np.diag([-1.0, 1.0, -1.0, 1.0])
    other = dataclasses.replace(
        clip,
        rgb=np.roll(clip.rgb, half, axis=2),
        depth=np.roll(clip.depth, half, axis=2),
        world_from_cam=clip.world_from_cam @ turned,
    )
    scene = scene_of(clip, every=2)
    scene = dataclasses.replace(
        scene,
        world_from_cam=other.world_from_cam,
        inverse_depth=np.roll(scene.inverse_depth, half // 8, axis=2),
        confidence=np.roll(scene.confidence, half // 8, axis=2),
    )
    again = list(DenseDepth(SETTINGS).stream(ClipSource(other.rgb), scene))
    for one, two in zip(depth, again, strict=True):
        difference = np.abs(np.roll(two.depth, half, axis=1) / one.depth - 1)
        assert np.median(difference) < 0.01
        # Sixteen columns over the seam of the one, in the middle of the other, and the other way round.
        for middle in (0, half):
            columns = np.arange(middle - 8, middle + 8) % clip.camera.width
            assert np.median(difference[:, columns]) < 0.02
        error = np.abs(one.depth / clip.depth[one.index] - 1)
        beside = np.arange(-8, 8) % clip.camera.width
        assert np.median(error[:, beside]) < 1.5 * np.median(error)
