"""The scale of an annotation, and its depth where the preset has a video depth model."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from vipe_core.annotation import Annotation
from vipe_core.errors import ConfigError, ScaleUnobservable
from vipe_core.evaluation.synthetic.clip import SyntheticClip, tiny_clip
from vipe_core.evaluation.synthetic.depth_models import (
    DistortedVideoDepth,
    Distortion,
    NearestCompletion,
    NoisyMetricDepth,
)
from vipe_core.geometry import umeyama
from vipe_core.pipeline.annotator import Annotator
from vipe_core.pipeline.presets import resolve
from vipe_core.pipeline.providers import open_depth, register_depth
from vipe_core.priors.protocols import DepthFamily
from vipe_core.video import open_source


@pytest.fixture(scope="module")
def clip() -> SyntheticClip:
    return tiny_clip("orbit", 12, 192, 144, noise=1.0)


@pytest.fixture(scope="module")
def folder(clip: SyntheticClip, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scale") / "orbit"
    path.mkdir()
    for index, frame in enumerate(clip.rgb):
        assert cv2.imwrite(str(path / f"{index:04d}.png"), cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
    return path


@pytest.fixture(scope="module")
def relative(folder: Path) -> Annotation:
    return Annotator().annotate(folder)


def metres_per_unit(annotation: Annotation, clip: SyntheticClip) -> float:
    return umeyama(annotation.world_from_cam[:, :3, 3], clip.world_from_cam[:, :3, 3]).scale


def depth_ratio(annotation: Annotation, clip: SyntheticClip) -> float:
    """Median of the first frame's depth over the true one."""
    frame = next(iter(annotation.dense()))
    sure = frame.confidence > 0.3
    return float(np.median(frame.depth[sure] / clip.depth[0][sure]))


def test_without_anything_known_the_scale_is_relative(relative: Annotation) -> None:
    assert relative.scale == "relative"
    assert relative.provenance.scale_source == "normalised"
    assert math.isnan(relative.quality.scale_sigma_ratio)
    assert relative.quality.summary()["scale_sigma_ratio"] is None
    # The median inverse depth of the map is 1, so what is seen is about one unit away.
    frame = next(iter(relative.dense()))
    assert np.median(1 / frame.depth[frame.confidence > 0.3]) == pytest.approx(1.0, rel=0.25)


def test_a_known_path_makes_poses_and_depth_metric(folder: Path, clip: SyntheticClip, relative: Annotation) -> None:
    path_m = float(np.linalg.norm(np.diff(clip.world_from_cam[:, :3, 3], axis=0), axis=1).sum())
    annotation = Annotator().annotate(folder, scale_from=f"path={path_m}")
    assert annotation.scale == "metric"
    assert annotation.trajectory_length == pytest.approx(path_m, rel=1e-6)
    assert annotation.provenance.scale_source.startswith("path=")
    assert 0 < annotation.quality.scale_sigma_ratio < 0.2
    assert np.allclose(annotation.world_from_cam[:, :3, :3], relative.world_from_cam[:, :3, :3])
    # Poses and depth went together.
    unit = path_m / relative.trajectory_length
    assert metres_per_unit(annotation, clip) * unit == pytest.approx(metres_per_unit(relative, clip))
    assert depth_ratio(annotation, clip) == pytest.approx(unit * depth_ratio(relative, clip), rel=0.01)


def test_what_cannot_be_found_is_said(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(ScaleUnobservable, match="orbit: scale from depth=2@5,5,99: there is no frame 99") as caught:
        Annotator().annotate(folder, scale_from="depth=2@5,5,99")
    assert caught.value.code == "scale_unobservable"
    with pytest.raises(ConfigError, match="'tall'"):
        Annotator().annotate(tmp_path / "not even looked for", scale_from="tall")


def test_metric_depth_makes_the_scale_metric(folder: Path, clip: SyntheticClip) -> None:
    metric = NoisyMetricDepth(open_source(folder), clip.depth, "z", (96, 72), sigma=0.05, wrong=0.2, seed=2)
    register_depth("test.metric", lambda device: DepthFamily(metric=metric))
    stages: list[str] = []
    annotator = Annotator(replace(resolve("classical"), depth="test.metric"))
    annotation = annotator.annotate(folder, progress=lambda p: stages.append(p.stage))
    assert annotation.scale == "metric"
    assert annotation.provenance.scale_source == "metric_depth"
    assert annotation.provenance.providers["dense_depth"] == "test.metric"
    assert depth_ratio(annotation, clip) == pytest.approx(1.0, abs=0.06)
    assert 0 < annotation.quality.scale_sigma_ratio < 0.1
    assert "scale" in stages
    # What the user knows comes first.
    known = annotator.annotate(folder, scale_from="path=7")
    assert known.trajectory_length == pytest.approx(7)


def test_video_depth_is_aligned_where_the_preset_has_it(
    folder: Path, clip: SyntheticClip, relative: Annotation
) -> None:
    video = DistortedVideoDepth(
        open_source(folder), clip.depth, "z", (96, 72), Distortion(), window_frames=8, overlap_frames=3
    )
    register_depth("test.video", lambda device: DepthFamily(video=video, completion=NearestCompletion()))
    annotation = Annotator(replace(resolve("classical"), depth="test.video")).annotate(folder)
    assert annotation.world_from_cam.tobytes() == relative.world_from_cam.tobytes()
    frames = list(annotation.dense())
    assert [frame.index for frame in frames] == list(range(12))
    scale = depth_ratio(relative, clip)
    level = [np.median(np.log(frame.depth / clip.depth[frame.index])) - math.log(scale) for frame in frames]
    # The scale of the poses, without a jump: a small picture leaves the map a few per cent.
    assert np.abs(level).max() < 0.08
    assert np.abs(np.diff(level)).max() < 0.02
    # It is the geometry of the map, as stereo sees it too.
    stereo = next(iter(relative.dense()))
    sure = stereo.confidence > 0.3
    assert np.median(np.abs(frames[0].depth / stereo.depth - 1)[sure]) < 0.05
    assert np.median(frames[0].confidence) > 0.3
    assert annotation.timings_s["depth"] > 0


def test_depth_providers_have_names() -> None:
    with pytest.raises(ConfigError, match=r"classical\.plane_sweep"):
        Annotator(replace(resolve("classical"), depth="nothing"))
    with pytest.raises(ConfigError, match="already"):
        register_depth("classical.plane_sweep", lambda device: DepthFamily())
    assert open_depth("classical.plane_sweep", "none", Annotator().device) == DepthFamily()
