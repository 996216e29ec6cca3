"""The gallery of a small sequence: every picture is there, shows what it should, and is the same every time."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from room_artifacts import write_room

from vipe_core.errors import FormatError
from vipe_core.formats import read_artifacts
from vipe_core.rendering.gallery import FILMS, PICTURES, GallerySizes, write_gallery
from vipe_core.video import open_source

SMALL = GallerySizes(still=(240, 168), film=(160, 112), film_frames=8, animation_width=120, animation_step=2)


def test_ten_pictures_and_two_films(tmp_path: Path) -> None:
    artifacts = write_room(tmp_path)
    paths = write_gallery(artifacts, tmp_path / "g", sizes=SMALL)
    assert [path.name for path in paths] == [f"room_{name}" for name in (*PICTURES, *FILMS)]
    assert len(PICTURES) == 10
    assert sorted(path.name for path in (tmp_path / "g").iterdir()) == sorted(path.name for path in paths)
    by_name = {path.name.removeprefix("room_"): path for path in paths}
    for name in PICTURES[:-1]:
        picture = cv2.imread(str(by_name[name]))
        assert picture.std() > 12, f"{name} shows something"
    # Frames, depth and confidence in three rows of four.
    sheet = cv2.imread(str(by_name["frames.jpg"]))
    assert sheet.shape[1] > 4 * 320
    assert sheet.shape[0] > 3 * 240

    turn = open_source(by_name["turn.mp4"])
    frames = [frame.rgb for frame in turn.frames()]
    assert len(frames) == 8
    assert frames[0].shape == (112, 160, 3)
    assert np.abs(frames[2].astype(int) - frames[6]).mean() > 5, "it turns"
    assert open_source(by_name["depth.mp4"]).info.width == 320
    _, film = cv2.imreadanimation(str(by_name["turn.webp"]))
    assert len(film.frames) == 4
    assert film.frames[0].shape[1] == 120
    assert film.loop_count == 0

    again = write_gallery(artifacts, tmp_path / "again", sizes=SMALL)
    for first, second in zip(paths, again, strict=True):
        assert first.read_bytes() == second.read_bytes(), first.name


def test_a_sequence_of_the_original_tool_has_a_gallery_without_confidence(tmp_path: Path) -> None:
    write_room(tmp_path, "equirect", attributes=("pose", "intrinsics", "depth", "rgb"))
    (tmp_path / "vipe/room_info.json").unlink()
    paths = write_gallery(read_artifacts(tmp_path, "room"), tmp_path / "g", sizes=SMALL)
    assert all(path.stat().st_size > 1000 for path in paths)


def test_a_camera_that_stands_still_measures_nothing_and_has_pictures(tmp_path: Path) -> None:
    artifacts = write_room(tmp_path, measured=False)
    paths = write_gallery(artifacts, tmp_path / "g", sizes=SMALL)
    sheet = cv2.imread(str(paths[PICTURES.index("frames.jpg")]))
    assert sheet.std() > 12
    assert all(path.stat().st_size > 0 for path in paths)


def test_without_depth_there_is_nothing_to_draw(tmp_path: Path) -> None:
    artifacts = write_room(tmp_path, attributes=("pose", "intrinsics", "rgb"))
    with pytest.raises(FormatError, match="depth"):
        write_gallery(artifacts, tmp_path / "g", sizes=SMALL)
