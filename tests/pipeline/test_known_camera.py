"""A calibration from the call to the files: held to the last bit, and of odd lenses in the pixels of the source."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from clip_source import ClipSource

from vipe_core.annotation import MEASURED, DenseFrame
from vipe_core.cameras import Camera
from vipe_core.cameras.calibration import Calibration
from vipe_core.errors import CalibrationMismatch, ConfigError, ScaleUnobservable
from vipe_core.evaluation.metrics import convert_depth
from vipe_core.evaluation.synthetic import SyntheticClip, render_clip, room_scene, sample_camera
from vipe_core.evaluation.synthetic.paths import arc, look_at
from vipe_core.formats import read_artifacts, write_artifacts
from vipe_core.geometry import umeyama
from vipe_core.pipeline.annotator import Annotator

OFF_CENTRE = Camera("pinhole", (140.3, 151.7, 92.8, 51.1), 160, 120)


def clip_of(camera: Camera, num_frames: int = 8) -> SyntheticClip:
    eye = arc((3.0, 2.5, 1.45), 1.9, -75.0, -50.0, num_frames)
    return render_clip(room_scene(), camera, look_at(eye, np.array([3.0, 2.5, 0.7])))


def path_error(found: np.ndarray, clip: SyntheticClip) -> float:
    """RMS of the positions after the best similarity, as a share of the path."""
    truth, centres = clip.world_from_cam[:, :3, 3], found[:, :3, 3]
    error = umeyama(centres, truth).apply(centres) - truth
    return float(np.sqrt(np.square(error).sum(axis=1).mean()) / np.linalg.norm(np.diff(truth, axis=0), axis=1).sum())


def test_a_fixed_camera_comes_back_as_it_was_given(tmp_path: Path) -> None:
    clip = clip_of(OFF_CENTRE)
    found = Annotator().annotate(ClipSource(clip.rgb), calibration=Calibration(OFF_CENTRE))
    assert found.camera == OFF_CENTRE
    assert path_error(found.world_from_cam, clip) < 0.005
    assert found.quality.focal_sigma_ratio == 0
    assert found.quality.fov_interval_deg == (OFF_CENTRE.fov_x_deg, OFF_CENTRE.fov_x_deg)
    assert found.provenance.calibration == Calibration(OFF_CENTRE).to_json()
    assert found.provenance.providers["intrinsics_init"] == "calibration"
    write_artifacts(found, tmp_path, attributes=("pose", "intrinsics"))
    assert read_artifacts(tmp_path, "clip").camera == OFF_CENTRE


def test_a_starting_point_is_refined() -> None:
    clip = clip_of(OFF_CENTRE)
    start = Calibration(OFF_CENTRE.zoomed(1.03), "initial")
    found = Annotator().annotate(ClipSource(clip.rgb), calibration=start)
    assert found.camera.model == "pinhole"
    # So small a clip says little against the prior, but what it says is heard.
    assert 0.99 < found.camera.focal_px / OFF_CENTRE.focal_px < 1.0299
    assert found.camera.params[1] / found.camera.params[0] == pytest.approx(151.7 / 140.3)
    assert found.quality.focal_sigma_ratio > 0


@pytest.mark.parametrize("model", ["opencv", "opencv_fisheye"])
def test_outputs_of_a_distorted_lens_are_for_its_own_pixels(model: str, tmp_path: Path) -> None:
    lens = sample_camera(model, 160, 120)
    clip = clip_of(lens)
    masked = np.zeros(clip.rgb.shape[:3], np.bool_)
    masked[:, 20:40, 30:60] = True
    found = Annotator("classical_fast").annotate(ClipSource(clip.rgb, masked), calibration=Calibration(lens))
    assert found.camera == lens
    assert path_error(found.world_from_cam, clip) < 0.005
    with closing(found.dense()) as frames:
        frame: DenseFrame = next(frame for frame in frames if frame.index == 3)
    np.testing.assert_array_equal(frame.rgb, clip.rgb[3])
    assert frame.mask[22:38, 32:58].all()
    truth = convert_depth(clip.depth[3], lens, clip.depth_kind, found.depth_kind)
    scale = umeyama(found.world_from_cam[:, :3, 3], clip.world_from_cam[:, :3, 3]).scale
    assert (frame.depth > 0).mean() > 0.9
    there = frame.kind == MEASURED
    assert there.mean() > 0.2
    assert np.median(np.abs(scale * frame.depth[there] / truth[there] - 1)) < 0.04
    provenance = found.provenance.calibration
    assert provenance is not None
    assert provenance["resampled_to"]["model"] == ("pinhole" if model == "opencv" else "mei")
    write_artifacts(found, tmp_path, attributes=("pose", "intrinsics"))
    assert read_artifacts(tmp_path, "clip").camera == lens


def test_what_does_not_fit_is_refused_before_any_work() -> None:
    clip = clip_of(OFF_CENTRE, 2)
    with pytest.raises(CalibrationMismatch, match="clip: pictures of 160x120"):
        Annotator().annotate(ClipSource(clip.rgb), calibration=Calibration(replace(OFF_CENTRE, width=200)))
    with pytest.raises(ConfigError, match=r"none\.json"):
        Annotator().annotate(ClipSource(clip.rgb), calibration="none.json")


def test_a_pixel_without_a_ray_has_no_known_distance() -> None:
    lens = Camera("opencv", (100.0, 100.0, 80.0, 60.0, -0.22, 0, 0, 0, 0, 0, 0, 0), 160, 120)
    clip = clip_of(sample_camera("pinhole", 160, 120), 3)
    with pytest.raises(ScaleUnobservable, match="the calibration has no ray there"):
        Annotator().annotate(ClipSource(clip.rgb), calibration=Calibration(lens), scale_from="depth=2@0.5,0.5,0")
