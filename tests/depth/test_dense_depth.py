"""Dense depth with exact poses: accuracy, honest confidence, no holes, no motion, bounded memory, determinism."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import cv2
import numpy as np
import pytest
from clip_source import ClipSource, scene_of

from vipe_core.cameras import Camera, CameraModel
from vipe_core.depth.stream import DenseDepth
from vipe_core.depth.types import FILLED, MEASURED, MOVING, DepthFrame, DepthSettings, SceneMap
from vipe_core.errors import EngineError
from vipe_core.evaluation.synthetic import SyntheticClip, tiny_clip
from vipe_core.evaluation.synthetic.clip import ClipKind
from vipe_core.slam.segmentation import MOVING as SOMETHING_MOVES
from vipe_core.slam.segmentation import STATIC

SETTINGS = DepthSettings(window_frames=20)


def run(clip: SyntheticClip, scene: SceneMap) -> list[DepthFrame]:
    return list(DenseDepth(SETTINGS).stream(ClipSource(clip.rgb), scene))


def relative_error(frame: DepthFrame, clip: SyntheticClip) -> np.ndarray:
    return np.abs(frame.depth / clip.depth[frame.index] - 1)


def assert_sound(frames: list[DepthFrame], clip: SyntheticClip) -> None:
    assert [f.index for f in frames] == list(range(len(clip.rgb)))
    for f in frames:
        assert f.depth.shape == f.confidence.shape == f.rgb.shape[:2]
        assert f.depth.dtype == f.confidence.dtype == np.float32
        assert np.isfinite(f.depth).all()
        assert f.depth.min() > 0
        assert 0 <= f.confidence.min() <= f.confidence.max() <= 1
        assert np.array_equal(f.rgb, clip.rgb[f.index])


@pytest.fixture(scope="module")
def sideways() -> SyntheticClip:
    return tiny_clip("sideways", num_frames=16)


@pytest.fixture(scope="module")
def depth_of_sideways(sideways: SyntheticClip) -> list[DepthFrame]:
    return run(sideways, scene_of(sideways, noise=0.03))


def test_depth_is_accurate_and_dense(sideways: SyntheticClip, depth_of_sideways: list[DepthFrame]) -> None:
    assert_sound(depth_of_sideways, sideways)
    errors = np.stack([relative_error(f, sideways) for f in depth_of_sideways])
    assert errors.mean() < 0.04
    assert np.median(errors) < 0.01
    assert (errors < 0.25).mean() > 0.95


def test_confidence_tells_good_from_bad(sideways: SyntheticClip, depth_of_sideways: list[DepthFrame]) -> None:
    errors = np.concatenate([relative_error(f, sideways).ravel() for f in depth_of_sideways])
    sure = np.concatenate([f.confidence.ravel() for f in depth_of_sideways])
    assert (sure > 0.3).mean() > 0.5
    assert errors[sure > 0.3].mean() < 0.5 * errors[sure <= 0.3].mean()
    assert errors[sure > 0.3].mean() < 0.02


def test_depth_does_not_need_good_keyframe_maps(sideways: SyntheticClip) -> None:
    scene = scene_of(sideways, noise=0.2, confidence=0.35)
    errors = np.stack([relative_error(f, sideways) for f in run(sideways, scene)])
    assert np.median(errors) < 0.015


def test_the_fast_setting_is_nearly_as_good(sideways: SyntheticClip) -> None:
    settings = dataclasses.replace(DepthSettings.fast(), window_frames=20)
    stream = DenseDepth(settings).stream(ClipSource(sideways.rgb), scene_of(sideways, noise=0.03))
    errors = np.stack([relative_error(frame, sideways) for frame in stream])
    assert errors.mean() < 0.05
    assert np.median(errors) < 0.015


def test_forward_motion() -> None:
    clip = tiny_clip("forward", num_frames=14)
    errors = np.stack([relative_error(f, clip) for f in run(clip, scene_of(clip, noise=0.03))])
    assert np.median(errors) < 0.02
    assert errors.mean() < 0.06


@pytest.mark.parametrize("kind", ["static", "pure_rotation"])
def test_without_parallax_the_keyframes_are_carried_and_nothing_is_sure(kind: ClipKind) -> None:
    clip = tiny_clip(kind, num_frames=5)
    frames = run(clip, scene_of(clip, noise=0.03))
    assert_sound(frames, clip)
    errors = np.stack([relative_error(f, clip) for f in frames])
    assert np.median(errors) < 0.06
    assert max(f.confidence.max() for f in frames) < 0.31


def test_single_frame_without_any_map_is_a_plane(sideways: SyntheticClip) -> None:
    clip = tiny_clip("static", num_frames=1)
    cells = (1, clip.camera.height // 8, clip.camera.width // 8)
    scene = SceneMap(
        clip.camera, clip.world_from_cam, np.array([0]), np.full(cells, 0.5, np.float32), np.zeros(cells, np.float32)
    )
    frames = run(clip, scene)
    assert_sound(frames, clip)
    assert np.allclose(frames[0].depth, 2.0, rtol=1e-3)
    assert not frames[0].confidence.any()


def test_output_has_the_size_of_the_source(sideways: SyntheticClip, depth_of_sideways: list[DepthFrame]) -> None:
    large = np.stack([cv2.resize(f, (501, 377), interpolation=cv2.INTER_CUBIC) for f in sideways.rgb[:6]])
    scene = scene_of(sideways, noise=0.03)
    scene = SceneMap(
        scene.camera, scene.world_from_cam[:6], scene.keyframes[:2], scene.inverse_depth[:2], scene.confidence[:2]
    )
    frames = list(DenseDepth(SETTINGS).stream(ClipSource(large), scene))
    assert frames[3].depth.shape == (377, 501)
    truth = cv2.resize(sideways.depth[3], (501, 377), interpolation=cv2.INTER_NEAREST)
    assert np.median(np.abs(frames[3].depth / truth - 1)) < 0.02


@pytest.mark.parametrize("model", ["mei", "equirect"])
def test_other_cameras_give_ray_distance(model: CameraModel) -> None:
    size = (256, 192) if model == "mei" else (320, 160)
    clip = tiny_clip("sideways", 12, *size, model=model)
    errors = np.stack([relative_error(f, clip) for f in run(clip, scene_of(clip, noise=0.03))])
    assert np.median(errors) < 0.03


def test_closing_early_closes_the_decoders(sideways: SyntheticClip) -> None:
    source = ClipSource(sideways.rgb)
    stream = DenseDepth(SETTINGS).stream(source, scene_of(sideways, noise=0.03))
    assert next(stream).index == 0
    assert source.open == 2
    stream.close()
    assert source.open == 0


def test_the_decoder_ahead_stays_within_the_window(sideways: SyntheticClip) -> None:
    settings = DepthSettings(window_frames=3, check_frames=(2,))
    source = ClipSource(sideways.rgb)
    for frame in DenseDepth(settings).stream(source, scene_of(sideways, noise=0.03)):
        assert source.decoded <= frame.index + 3 + 2 + 1


def test_a_video_that_ends_early_is_an_engine_error(sideways: SyntheticClip) -> None:
    with pytest.raises(EngineError, match="9 frames"):
        list(DenseDepth(SETTINGS).stream(ClipSource(sideways.rgb[:9]), scene_of(sideways, noise=0.03)))


def test_maps_must_fit_the_camera() -> None:
    camera = Camera.pinhole_from_fov(60, 64, 48)
    poses, keyframes = np.eye(4)[None], np.array([0])
    maps: Callable[[int], np.ndarray] = lambda w: np.ones((1, 6, w), np.float32)  # noqa: E731
    SceneMap(camera, poses, keyframes, maps(8), maps(8))
    with pytest.raises(ValueError, match="keyframe maps"):
        SceneMap(camera, poses, keyframes, maps(9), maps(8))


@pytest.mark.parametrize("threads", [1, 2])
def test_same_input_same_bytes_whatever_the_threads(
    sideways: SyntheticClip, depth_of_sideways: list[DepthFrame], threads: int
) -> None:
    before_threads = cv2.getNumThreads()
    cv2.setNumThreads(threads)
    try:
        again = DenseDepth(SETTINGS).stream(ClipSource(sideways.rgb), scene_of(sideways, noise=0.03))
        for frame, before in zip(again, depth_of_sideways[:3], strict=False):
            assert frame.depth.tobytes() == before.depth.tobytes()
            assert frame.confidence.tobytes() == before.confidence.tobytes()
        again.close()
    finally:
        cv2.setNumThreads(before_threads)


def test_every_pixel_says_where_its_depth_comes_from(
    sideways: SyntheticClip, depth_of_sideways: list[DepthFrame]
) -> None:
    for frame in depth_of_sideways:
        assert frame.kind.dtype == np.uint8
        assert (frame.kind == MEASURED).mean() > 0.5
        assert frame.confidence[frame.kind == MEASURED].mean() > 2 * frame.confidence[frame.kind == FILLED].mean()
        assert not frame.moving.any()


def test_what_moves_is_marked_and_a_mask_over_what_is_static_is_not(sideways: SyntheticClip) -> None:
    labels = np.full((len(sideways.rgb), 30 * 40), STATIC, np.int8)
    labels.reshape(-1, 30, 40)[:, 10:18, 12:22] = SOMETHING_MOVES
    scene = dataclasses.replace(scene_of(sideways, noise=0.03), labels=labels)
    changing = sideways.rgb.copy()
    noise = np.random.default_rng(0).integers(0, 255, (len(changing), 16, 20, 3), np.uint8)
    for picture, blocks in zip(changing, noise, strict=True):
        picture[80:144, 96:176] = cv2.resize(blocks, (80, 64), interpolation=cv2.INTER_CUBIC)
    frame = next(DenseDepth(SETTINGS).stream(ClipSource(changing), scene))
    assert np.array_equal(frame.kind == MOVING, frame.moving)
    assert frame.moving[88:136, 104:168].mean() > 0.5
    assert not frame.moving[:60].any()
    frame = next(DenseDepth(SETTINGS).stream(ClipSource(sideways.rgb), scene))
    assert frame.moving.mean() < 0.01
