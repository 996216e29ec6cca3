"""A panoramic video with a cut: found, and its shots posed one after the other."""

from __future__ import annotations

import numpy as np
import torch
from clip_source import ClipSource

from vipe_core.cameras import Camera
from vipe_core.evaluation.metrics import trajectory_errors
from vipe_core.evaluation.synthetic import courtyard_scene, render_clip, tiny_clip
from vipe_core.evaluation.synthetic.paths import look_at
from vipe_core.pipeline.annotator import Annotator
from vipe_core.priors.classical import classical_priors
from vipe_core.slam.panorama import PanoramaSlam
from vipe_core.slam.panorama_shots import find_shots


def test_a_cut_makes_two_shots_in_one_world() -> None:
    one = tiny_clip("sideways", 5, 256, 128, model="equirect")
    eye = np.stack((np.linspace(0, 0.4, 5), np.zeros(5), np.full(5, 1.6)), axis=-1)
    other = render_clip(
        courtyard_scene(), Camera("equirect", (), 256, 128), look_at(eye, eye + np.array([1.0, 2.0, 0.0]))
    )
    rgb = np.concatenate((one.rgb, other.rgb))
    told: list[tuple[str, int]] = []
    with torch.inference_mode():
        found = PanoramaSlam(
            lambda: classical_priors("equirect"), Annotator("panorama").preset.slam, torch.device("cpu")
        ).run(ClipSource(rgb), lambda stage, done, of: told.append((stage, done)))
    assert found.cuts == (5,)
    assert len(found.timestamps_s) == len(found.world_from_cam) == len(found.trajectory.labels) == 10
    assert sorted(found.keyframes) == list(found.keyframes)
    assert len(found.keyframes) == len(found.inverse_depth) == len(found.map.confidence)
    np.testing.assert_allclose(found.world_from_cam[5], found.world_from_cam[4], atol=1e-9)
    errors = trajectory_errors(found.world_from_cam[:5], one.world_from_cam, np.arange(5))
    assert errors.ate_percent is not None
    assert errors.ate_percent < 3
    tracked = [done for stage, done in told if stage == "track"]
    assert tracked == sorted(tracked)
    assert told[-1] == ("infill", 10)


def test_a_shot_of_its_own_is_the_whole_video() -> None:
    clip = tiny_clip("sideways", 6, 256, 128, model="equirect")
    matcher = classical_priors("equirect").matcher
    assert find_shots(ClipSource(clip.rgb), matcher, lambda stage, done, of: None) == [(0, 6)]
