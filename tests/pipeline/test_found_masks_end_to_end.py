"""Things found by phrases, from the stage that finds them to the files that come out."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from vipe_core.errors import ConfigError
from vipe_core.evaluation.synthetic.clip import tiny_clip
from vipe_core.formats import write_artifacts
from vipe_core.pipeline.annotator import Annotator
from vipe_core.pipeline.presets import PresetOptions, resolve
from vipe_core.pipeline.providers import register_masks
from vipe_core.priors.instance_settings import InstanceSettings
from vipe_core.priors.protocols import Instances
from vipe_core.video.source import Frame


class Corner:
    """A thing in a corner, and the sky, in every picture."""

    def __init__(self, settings: InstanceSettings) -> None:
        self.phrases = {2: settings.phrases[0], 3: "sky"}

    def input_size(self, width: int, height: int) -> tuple[int, int]:
        return width // 2, height // 2

    def follow(self, frames: Iterable[Frame]) -> Iterator[Instances]:
        for frame in frames:
            ids = np.zeros(frame.rgb.shape[:2], np.uint8)
            ids[-20:, :30], ids[:5] = 2, 3
            yield Instances(ids, self.phrases)


def test_things_are_kept_out_of_the_way_and_come_out_with_their_names(tmp_path: Path) -> None:
    clip = tiny_clip("orbit", 12, 192, 144, noise=1.0)
    folder = tmp_path / "orbit"
    folder.mkdir()
    for index, frame in enumerate(clip.rgb):
        assert cv2.imwrite(str(folder / f"{index:04d}.png"), cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
    register_masks("test.corner", lambda settings, device: Corner(settings))
    options = PresetOptions(phrases=("großes Tier",))
    preset = resolve("classical_fast", options=options)
    assert preset.masks == "hf.grounding_dino_sam2"
    stages: list[str] = []
    annotation = Annotator(replace(preset, masks="test.corner")).annotate(
        folder, progress=lambda progress: stages.append(progress.stage)
    )
    assert stages[:12] == ["masks"] * 12
    assert annotation.mask_phrases == {0: "background", 1: "moving", 2: "großes Tier", 3: "sky"}
    assert annotation.provenance.providers["masks"] == "test.corner"
    assert annotation.timings_s["masks"] > 0
    frame = next(iter(annotation.dense()))
    assert (frame.mask[-40:, :60] == 2).all()
    assert (frame.mask[:10] == 3).all()
    # What is kept out of the way has no depth of its own; the sky is not kept out of it.
    assert not frame.confidence[-36:, :56].any()
    assert frame.confidence[:10].any()
    written = write_artifacts(annotation, tmp_path / "out", attributes=("mask",))
    assert written.mask_txt is not None
    assert written.mask_txt.read_text(encoding="utf-8").splitlines()[2] == "2: großes Tier"


def test_what_a_user_changes_of_a_preset_is_part_of_it() -> None:
    plain = resolve("classical")
    found = resolve("classical", options=PresetOptions(phrases=("car",), detection_interval_s=0.5))
    assert (found.instances.phrases, found.instances.interval_s) == (("car",), 0.5)
    assert found.config_hash != plain.config_hash
    assert resolve(found, options=PresetOptions(phrases=())).masks == "none"
    assert resolve("classical", options=PresetOptions()) == plain
    with pytest.raises(ConfigError, match="without phrases"):
        resolve("classical", options=PresetOptions(detection_interval_s=0.5))
    register_masks("test.twice", lambda settings, device: Corner(settings))
    with pytest.raises(ConfigError, match="already"):
        register_masks("test.twice", lambda settings, device: Corner(settings))
