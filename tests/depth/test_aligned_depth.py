"""Video depth aligned to the map: accuracy in spite of stated distortions, sparse maps, cuts, both kinds of depth."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from clip_source import ClipSource, scene_of

from vipe_core.annotation import FILLED, MEASURED, SKY, UNOBSERVED, DepthKind
from vipe_core.cameras import Camera, CameraModel
from vipe_core.cameras.along import inverse_along
from vipe_core.depth.aligned import AlignedDepth
from vipe_core.depth.alignment import AlignmentSettings
from vipe_core.depth.projection import MapProjector
from vipe_core.depth.types import DepthFrame, SceneMap
from vipe_core.depth.windows import stitched
from vipe_core.errors import ConfigError, EngineError
from vipe_core.evaluation.synthetic import SyntheticClip, tiny_clip
from vipe_core.evaluation.synthetic.depth_models import (
    DistortedVideoDepth,
    Distortion,
    NearestCompletion,
    NoisyMetricDepth,
)
from vipe_core.priors.protocols import DepthFamily
from vipe_core.slam.segmentation import MOVING as MOVING_CELL
from vipe_core.slam.segmentation import STATIC as STATIC_CELL

SIZE = (160, 120)
EXACT = Distortion(0, 0, 0, 0, 0, 0)


def video_of(clip: SyntheticClip, distortion: Distortion, **changes: int) -> DistortedVideoDepth:
    windows = {"window_frames": 10, "overlap_frames": 3, **changes}
    return DistortedVideoDepth(ClipSource(clip.rgb), clip.depth, clip.depth_kind, SIZE, distortion, **windows)


def run(
    clip: SyntheticClip, scene: SceneMap, family: DepthFamily, *, metres: bool = True, masked: np.ndarray | None = None
) -> list[DepthFrame]:
    return list(AlignedDepth(family, metres=metres).stream(ClipSource(clip.rgb, masked), scene))


def errors(frames: list[DepthFrame], clip: SyntheticClip) -> np.ndarray:
    return np.stack([np.abs(frame.depth / clip.depth[frame.index] - 1) for frame in frames])


def levels(frames: list[DepthFrame], clip: SyntheticClip) -> np.ndarray:
    """Median logarithm of each frame's depth over the truth."""
    return np.array([np.median(np.log(frame.depth / clip.depth[frame.index])) for frame in frames])


@pytest.fixture(scope="module")
def clip() -> SyntheticClip:
    return tiny_clip("sideways", 26, 192, 144, noise=1.0)


@pytest.fixture(scope="module")
def scene(clip: SyntheticClip) -> SceneMap:
    return scene_of(clip)


def test_exact_video_depth_in_other_units_comes_out_exact(clip: SyntheticClip, scene: SceneMap) -> None:
    frames = run(clip, scene, DepthFamily(video=video_of(clip, replace(EXACT, window_scale=1.0, window_shift=0.5))))
    assert [frame.index for frame in frames] == list(range(26))
    found = errors(frames, clip)
    assert np.median(found) < 0.01
    assert found.mean() < 0.02
    for frame in frames:
        assert frame.depth.shape == frame.confidence.shape == frame.kind.shape == (144, 192)
        assert frame.depth.dtype == frame.confidence.dtype == np.float32
        assert np.isfinite(frame.depth).all()
        assert frame.depth.min() > 0
        assert 0 <= frame.confidence.min() <= frame.confidence.max() <= 1
        assert set(np.unique(frame.kind)) <= {MEASURED, FILLED}


def test_stated_distortions_are_undone(clip: SyntheticClip, scene: SceneMap) -> None:
    distortion = Distortion(drift=0.02)
    frames = run(clip, scene, DepthFamily(video=video_of(clip, distortion)))
    # What is left is what an affine map cannot undo: 3 % that pixels share, 2 % of each, 2 % outliers.
    assert np.median(errors(frames, clip)) < 0.035
    assert errors(frames, clip).mean() < 0.06
    level = levels(frames, clip)
    assert np.abs(level).max() < 0.02
    assert np.abs(np.diff(level)).max() < 0.01


def test_confidence_tells_the_wrong_part(clip: SyntheticClip, scene: SceneMap) -> None:
    frames = run(clip, scene, DepthFamily(video=video_of(clip, replace(EXACT, wrong=0.3, noise=0.02))))
    wrong, right = slice(0, 40), slice(70, 192)
    found = errors(frames, clip)
    assert np.median(found[:, :, right]) < 0.02
    assert np.median(found[:, :, wrong]) > 0.2
    sure = np.stack([frame.confidence for frame in frames])
    assert np.median(sure[:, :, right]) > 3 * np.median(sure[:, :, wrong])


def test_what_the_model_leaves_open_is_marked(clip: SyntheticClip, scene: SceneMap) -> None:
    frames = run(clip, scene, DepthFamily(video=video_of(clip, replace(EXACT, holes=0.25))))
    for frame in frames:
        assert (frame.kind[:30] == UNOBSERVED).all()
        assert not frame.confidence[:30].any()
        assert np.isfinite(frame.depth).all()
    assert np.median(errors(frames, clip)[:, 45:]) < 0.01


def test_the_sky_is_at_the_far_end(clip: SyntheticClip, scene: SceneMap) -> None:
    depth = clip.depth.copy()
    depth[:, :30] = 0
    video = DistortedVideoDepth(ClipSource(clip.rgb), depth, "z", SIZE, replace(EXACT, window_scale=0.5))
    sure = scene.confidence.copy()
    sure[:, :5] = 0
    frames = run(clip, replace(scene, confidence=sure), DepthFamily(video=video))
    sky = np.stack([frame.depth[:25] for frame in frames])
    assert np.median(sky) > 3 * clip.depth.max()
    assert np.median(errors(frames, clip)[:, 40:]) < 0.015
    far = np.stack([frame.kind[:25] == SKY for frame in frames])
    assert not np.stack([frame.confidence[:25] for frame in frames])[far].any()


@pytest.mark.parametrize(("model", "kind"), [("mei", "z"), ("mei", "ray"), ("equirect", "ray")])
def test_every_camera_and_kind_of_depth(model: CameraModel, kind: DepthKind) -> None:
    size = (192, 144) if model == "mei" else (256, 128)
    clip = tiny_clip("sideways", 10, *size, model=model, noise=1.0)
    along = inverse_along(clip.camera, kind)
    depth = np.where(along > 0, clip.depth / np.where(along > 0, along, 1), 0)
    video = DistortedVideoDepth(
        ClipSource(clip.rgb),
        depth,
        kind,
        size,
        Distortion(),
        window_frames=6,
        overlap_frames=2,
    )
    frames = run(clip, scene_of(clip), DepthFamily(video=video))
    assert np.median(errors(frames, clip)) < 0.04
    assert np.abs(levels(frames, clip)).max() < 0.02


def test_a_cut_starts_anew(clip: SyntheticClip, scene: SceneMap) -> None:
    """The second shot's map has other units: nothing of the first must reach it."""
    other = scene.inverse_depth.copy()
    other[scene.keyframes >= 12] *= 3
    poses = scene.world_from_cam.copy()
    poses[12:, :3, 3] = poses[12, :3, 3] + (poses[12:, :3, 3] - poses[12, :3, 3]) / 3
    cut = replace(scene, inverse_depth=other, world_from_cam=poses, cuts=(12,))
    frames = run(clip, cut, DepthFamily(video=video_of(clip, Distortion(drift=0.0))))
    level = levels(frames, clip)
    assert np.abs(level[:12]).max() < 0.02
    assert np.abs(level[12:] + np.log(3)).max() < 0.02


def test_a_sparse_map_is_completed_and_regimes_do_not_jump(clip: SyntheticClip, scene: SceneMap) -> None:
    """Coverage falls to nothing in the middle of the clip and comes back; metric depth with a bias of 5 % stands in."""
    labels = np.full((26, scene.inverse_depth[0].size), STATIC_CELL, np.int8)
    cells = labels.reshape(26, 18, 24)
    for i in range(26):
        covered = 24 if i < 6 or i >= 22 else max(0, abs(i - 14) - 4) * 6
        cells[i, :, covered:] = MOVING_CELL
    hidden = replace(scene, labels=labels)
    metric = NoisyMetricDepth(ClipSource(clip.rgb), clip.depth, "z", SIZE, sigma=0.02, wrong=0.0, bias=1.05)
    video = video_of(clip, replace(EXACT, window_scale=0.5, window_shift=0.3, drift=0.005, noise=0.02))
    for family in (
        DepthFamily(video=video),
        DepthFamily(video=video, completion=NearestCompletion()),
        DepthFamily(video=video, completion=NearestCompletion(), metric=metric),
    ):
        level = levels(run(clip, hidden, family), clip)
        assert np.abs(level).max() < 0.06
        assert np.abs(np.diff(level)).max() < 0.02


def test_without_any_map_metric_depth_gives_the_scale(clip: SyntheticClip, scene: SceneMap) -> None:
    blind = replace(scene, confidence=np.zeros_like(scene.confidence))
    metric = NoisyMetricDepth(ClipSource(clip.rgb), clip.depth, "z", SIZE, sigma=0.05, wrong=0.0)
    video = video_of(clip, Distortion(drift=0.005))
    frames = run(clip, blind, DepthFamily(video=video, metric=metric))
    assert np.abs(levels(frames, clip)).max() < 0.08
    assert np.abs(np.diff(levels(frames, clip))).max() < 0.03
    # Where the scene is not in metres it says nothing: a guess of the right size, and no confidence.
    frames = run(clip, blind, DepthFamily(video=video, metric=metric), metres=False)
    assert np.ptp(levels(frames, clip)) < 1.0
    assert not any(frame.confidence.any() for frame in frames)


def test_what_moves_is_not_fitted_but_has_depth(clip: SyntheticClip, scene: SceneMap) -> None:
    """Half of the map is far off where something is masked; the mask says so."""
    wrong = scene.inverse_depth.copy()
    wrong[:, :, :14] *= 0.3
    masked = np.zeros((26, 144, 192), np.bool_)
    # The keyframes' maps are seen shifted by a few cells in the frames around them.
    masked[:, :, :150] = True
    frames = run(clip, replace(scene, inverse_depth=wrong), DepthFamily(video=video_of(clip, EXACT)), masked=masked)
    assert np.median(errors(frames, clip)) < 0.02
    assert all(frame.moving[:, :150].all() for frame in frames)


def test_windows_become_one_scale_and_shift(clip: SyntheticClip) -> None:
    video = video_of(clip, Distortion(drift=0.0, smooth=0.01, noise=0.01, outliers=0.05))
    with_windows = {frame.index: found for frame, found in stitched(video, ClipSource(clip.rgb).frames(SIZE))}
    assert list(with_windows) == list(range(26))
    pairs = []
    for index, found in with_windows.items():
        true = 1 / cv2.resize(clip.depth[index], SIZE, interpolation=cv2.INTER_NEAREST)
        pairs.append(np.polyfit(true.ravel(), found.ravel(), 1))
    alpha, beta = np.array(pairs).T
    assert np.ptp(np.log(alpha)) < 0.06
    assert np.ptp(beta) < 0.06 * alpha.mean()


class Broken:
    depth_kind = "z"
    window_frames = 4
    overlap_frames = 2

    def input_size(self, width: int, height: int) -> tuple[int, int]:
        return SIZE

    def predict(self, frames: list[np.ndarray]) -> np.ndarray:
        return np.ones((len(frames), 3, 3), np.float32)


def test_a_model_that_breaks_its_protocol_is_an_engine_error(clip: SyntheticClip, scene: SceneMap) -> None:
    with pytest.raises(EngineError, match=r"\(4, 120, 160\)"):
        run(clip, scene, DepthFamily(video=Broken()))
    with pytest.raises(EngineError, match="overlap by 9"):
        run(clip, scene, DepthFamily(video=video_of(clip, EXACT, window_frames=9, overlap_frames=9)))
    with pytest.raises(ConfigError, match="video depth"):
        AlignedDepth(DepthFamily())


def test_memory_and_decoders_are_bounded(clip: SyntheticClip, scene: SceneMap) -> None:
    source = ClipSource(clip.rgb)
    stage = AlignedDepth(DepthFamily(video=video_of(clip, EXACT)), AlignmentSettings(lag_frames=2))
    stream = stage.stream(source, scene)
    for frame in stream:
        # A window, and what the smoothing waits for.
        assert source.decoded <= frame.index + 10 + 10 + 2
        if frame.index == 20:
            break
    assert source.open == 2
    stream.close()
    assert source.open == 0


def test_a_video_that_ends_early_is_an_engine_error(clip: SyntheticClip, scene: SceneMap) -> None:
    with pytest.raises(EngineError, match="9 frames"):
        list(AlignedDepth(DepthFamily(video=video_of(clip, EXACT))).stream(ClipSource(clip.rgb[:9]), scene))


def test_same_input_same_bytes(clip: SyntheticClip, scene: SceneMap) -> None:
    family = DepthFamily(video=video_of(clip, Distortion()), completion=NearestCompletion())
    first, again = run(clip, scene, family), run(clip, scene, family)
    for one, other in zip(first, again, strict=True):
        assert one.depth.tobytes() == other.depth.tobytes()
        assert one.confidence.tobytes() == other.confidence.tobytes()


def test_nearer_things_hide_what_is_behind_them() -> None:
    """A near square in front of a far wall, seen from the side: no sample of the wall shines through it."""
    camera = Camera.pinhole_from_fov(60, 192, 144)
    inverse = np.full((3, 18, 24), 0.1, np.float32)
    inverse[:, 6:12, 8:14] = 0.5
    poses = np.repeat(np.eye(4)[None], 4, axis=0)
    poses[3, 0, 3] = 0.4
    scene = SceneMap(camera, poses, np.array([0, 1, 2]), inverse, np.full(inverse.shape, 0.9, np.float32))
    seen = MapProjector(scene).of(3)
    # The square moves by focal * 0.4 * 0.5 pixels, the wall by a fifth of it.
    shift_px = camera.focal_px * 0.4 * 0.5
    inside = (seen.px[:, 0] > 72 - shift_px) & (seen.px[:, 0] < 104 - shift_px)
    inside &= (seen.px[:, 1] > 56) & (seen.px[:, 1] < 88)
    assert inside.sum() >= 12
    assert np.allclose(seen.inverse_depth[inside], 0.5)
