"""The scale of a map: normalised, or metres from a path, a height, a pixel, a baseline or metric depth."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from clip_source import scene_of
from hypothesis import given
from hypothesis import strategies as st

from vipe_core.annotation import DepthKind
from vipe_core.cameras import Camera, CameraModel
from vipe_core.cameras.along import inverse_along
from vipe_core.depth.ground import scale_from_height
from vipe_core.depth.known import KnownLength
from vipe_core.depth.projection import MapProjector
from vipe_core.depth.scale import (
    FrameRatio,
    normalised,
    ratio_to_prior,
    rescaled,
    scale_from_path,
    scale_from_pixel,
    scale_from_ratios,
)
from vipe_core.depth.types import SceneMap
from vipe_core.errors import ConfigError, ScaleUnobservable
from vipe_core.evaluation.synthetic import SyntheticClip, tiny_clip
from vipe_core.geometry.arrays import inverse
from vipe_core.priors.protocols import MetricEstimate
from vipe_core.statistics import consensus, weighted_median


@pytest.fixture(scope="module")
def sideways() -> SyntheticClip:
    return tiny_clip("sideways", num_frames=18)


@pytest.fixture(scope="module")
def scene(sideways: SyntheticClip) -> SceneMap:
    """One unit is 2.5 metres."""
    return scene_of(sideways, every=3, noise=0.01, unit_m=2.5)


@given(st.lists(st.floats(-5, 5), min_size=1, max_size=9), st.data())
def test_weighted_median_has_half_of_the_weight_on_either_side(values: list[float], data: st.DataObject) -> None:
    weights = data.draw(st.lists(st.floats(0.1, 3), min_size=len(values), max_size=len(values)))
    array, weight = np.array(values), np.array(weights)
    found = weighted_median(array, weight)
    assert weight[array < found - 1e-9].sum() <= 0.5 * weight.sum() + 1e-6
    assert weight[array > found + 1e-9].sum() <= 0.5 * weight.sum() + 1e-6


def test_consensus_rejects_what_is_far_away() -> None:
    values = np.concatenate([np.random.default_rng(0).normal(1.0, 0.1, 90), np.full(10, 9.0)])
    value, error, support = consensus(values, np.ones(100), 0.01)
    assert value == pytest.approx(1.0, abs=0.04)
    assert 0.005 < error < 0.03
    assert 85 <= support <= 90


@pytest.mark.parametrize(
    ("text", "kind", "metres", "place"),
    [
        ("path=12.3", "path", 12.3, None),
        (" height=1.6 ", "height", 1.6, None),
        ("depth=2.4@320.5,17,8", "depth", 2.4, (320.5, 17.0, 8)),
        ("path=.5", "path", 0.5, None),
        ("path=1e3", "path", 1000.0, None),
    ],
)
def test_known_lengths_are_read(text: str, kind: str, metres: float, place: tuple[float, float, int] | None) -> None:
    known = KnownLength.parse(text)
    assert (known.kind, known.metres, known.place) == (kind, metres, place)
    assert KnownLength.parse(str(known)) == known


@pytest.mark.parametrize(
    "text",
    ["", "path", "path=0", "path=-2", "path=1e999", "height=1@2,3,4", "depth=2", "depth=2@1,2", "width=3", "path=x"],
)
def test_what_is_no_known_length_is_refused_with_the_forms(text: str) -> None:
    with pytest.raises(ConfigError, match=r"metres|METRES"):
        KnownLength.parse(text)


def test_normalised_means_median_one_over_the_confident_cells(scene: SceneMap) -> None:
    # What is not confident must not count.
    odd = scene.inverse_depth.copy()
    odd[scene.confidence == 0] = 1000
    found = normalised(replace(scene, inverse_depth=odd))
    assert np.median(found.inverse_depth[scene.confidence > 0.3]) == pytest.approx(1.0, abs=1e-5)
    # Poses and depth have changed together: frames see the same.
    before, after = MapProjector(scene).of(4), MapProjector(found).of(4)
    common, first, second = np.intersect1d(before.cell, after.cell, return_indices=True)
    assert len(common) > 0.99 * len(before.cell)
    unit = scene.inverse_depth[0, 5, 5] / found.inverse_depth[0, 5, 5]
    ratio = before.inverse_depth[first] / after.inverse_depth[second] / unit
    assert np.quantile(np.abs(ratio - 1), 0.9) < 0.03
    assert np.allclose(found.world_from_cam[0], scene.world_from_cam[0])


def test_every_shot_has_a_scale_of_its_own(scene: SceneMap) -> None:
    cut = replace(scene, cuts=(9,))
    found = rescaled(cut, [2.0, 5.0])
    local = inverse(cut.world_from_cam[9][None])[0] @ cut.world_from_cam[15]
    turned = inverse(found.world_from_cam[9][None])[0] @ found.world_from_cam[15]
    assert np.allclose(turned[:3, 3], 5 * local[:3, 3])
    assert np.allclose(turned[:3, :3], local[:3, :3])
    step = inverse(cut.world_from_cam[8][None])[0] @ cut.world_from_cam[9]
    taken = inverse(found.world_from_cam[8][None])[0] @ found.world_from_cam[9]
    assert np.allclose(taken[:3, 3], 2 * step[:3, 3])
    later = cut.keyframes >= 9
    assert np.allclose(found.inverse_depth[later] * 5, cut.inverse_depth[later], rtol=1e-5)
    assert np.allclose(found.inverse_depth[~later] * 2, cut.inverse_depth[~later], rtol=1e-5)
    for shot in (slice(0, 3), slice(3, 6)):
        chosen = normalised(cut).inverse_depth[shot][cut.confidence[shot] > 0.3]
        assert np.median(chosen) == pytest.approx(1.0, abs=1e-5)


def test_a_known_path(scene: SceneMap, sideways: SyntheticClip) -> None:
    centres = sideways.world_from_cam[:, :3, 3]
    path_m = float(np.linalg.norm(np.diff(centres, axis=0), axis=1).sum())
    found = scale_from_path(scene, path_m)
    assert found.metres_per_unit == pytest.approx(2.5, rel=1e-6)
    low, high = found.interval
    assert low < 2.5 < high


def test_a_camera_at_rest_has_no_path(scene: SceneMap) -> None:
    still = replace(scene, world_from_cam=np.repeat(scene.world_from_cam[:1], 18, axis=0))
    with pytest.raises(ScaleUnobservable, match="does not move"):
        scale_from_path(still, 3.0)
    with pytest.raises(ScaleUnobservable, match="cuts"):
        scale_from_path(replace(scene, cuts=(9,)), 3.0)


def test_a_known_height(sideways: SyntheticClip) -> None:
    clip = tiny_clip("forward", num_frames=18)
    scene = scene_of(clip, every=3, noise=0.01, unit_m=0.4)
    height_m = float(np.median(clip.world_from_cam[:, 2, 3]))
    found = scale_from_height(scene, (0, 18), height_m)
    assert found.metres_per_unit == pytest.approx(0.4, rel=0.05)
    assert abs(math.log(found.metres_per_unit / 0.4)) < 3 * found.sigma_ratio


def test_without_ground_there_is_no_height(scene: SceneMap) -> None:
    # A wall in front of the camera, parallel to the picture.
    flat = replace(scene, inverse_depth=np.full_like(scene.inverse_depth, 0.5))
    with pytest.raises(ScaleUnobservable, match="ground"):
        scale_from_height(flat, (0, 18), 1.5)


def test_a_known_pixel(scene: SceneMap, sideways: SyntheticClip) -> None:
    frame, x, y = 7, 200, 150
    ray = sideways.camera.unproject(np.array([x - 0.5, y - 0.5]))
    distance_m = float(sideways.depth[frame, y, x] * np.linalg.norm(ray))
    # The video is twice the size of the working images.
    found = scale_from_pixel(scene, (2 * x, 2 * y), frame, distance_m, (640, 480))
    assert found.metres_per_unit == pytest.approx(2.5, rel=0.03)


@pytest.mark.parametrize(
    ("pixel", "frame", "words"), [((10, 10), 99, "no frame 99"), ((700, 10), 3, "not in the picture")]
)
def test_a_pixel_that_is_not_there(scene: SceneMap, pixel: tuple[float, float], frame: int, words: str) -> None:
    with pytest.raises(ScaleUnobservable, match=words):
        scale_from_pixel(scene, pixel, frame, 2.0, (640, 480))


def test_a_pixel_that_nothing_measured(scene: SceneMap) -> None:
    blind = replace(scene, confidence=np.zeros_like(scene.confidence))
    with pytest.raises(ScaleUnobservable, match="nothing was measured"):
        scale_from_pixel(blind, (100, 100), 3, 2.0, (640, 480))


def test_many_noisy_frames_and_some_wrong_ones_give_the_scale_within_its_interval() -> None:
    rng = np.random.default_rng(5)
    inside = 0
    for _ in range(40):
        logs = math.log(3.0) + 0.2 * rng.standard_normal(30)
        logs[rng.permutation(30)[:3]] += math.log(4)
        found = scale_from_ratios([FrameRatio(float(x), 0.1, 1.0) for x in logs])
        assert found is not None
        assert found.metres_per_unit == pytest.approx(3.0, rel=0.2)
        inside += found.interval[0] < 3.0 < found.interval[1]
    assert inside >= 34, "a 95 % interval"
    assert scale_from_ratios([]) is None


@pytest.mark.parametrize("model", ["pinhole", "mei"])
@pytest.mark.parametrize("kind", ["z", "ray"])
def test_metric_depth_of_either_kind_gives_the_scale(model: CameraModel, kind: DepthKind) -> None:
    clip = tiny_clip("sideways", 6, 256, 192, model=model)
    scene = scene_of(clip, every=2, noise=0.01, unit_m=4.0)
    along = inverse_along(clip.camera, kind)
    depth_m = np.where(along > 0, clip.depth[2] / np.where(along > 0, along, 1), 0).astype(np.float32)
    prior = MetricEstimate(depth_m, np.ones_like(depth_m))
    found = ratio_to_prior(scene, 1, scene.confidence[1] > 0.3, prior, kind)
    assert found is not None
    assert math.exp(found.log_ratio) == pytest.approx(4.0, rel=0.01)
    assert found.sigma < 0.05
    nothing = MetricEstimate(np.zeros_like(depth_m), np.ones_like(depth_m))
    assert ratio_to_prior(scene, 1, scene.confidence[1] > 0.3, nothing, kind) is None


def test_z_is_shorter_than_the_ray_off_the_axis() -> None:
    pinhole = Camera.pinhole_from_fov(90, 64, 48)
    assert (inverse_along(pinhole, "z") == 1).all()
    ray = inverse_along(pinhole, "ray")
    assert ray.max() == pytest.approx(1.0, abs=1e-3)
    assert ray[0, 0] < 0.72
    panorama = Camera("equirect", (), 64, 32)
    behind = inverse_along(panorama, "z")[:, 0]
    assert not behind.any()
