"""Confidence and kind of each depth value on disk: optional, ours, and invisible to readers of ViPE's layout."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from artifact_samples import make_annotation
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray
from room_artifacts import FILLED_PATCH, MOVING_PATCH, write_room

from vipe_core.annotation import FILLED, MEASURED, MOVING
from vipe_core.errors import FormatError
from vipe_core.formats import ConfidenceZipReader, ConfidenceZipWriter, read_artifacts, write_artifacts
from vipe_core.formats.frames import read_frames


@settings(max_examples=20, deadline=None)
@given(hnp.arrays(np.float32, st.tuples(st.integers(1, 30), st.integers(1, 30)), elements=st.floats(0, 1, width=32)))
def test_confidence_comes_back_to_half_a_step_and_only_zero_is_zero(
    tmp_path_factory: pytest.TempPathFactory, confidence: NDArray[Any]
) -> None:
    path = tmp_path_factory.mktemp("confidence") / "c.zip"
    with ConfidenceZipWriter(path) as writer:
        writer.append(confidence)
    with ConfidenceZipReader(path) as reader:
        found = reader.read(0)
    np.testing.assert_array_equal(found > 0, confidence > 0)
    filled = confidence <= 0.05
    assert np.abs(found - confidence).max() <= 0.5 / 15 + 1e-6
    assert np.abs(found - confidence)[filled].max(initial=0) <= 2 / 255 + 1e-6
    assert (found[filled] <= 0.05).all()
    assert (found[~filled] > 0.05).all()


def test_an_annotation_has_both_for_every_frame(tmp_path: Path) -> None:
    artifacts = write_room(tmp_path)
    assert artifacts.has_confidence
    with artifacts.open_confidence() as confidence, artifacts.open_kind() as kind:
        assert len(confidence) == len(kind) == artifacts.num_frames
        kinds, values = kind.read(4), confidence.read(4)
    assert (kinds[MOVING_PATCH] == MOVING).all()
    assert (kinds[FILLED_PATCH] == FILLED).all()
    assert kinds[0, 0] == MEASURED
    assert (values[FILLED_PATCH] == 0).all()
    assert values[0, 0] == pytest.approx(0.8, abs=0.002)
    info = json.loads((tmp_path / "vipe/room_info.json").read_text())
    assert info["depth_kinds"] == {"0": "measured", "1": "filled", "2": "sky", "3": "moving", "4": "unobserved"}
    assert "confidence" in info["attributes"]


def test_without_it_nothing_is_missed(tmp_path: Path) -> None:
    write_artifacts(make_annotation(), tmp_path)
    write_artifacts(make_annotation(), tmp_path, attributes=("pose", "intrinsics", "depth", "rgb", "mask"))
    artifacts = read_artifacts(tmp_path, "clip")
    assert not artifacts.has_confidence, "an earlier result was replaced"
    with pytest.raises(FormatError, match=r"clip\.zip"):
        artifacts.open_confidence()
    frames = list(read_frames(artifacts))
    assert [frame.index for frame in frames] == list(range(7))
    assert all(frame.confidence is None and frame.kind is None and frame.mask is not None for frame in frames)


def test_frames_are_joined_and_can_be_chosen(tmp_path: Path) -> None:
    artifacts = write_room(tmp_path)
    frames = list(read_frames(artifacts, lambda index: index % 4 == 0))
    assert [frame.index for frame in frames] == [0, 4, 8]
    moving = frames[1].moving
    assert moving is not None
    assert moving[MOVING_PATCH].all()
    assert moving.sum() == 30 * 30
    weight = frames[1].view(artifacts, 0.5).weight
    assert (weight[MOVING_PATCH] == 0).all()
    assert (weight[FILLED_PATCH] == 0).all()
    assert (weight > 0).sum() == weight.size - 900 - 600
    assert (frames[1].view(artifacts, 0.9).weight == 0).all()


def test_missing_parts_are_named(tmp_path: Path) -> None:
    artifacts = write_room(tmp_path, attributes=("pose", "intrinsics", "depth"))
    with pytest.raises(FormatError, match="rgb"):
        next(read_frames(artifacts))
    short = write_room(tmp_path / "b", name="b")
    other = write_artifacts(make_annotation(num_frames=3), tmp_path / "c")
    assert other.rgb is not None
    (tmp_path / "b/rgb/b.mp4").write_bytes(other.rgb.read_bytes())
    with pytest.raises(FormatError, match=r"size|frames"):
        list(read_frames(short))
