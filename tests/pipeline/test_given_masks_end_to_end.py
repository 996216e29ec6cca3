"""A clip with moving things, annotated with masks of them that its user gives."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

import vipe_core
from vipe_core.annotation import Annotation
from vipe_core.errors import MaskMismatch
from vipe_core.evaluation.metrics import mask_errors, trajectory_errors
from vipe_core.evaluation.synthetic.clip import SyntheticClip, tiny_clip

COUNT = 20


@pytest.fixture(scope="module")
def clip() -> SyntheticClip:
    return tiny_clip("dynamic", num_frames=COUNT)


@pytest.fixture(scope="module")
def images(clip: SyntheticClip, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("walk")
    for k, rgb in enumerate(clip.rgb):
        assert cv2.imwrite(str(folder / f"walk_{k:04d}.png"), cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))
    return folder


@pytest.fixture(scope="module")
def masks(clip: SyntheticClip, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("masks")
    for k, moving in enumerate(clip.dynamic):
        assert cv2.imwrite(str(folder / f"walk_{k:04d}.png"), 255 * moving.astype(np.uint8))
    return folder


@pytest.fixture(scope="module")
def masked(images: Path, masks: Path) -> Annotation:
    return vipe_core.annotate(images, masks=masks)


@pytest.mark.long
def test_true_masks_do_the_path_no_harm(clip: SyntheticClip, images: Path, masked: Annotation) -> None:
    plain = vipe_core.annotate(images)
    without = trajectory_errors(plain.world_from_cam, clip.world_from_cam).ate_percent
    given = trajectory_errors(masked.world_from_cam, clip.world_from_cam).ate_percent
    assert without is not None
    assert given is not None
    assert given < max(1.1 * without, 0.2)
    assert masked.provenance.source["num_masks"] == COUNT
    assert "num_masks" not in plain.provenance.source


def test_given_masks_are_part_of_what_comes_out(clip: SyntheticClip, masked: Annotation) -> None:
    frames = [frame.mask for frame in masked.dense()]
    assert len(frames) == COUNT
    errors = mask_errors(zip(frames, clip.dynamic, strict=True))
    assert errors is not None
    assert errors.recall == 1.0
    assert errors.false_alarms is not None
    assert errors.false_alarms < 0.1


def test_too_few_masks_are_refused(clip: SyntheticClip, images: Path, tmp_path: Path) -> None:
    assert cv2.imwrite(str(tmp_path / "0.png"), 255 * clip.dynamic[0].astype(np.uint8))
    with pytest.raises(MaskMismatch, match="1 masks for 20 pictures"):
        vipe_core.annotate(images, masks=tmp_path)
