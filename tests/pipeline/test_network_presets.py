"""Presets with networks, end to end with weights that mean nothing: the result is no good, says so, and is complete."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from clip_source import ClipSource

from vipe_core.errors import WeightsInvalid, WeightsMissing
from vipe_core.evaluation.synthetic.clip import tiny_clip
from vipe_core.formats.artifacts import write_artifacts
from vipe_core.pipeline.annotator import Annotator
from vipe_core.pipeline.presets import PRESETS, resolve
from vipe_core.priors.droid import DroidNetwork
from vipe_core.priors.weights import Record, checksum, path_of, write_record
from vipe_core.slam.recurrent.settings import RefinementSettings


@pytest.fixture
def weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Random weights where the engine looks for the real ones."""
    monkeypatch.setenv("VIPE_WEIGHTS", str(tmp_path / "weights"))
    path = path_of("droid")
    path.parent.mkdir()
    network = DroidNetwork.random(3)
    torch.save({f"module.{name}": tensor for name, tensor in network.state_dict().items()}, path)
    return path


@pytest.mark.parametrize("preset", ["pose_only", "vipe_fast"])
def test_a_preset_with_random_weights_runs_end_to_end_and_doubts_itself(
    preset: str, weights: Path, tmp_path: Path
) -> None:
    clip = tiny_clip("orbit", 6, 64, 48)
    short = RefinementSettings(
        first_updates=1, updates=1, more_updates=1, global_updates=(1, 1, 2), fill_updates=2, lean=preset == "pose_only"
    )
    found = resolve(preset)
    chosen = replace(found, slam=replace(found.slam, refinement=short))
    annotation = Annotator(chosen).annotate(ClipSource(clip.rgb))
    assert annotation.world_from_cam.shape == (6, 4, 4)
    assert np.isfinite(annotation.world_from_cam).all()
    assert np.isfinite(annotation.camera.fov_x_deg)
    assert annotation.quality.reliable in ("doubtful", "no")
    assert annotation.provenance.weights == {"droid": checksum(weights)}
    assert annotation.provenance.providers["dense_matching"] == "droid.network"
    frames = list(annotation.dense())
    assert [frame.index for frame in frames] == list(range(6))
    assert all(np.isfinite(frame.depth).all() for frame in frames)
    assert any(frame.depth.any() for frame in frames) == (preset != "pose_only")
    if preset == "pose_only":
        again = Annotator(chosen).annotate(ClipSource(clip.rgb))
        np.testing.assert_array_equal(again.world_from_cam, annotation.world_from_cam)
        written = write_artifacts(annotation, tmp_path / "out")
        assert written.pose is not None
        assert written.depth is not None


def test_a_preset_without_its_weights_fails_at_the_start_and_names_the_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("VIPE_WEIGHTS", str(tmp_path))
    needing = [name for name in PRESETS if resolve(name).weights]
    assert needing == ["vipe_fast", "pose_only"]
    for name in needing:
        with pytest.raises(WeightsMissing, match="vipectl models pull droid"):
            Annotator(name)


def test_weights_that_are_not_what_was_pulled_are_refused(weights: Path) -> None:
    write_record("droid", Record(checksum(weights), weights.stat().st_size, "https://example.org/droid.pth"))
    Annotator("pose_only")
    weights.write_bytes(weights.read_bytes()[:-1] + b"x")
    with pytest.raises(WeightsInvalid, match="SHA-256"):
        Annotator("pose_only")
