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
    one = tiny_clip("sideways", 7, 256, 128, model="equirect")
    eye = np.stack((np.linspace(0, 1.5, 7), np.zeros(7), np.full(7, 1.6)), axis=-1)
    other = render_clip(courtyard_scene(), Camera("equirect", (), 256, 128), look_at(eye, np.array([3.0, 6.0, 1.0])))
    rgb = np.concatenate((one.rgb, other.rgb))
    told: list[tuple[str, int]] = []
    with torch.inference_mode():
        found = PanoramaSlam(classical_priors("equirect"), Annotator("panorama").preset.slam, torch.device("cpu")).run(
            ClipSource(rgb), lambda stage, done, of: told.append((stage, done))
        )
    assert found.cuts == (7,)
    assert len(found.timestamps_s) == len(found.world_from_cam) == len(found.trajectory.labels) == 14
    assert sorted(found.keyframes) == list(found.keyframes)
    assert len(found.keyframes) == len(found.inverse_depth) == len(found.map.confidence)
    np.testing.assert_allclose(found.world_from_cam[7], found.world_from_cam[6], atol=1e-9)
    errors = trajectory_errors(found.world_from_cam[:7], one.world_from_cam, np.arange(7))
    assert errors.ate_percent is not None
    assert errors.ate_percent < 3
    assert [done for stage, done in told if stage == "track"] == sorted(
        done for stage, done in told if stage == "track"
    )
    assert told[-1] == ("infill", 14)


def test_a_shot_of_its_own_is_the_whole_video() -> None:
    clip = tiny_clip("sideways", 6, 256, 128, model="equirect")
    matcher = classical_priors("equirect").matcher
    assert find_shots(ClipSource(clip.rgb), 64, matcher, lambda stage, done, of: None) == [(0, 6)]
