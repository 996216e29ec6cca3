"""The COLMAP peer and the list of sequences: runs that fail, and files that are not there."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from benchmarks.peers.colmap import ColmapSettings, run_colmap
from benchmarks.sequences import SUITE, find_sequence
from vipe_core.errors import MediaNotFound
from vipe_core.evaluation.samples import SAMPLE_NAMES
from vipe_core.evaluation.truth import read_truth


@pytest.fixture
def pictures(tmp_path: Path) -> Path:
    """Four pictures of nothing in which COLMAP finds no feature."""
    folder = tmp_path / "rgb"
    folder.mkdir()
    for index in range(4):
        assert cv2.imwrite(str(folder / f"{index}.png"), np.full((48, 64, 3), 90, dtype=np.uint8))
    return folder


def test_a_run_without_a_model_says_so_and_is_kept(pictures: Path, tmp_path: Path) -> None:
    pytest.importorskip("pycolmap")
    settings = ColmapSettings(every=2)
    (run,) = run_colmap(pictures, ["incremental"], settings, tmp_path / "cache")
    assert run.num_frames == 2
    assert run.failure == "no model"
    assert run.camera is None
    assert run.cpu_s > 0
    assert run.cpu_s_per_posed_frame is None
    (again,) = run_colmap(pictures, ["incremental"], settings, tmp_path / "cache")
    assert again.cpu_s == run.cpu_s


def test_a_run_is_killed_at_its_time_limit(pictures: Path) -> None:
    pytest.importorskip("pycolmap")
    (run,) = run_colmap(pictures, ["global"], ColmapSettings(limit_s=0.0))
    assert run.failure == "features took more than 0 s"
    assert len(run.frame_index) == 0


def test_every_sequence_that_something_is_asked_of_is_found(shared_data: Path) -> None:
    for name in set(SUITE) - set(SAMPLE_NAMES):  # samples are rendered when they are asked for
        sequence = find_sequence(name, shared_data)
        assert sequence.video.exists()
        assert len(read_truth(sequence.truth).world_from_cam) > 1


def test_an_unknown_sequence_is_an_input_error(tmp_path: Path) -> None:
    with pytest.raises(MediaNotFound, match="nowhere"):
        find_sequence("nowhere", tmp_path)
