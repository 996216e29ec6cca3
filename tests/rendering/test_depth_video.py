"""The depth video decoded again: near is bright, one range for the clip, sky and moving things apart."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from room_artifacts import FPS, MOVING_PATCH, write_room

from vipe_core.annotation import MEASURED, MOVING, SKY, UNOBSERVED
from vipe_core.rendering.depth_colours import DepthColours, paint_confidence
from vipe_core.rendering.depth_video import export_depth_video
from vipe_core.video import open_source


def luminance(rgb: np.ndarray) -> np.ndarray:
    return np.asarray(rgb, np.float64) @ [0.299, 0.587, 0.114]


def test_nearer_is_brighter_after_encoding(tmp_path: Path) -> None:
    artifacts = write_room(tmp_path)
    source = open_source(export_depth_video(artifacts, tmp_path / "d.mp4"))
    assert source.info.fps == pytest.approx(FPS)
    frames = [frame.rgb for frame in source.frames()]
    assert len(frames) == artifacts.num_frames
    colours = DepthColours.of(artifacts)
    with artifacts.open_depth() as depth:
        for index in (0, 8):
            values = depth.read(index)
            values[MOVING_PATCH] = np.nan
            order = np.argsort(values[5:25, 5:150].ravel())
            light = luminance(frames[index][5:25, 5:150]).ravel()[order]
            thirds = [part.mean() for part in np.array_split(light, 3)]
            assert thirds[0] > thirds[1] > thirds[2]
            # What was encoded is what was painted, to the loss of the codec.
            painted = colours.paint(values)[5:25, 5:150]
            assert np.abs(painted.astype(int) - frames[index][5:25, 5:150]).mean() < 12


def test_frames_stand_to_the_left(tmp_path: Path) -> None:
    artifacts = write_room(tmp_path)
    source = open_source(export_depth_video(artifacts, tmp_path / "d.mp4", beside_rgb=True))
    assert (source.info.width, source.info.height) == (320, 120)
    assert artifacts.rgb_path is not None
    rgb = [frame.rgb for frame in open_source(artifacts.rgb_path).frames()]
    for index, frame in enumerate(source.frames()):
        assert np.abs(frame.rgb[:, :160].astype(int) - rgb[index]).mean() < 6


def test_one_range_for_the_whole_clip() -> None:
    colours = DepthColours.covering(1 / np.linspace(1, 10, 1000))
    near, far = np.full((4, 4), 1.2, np.float32), np.full((4, 4), 8.0, np.float32)
    both = np.hstack([near, far])
    np.testing.assert_array_equal(colours.paint(near), colours.paint(both)[:, :4])
    ramp = luminance(colours.paint(np.linspace(1.1, 9.5, 60, dtype=np.float32)[None]))[0]
    assert (np.diff(ramp) <= 1.0).all()
    assert ramp[0] > ramp[-1] + 100


def test_sky_moving_and_unknown_are_told_apart() -> None:
    colours = DepthColours.covering(1 / np.linspace(1, 10, 1000))
    depth = np.full((60, 80), 2.0, np.float32)
    kind = np.full(depth.shape, MEASURED, np.uint8)
    kind[:20], kind[40:, :20], kind[40:, 40:60] = SKY, UNOBSERVED, MOVING
    picture = colours.paint(depth, kind=kind)
    sky, unknown, measured = picture[5, 5], picture[50, 5], picture[30, 5]
    assert len({tuple(colour) for colour in (sky, unknown, measured)}) == 3
    assert sky[2] > sky[0]
    # What moves keeps its depth's colour inside and has an outline.
    assert tuple(picture[50, 50]) == tuple(measured)
    assert (picture[50, 38:43] != measured).any()
    plain = colours.paint(depth, kind=np.where(kind == MOVING, MEASURED, kind).astype(np.uint8))
    assert tuple(plain[50, 40]) == tuple(measured)


def test_confidence_runs_from_dark_to_light() -> None:
    painted = luminance(paint_confidence(np.linspace(0, 1, 50)[None]))[0]
    assert (np.diff(painted[1:]) > -1).all()
    assert painted[-1] > painted[1] + 100


def test_another_suffix_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="mp4"):
        export_depth_video(write_room(tmp_path), tmp_path / "d.avi")
