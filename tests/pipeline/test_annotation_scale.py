"""The scale of an annotation: relative and normalised, from a known length, or from metric depth."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from vipe_core.annotation import Annotation, DepthKind
from vipe_core.cameras import Camera
from vipe_core.errors import ConfigError, ScaleUnobservable
from vipe_core.evaluation.synthetic.clip import SyntheticClip, tiny_clip
from vipe_core.geometry import umeyama
from vipe_core.pipeline.annotator import Annotator
from vipe_core.pipeline.presets import resolve
from vipe_core.pipeline.providers import open_depth, register_depth
from vipe_core.priors.protocols import DepthFamily, MetricEstimate


@pytest.fixture(scope="module")
def clip() -> SyntheticClip:
    return tiny_clip("orbit", 20, 192, 144, noise=1.0)


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


class NoisyMetric:
    """Exact metric depth times an error per picture, some of them far off."""

    depth_kind: DepthKind = "z"
    shared_sigma_ratio = 0.0

    def __init__(self, clip: SyntheticClip) -> None:
        self._clip = clip
        self._rng = np.random.default_rng(1)
        self._calls = 0

    def input_size(self, width: int, height: int) -> tuple[int, int]:
        return width // 2, height // 2

    def estimate(self, rgb: NDArray[np.uint8], camera: Camera) -> MetricEstimate:
        small = [cv2.resize(f, (camera.width, camera.height), interpolation=cv2.INTER_AREA) for f in self._clip.rgb]
        assert rgb.shape[:2] == (camera.height, camera.width)
        index = int(np.argmin([np.abs(f.astype(float) - rgb).mean() for f in small]))
        depth = cv2.resize(self._clip.depth[index], (camera.width, camera.height), interpolation=cv2.INTER_NEAREST)
        self._calls += 1
        wrong = 3.0 if self._calls % 5 == 2 else math.exp(0.05 * self._rng.standard_normal())
        return MetricEstimate((wrong * depth).astype(np.float32), np.ones_like(depth))


def test_metric_depth_makes_the_scale_metric(folder: Path, clip: SyntheticClip) -> None:
    register_depth("test.metric", lambda device: DepthFamily(metric=NoisyMetric(clip)))
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


def test_depth_providers_have_names() -> None:
    with pytest.raises(ConfigError, match=r"classical\.plane_sweep"):
        Annotator(replace(resolve("classical"), depth="nothing"))
    with pytest.raises(ConfigError, match="already"):
        register_depth("classical.plane_sweep", lambda device: DepthFamily())
    assert open_depth("classical.plane_sweep", Annotator().device) == DepthFamily()
