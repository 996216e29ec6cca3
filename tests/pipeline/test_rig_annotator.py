"""A rendered stereo pair through the whole engine: one world, metres from the baseline, and the rig that comes out."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from clip_source import ClipSource

from vipe_core.cameras import Camera
from vipe_core.cameras.calibration import Calibration
from vipe_core.cameras.rig import Rig, RigView
from vipe_core.errors import ConfigError
from vipe_core.evaluation.synthetic.clip import render_rig
from vipe_core.evaluation.synthetic.paths import look_at, through
from vipe_core.evaluation.synthetic.scenes import room_scene
from vipe_core.geometry.arrays import inverse
from vipe_core.pipeline.rig_annotator import RigAnnotator

CAMERA = Camera.pinhole_from_fov(70.0, 160, 120)


BENT = Camera("opencv", (*CAMERA.params, -0.25, 0.05, *[0.0] * 6), CAMERA.width, CAMERA.height)


def pair() -> Rig:
    right = np.eye(4)
    right[0, 3] = 0.15
    views = RigView("left", np.eye(4), Calibration(CAMERA)), RigView("right", right, Calibration(BENT))
    return Rig(views, metric=True)


def test_a_stereo_pair_is_annotated_in_metres() -> None:
    """One of its lenses bends straight lines."""
    eye = through([(4.4, 1.0, 1.35), (3.75, 1.3, 1.3)], 9)
    poses = look_at(eye, np.array([3.0, 2.5, 0.8]))
    mounts = [view.rig_from_cam for view in pair().views]
    clips = render_rig(room_scene(), [CAMERA, BENT], mounts, poses)
    sources = [ClipSource(clip.rgb) for clip in clips]
    found = RigAnnotator().annotate_rig(pair(), sources)
    left, right = found.views
    assert (left.scale, left.provenance.scale_source) == ("metric", "rig")
    assert (left.camera, right.camera) == (CAMERA, BENT)
    assert left.provenance.calibration == pair().views[0].calibration.to_json()
    assert right.provenance.calibration["resampled_to"]["model"] == "pinhole"
    assert {view.quality.reliable for view in found.views} == {"yes"}
    np.testing.assert_allclose(left.world_from_cam[0], np.eye(4), atol=1e-9)
    between = inverse(left.world_from_cam) @ right.world_from_cam
    np.testing.assert_allclose(between, np.broadcast_to(mounts[1], between.shape), atol=1e-6)
    np.testing.assert_allclose(found.world_from_rig, left.world_from_cam, atol=1e-9)
    truth = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum()
    assert left.trajectory_length == pytest.approx(truth, rel=0.03)
    assert left.quality.scale_sigma_ratio < 0.1
    again = Rig.from_json(json.loads(json.dumps(found.rig.to_json())))
    assert [view.name for view in again.views] == ["left", "right"]
    np.testing.assert_allclose(again.views[1].rig_from_cam, mounts[1], atol=1e-6)
    frame = next(right.dense())
    measured = frame.depth > 0
    error = np.abs(frame.depth[measured] / clips[1].depth[0][measured] - 1)
    assert np.median(error) < 0.05


def test_a_rig_that_names_no_video_wants_one_per_view(tmp_path: Path) -> None:
    path = tmp_path / "rig.json"
    path.write_text(json.dumps(pair().to_json()))
    with pytest.raises(ConfigError, match="names no video for left, right"):
        RigAnnotator().annotate_rig(path)
    with pytest.raises(ConfigError, match="2 views, but 1 videos"):
        RigAnnotator().annotate_rig(replace(pair(), metric=False), [tmp_path / "left.mp4"])
