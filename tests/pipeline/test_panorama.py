"""A panorama from the video to distances all round, recognised by itself and stored with oblong pixels."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from vipe_core.evaluation.metrics import trajectory_errors
from vipe_core.evaluation.synthetic import tiny_clip
from vipe_core.formats import read_artifacts, write_artifacts
from vipe_core.pipeline.annotator import Annotator


@pytest.mark.slow
def test_poses_and_distances_of_a_panorama(tmp_path: Path) -> None:
    clip = tiny_clip("sideways", 10, 512, 256, model="equirect")
    folder = tmp_path / "round"
    folder.mkdir()
    for index, frame in enumerate(clip.rgb):
        flat = cv2.resize(frame, (512, 160), interpolation=cv2.INTER_AREA)
        assert cv2.imwrite(str(folder / f"{index:04d}.png"), cv2.cvtColor(flat, cv2.COLOR_RGB2BGR))
    annotation = Annotator(camera="auto").annotate(folder)
    assert (annotation.camera.model, annotation.camera.width, annotation.camera.height) == ("equirect", 512, 160)
    assert annotation.depth_kind == "ray"
    assert annotation.scale == "relative"
    assert "focal_unobservable" not in annotation.quality.reasons
    assert annotation.quality.fov_interval_deg == (360.0, 360.0)
    errors = trajectory_errors(annotation.world_from_cam, clip.world_from_cam, np.arange(10))
    assert errors.ate_percent is not None
    assert errors.ate_percent < 1
    assert errors.rotation_rmse_deg < 0.2
    assert errors.scale is not None
    write_artifacts(annotation, tmp_path / "out")
    artifacts = read_artifacts(tmp_path / "out", "round")
    assert artifacts.camera == annotation.camera
    with artifacts.open_depth() as maps:
        for index, depth in enumerate(maps):
            assert depth.shape == (160, 512)
            truth = cv2.resize(clip.depth[index], (512, 160), interpolation=cv2.INTER_NEAREST)
            error = np.abs(errors.scale * depth / truth - 1)
            assert np.median(error) < 0.03
            assert np.median(error[-8:]) < 0.05
            assert np.isfinite(depth).all()
            assert depth.min() > 0


def test_the_preset_for_panoramas_takes_the_equirectangular_camera() -> None:
    assert Annotator("panorama").preset.camera == "equirect"
    assert Annotator("panorama").preset.providers["intrinsics_init"] == "classical.cube_faces"
