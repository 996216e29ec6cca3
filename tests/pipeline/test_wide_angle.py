"""A bent lens from the video to depth: found when it is looked for, and what a pinhole makes of the same video."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import cv2
import numpy as np
import pytest

from vipe_core.annotation import Annotation
from vipe_core.evaluation.synthetic.clip import SyntheticClip, tiny_clip
from vipe_core.geometry import umeyama
from vipe_core.pipeline.annotator import Annotator


@pytest.fixture(scope="module")
def wide() -> SyntheticClip:
    return tiny_clip("orbit", 20, model="mei")


@pytest.fixture(scope="module")
def folder(wide: SyntheticClip, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("wide") / "wide"
    path.mkdir()
    for index, frame in enumerate(wide.rgb):
        assert cv2.imwrite(str(path / f"{index:04d}.png"), cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
    return path


def path_error(annotation: Annotation, clip: SyntheticClip) -> float:
    """RMS of the positions after the best similarity, as a share of the path."""
    truth, found = clip.world_from_cam[:, :3, 3], annotation.world_from_cam[:, :3, 3]
    error = umeyama(found, truth).apply(found) - truth
    path = np.linalg.norm(np.diff(truth, axis=0), axis=1).sum()
    return float(np.sqrt(np.square(error).sum(axis=1).mean()) / path)


def test_a_bent_lens_is_noticed_and_measured(wide: SyntheticClip, folder: Path) -> None:
    found = Annotator(camera="auto").annotate(folder)
    assert found.camera.model == "mei"
    assert path_error(found, wide) < 0.01
    assert found.camera.fov_x_deg == pytest.approx(wide.camera.fov_x_deg, abs=3.0)
    assert found.quality.reliable != "no"
    with closing(found.dense()) as dense:
        frame = next(dense)
    assert frame.depth.shape == wide.depth.shape[1:]
    scale = umeyama(found.world_from_cam[:, :3, 3], wide.world_from_cam[:, :3, 3]).scale
    assert (found.depth_kind, wide.depth_kind) == ("ray", "ray")
    error = np.abs(scale * frame.depth / wide.depth[0] - 1)
    assert np.median(error) < 0.03


def test_the_preset_for_wide_angles_takes_the_unified_camera() -> None:
    annotator = Annotator("wide_angle")
    assert annotator.preset.camera == "mei"
    assert Annotator("wide_angle", "pinhole").preset.camera == "pinhole"
    assert Annotator("wide_angle").preset.config_hash != Annotator("classical", "mei").preset.config_hash
