"""Names of sequences: readable, never colliding, stable between runs."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from vipe_core.errors import FormatError
from vipe_core.formats import SequenceNames


def test_equal_stems_get_suffixes_and_the_mapping_is_recorded(tmp_path: Path) -> None:
    root = tmp_path / "out"
    names = SequenceNames(root)
    assert names.name_for(tmp_path / "a/clip.mp4") == "clip"
    assert names.name_for(tmp_path / "b/clip.mov") == "clip-2"
    assert names.name_for(tmp_path / "c/CLIP.mp4") == "CLIP-3"
    recorded = json.loads((root / "sequences.json").read_text())
    assert recorded == {
        "clip": str(tmp_path / "a/clip.mp4"),
        "clip-2": str(tmp_path / "b/clip.mov"),
        "CLIP-3": str(tmp_path / "c/CLIP.mp4"),
    }


def test_an_input_keeps_its_name_in_the_next_run(tmp_path: Path) -> None:
    SequenceNames(tmp_path).name_for("/videos/a/clip.mp4")
    again = SequenceNames(tmp_path)
    assert again.name_for("/videos/b/clip.mp4") == "clip-2"
    assert again.name_for("/videos/a/clip.mp4") == "clip"


def test_what_another_program_wrote_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "pose").mkdir()
    (tmp_path / "pose/clip.npz").write_bytes(b"")
    (tmp_path / "rgb").mkdir()
    (tmp_path / "rgb/clip.mp4").write_bytes(b"")
    assert SequenceNames(tmp_path).name_for("/videos/clip.mp4") == "clip-2"


def test_a_foreign_file_of_that_name_is_refused(tmp_path: Path) -> None:
    (tmp_path / "sequences.json").write_text("[1, 2]")
    with pytest.raises(FormatError, match=r"sequences\.json"):
        SequenceNames(tmp_path)
