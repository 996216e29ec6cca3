"""Every export of every camera and of a video with cuts: it is written, or refused with a sentence. And rectified."""

from __future__ import annotations

import json
from contextlib import closing
from pathlib import Path
from typing import get_args

import cv2
import numpy as np
import pytest
from exact_room import POSES, depth_and_colour, distance_to_surfaces
from room_artifacts import CAMERAS, write_room
from typer.testing import CliRunner

from services.cli.export import Format
from services.cli.main import app
from vipe_core.cameras.calibration_files import read_calibration
from vipe_core.errors import ExportUnsupported, FormatError
from vipe_core.formats import Artifacts, export_npz, export_png16, read_artifacts
from vipe_core.formats.colmap import export_colmap
from vipe_core.formats.frames import read_frames
from vipe_core.formats.fused import fuse_cloud, fuse_mesh
from vipe_core.formats.nerfstudio import export_nerfstudio
from vipe_core.formats.ply import write_ply
from vipe_core.formats.rectified import export_pictures, rectified, write_maps
from vipe_core.rendering.depth_video import export_depth_video

EXPORTS = {
    "npz": lambda room, out: export_npz(room, out.with_suffix(".npz")),
    "png16": export_png16,
    "video": lambda room, out: export_depth_video(room, out.with_suffix(".mp4")),
    "ply": lambda room, out: write_ply(out.with_suffix(".ply"), fuse_cloud(room, voxel=0.4, step=8)),
    "mesh": lambda room, out: write_ply(out.with_suffix(".ply"), fuse_mesh(room, voxel=0.4, step=8)),
    "colmap": lambda room, out: export_colmap(room, out, voxel=0.4, step=8),
    "nerfstudio": lambda room, out: export_nerfstudio(room, out, voxel=0.4, step=8),
    "pictures": lambda room, out: export_pictures(room, out, step=8),
}
REFUSED = {
    ("nerfstudio", "mei"): "no model of a unified",
    ("nerfstudio", "rational"): "rational distortion",
    ("pictures", "equirect"): "no model of a panorama",
}
WITHOUT_CUTS = ("ply", "mesh", "colmap", "nerfstudio")
FOLDERS = ("png16", "colmap", "nerfstudio", "pictures")


@pytest.fixture(scope="module")
def rooms(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Artifacts]:
    return {model: write_room(tmp_path_factory.mktemp(model), model) for model in CAMERAS}


@pytest.fixture(scope="module")
def cut_room(tmp_path_factory: pytest.TempPathFactory) -> Artifacts:
    return write_room(tmp_path_factory.mktemp("cut"), cuts=(5,))


def test_the_table_knows_every_format() -> None:
    assert set(EXPORTS) == set(get_args(Format))


# A rational distortion is an opencv camera to all but the formats that have no place for its last coefficients. A
# fisheye is one to those that describe no lens.
PAIRS = [
    pytest.param(name, model, marks=[pytest.mark.long] * (model == "opencv_fisheye" and name not in FOLDERS))
    for model in CAMERAS
    for name in EXPORTS
    if model != "rational" or name in FOLDERS[1:3]
]


@pytest.mark.parametrize(("name", "model"), PAIRS)
def test_written_or_refused(rooms: dict[str, Artifacts], name: str, model: str, tmp_path: Path) -> None:
    words = REFUSED.get((name, model))
    if words is None:
        out = EXPORTS[name](rooms[model], tmp_path / "out")
        assert (out / "export.json").is_file() if name in FOLDERS else out.stat().st_size > 0
        return
    with pytest.raises(ExportUnsupported, match=words) as caught:
        EXPORTS[name](rooms[model], tmp_path / "out")
    assert caught.value.code == "export_unsupported"
    assert str(caught.value).startswith("room: ")
    assert not list(tmp_path.iterdir())
    EXPORTS[name](rectified(rooms[model]), tmp_path / "out")  # as the sentence says


@pytest.mark.parametrize("name", EXPORTS)
def test_shots_share_no_world(cut_room: Artifacts, name: str, tmp_path: Path) -> None:
    room = cut_room
    out = tmp_path / "out" / "room"
    if name in WITHOUT_CUTS:
        with pytest.raises(ExportUnsupported, match=r"cuts \(at frame 5\).*--shot"):
            EXPORTS[name](room, out)
        assert not out.exists()
        room = room.shot(1)
    EXPORTS[name](room, out)


def test_a_shot_is_its_frames(cut_room: Artifacts) -> None:
    room = cut_room
    assert room.cuts == (5,)
    first, second = room.shot(1), room.shot(2)
    assert (first.num_frames, second.num_frames, second.cuts) == (5, len(POSES) - 5, ())
    assert room.longest_shot().num_frames == 5
    np.testing.assert_array_equal(second.world_from_cam, room.world_from_cam[5:])
    with closing(read_frames(room)) as whole, closing(read_frames(second)) as part:
        whole_frames, part_frames = list(whole), list(part)
    assert [frame.index for frame in part_frames] == list(range(second.num_frames))
    np.testing.assert_array_equal(part_frames[1].rgb, whole_frames[6].rgb)
    np.testing.assert_array_equal(part_frames[1].depth, whole_frames[6].depth)
    with pytest.raises(FormatError, match="no shot 3; there are 2"):
        room.shot(3)


@pytest.mark.parametrize("model", ["opencv", "opencv_fisheye"])
def test_clouds_of_distorted_lenses_are_on_the_surfaces(rooms: dict[str, Artifacts], model: str) -> None:
    cloud, mesh = fuse_cloud(rooms[model], voxel=0.05), fuse_mesh(rooms[model], voxel=0.08)
    assert len(cloud) > 1500
    assert np.quantile(distance_to_surfaces(cloud.points.astype(np.float64)), 0.99) < 0.02
    assert np.quantile(distance_to_surfaces(mesh.vertices.astype(np.float64)), 0.95) < 0.06


@pytest.mark.parametrize("model", [model for model in CAMERAS if model != "equirect"])
def test_colmap_and_our_reader_see_the_lens_that_was_given(
    rooms: dict[str, Artifacts], model: str, tmp_path: Path
) -> None:
    assert rooms[model].camera == CAMERAS[model]  # to the last bit, though the npz holds float32
    out = export_colmap(rooms[model], tmp_path / "c", text=True, voxel=0.4, step=8)
    again = read_calibration(out / "sparse/0/cameras.txt").camera
    assert again.model == CAMERAS[model].model
    np.testing.assert_allclose(again.params, CAMERAS[model].params, rtol=1e-12)
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is not installed")
    out = export_colmap(rooms[model], tmp_path / "b", voxel=0.4, step=8)
    model_read = pycolmap.Reconstruction(str(out / "sparse/0"))
    (lens,) = model_read.cameras.values()
    point = np.array([0.31, -0.22, 1.0])
    np.testing.assert_allclose(lens.img_from_cam(point), CAMERAS[model].project(point)[0] + 0.5, atol=1e-6)


@pytest.mark.parametrize("model", ["mei", "opencv", "opencv_fisheye", "equirect"])
def test_rectified_pictures_and_depth_are_those_of_the_pinhole(rooms: dict[str, Artifacts], model: str) -> None:
    flat = rectified(rooms[model], 70.0)
    assert flat.camera.fov_x_deg == pytest.approx(70)
    assert (flat.camera.model, flat.depth_kind) == ("pinhole", "z")
    exact, colour = depth_and_colour(flat.camera, POSES[2], "z")
    with closing(read_frames(flat)) as frames:
        frame = next(f for f in frames if f.index == 2)
    use = (frame.depth > 0) & (frame.mask == 0) & (frame.kind == 0)
    assert use.mean() > 0.6
    error = np.abs(frame.depth[use] / exact[use] - 1)
    assert np.quantile(error, 0.9) < 0.01
    same = np.abs(frame.rgb.astype(int) - colour).max(axis=-1) < 60
    assert same[use].mean() > 0.8


def test_what_a_pinhole_sees_beyond_the_picture_is_black_and_without_depth(rooms: dict[str, Artifacts]) -> None:
    flat = rectified(rooms["pinhole"], 100.0)
    with closing(read_frames(flat)) as frames:
        frame = next(frames)
    assert not frame.rgb[:, :20].any()
    assert not frame.depth[:, :20].any()
    assert not frame.confidence[:, :20].any()
    assert set(np.unique(frame.kind[:, :20])) == {4}
    assert frame.depth[60, 80] > 0


def test_maps_say_how_it_was_done(rooms: dict[str, Artifacts], tmp_path: Path) -> None:
    flat = rectified(rooms["mei"])
    assert flat.camera.fov_x_deg == pytest.approx(min(100.0, CAMERAS["mei"].fov_x_deg))
    with np.load(write_maps(flat, tmp_path / "maps.npz")) as maps:
        assert (str(maps["camera"]), str(maps["source_camera"])) == ("pinhole", "mei")
        picture = next(rooms["mei"].pictures())
        mine = cv2.remap(picture, maps["map_x"], maps["map_y"], cv2.INTER_LINEAR)
        ray = np.linalg.inv(maps["K"]) @ [100.0, 40.0, 1.0]
        at = CAMERAS["mei"].project(ray)[0]
        np.testing.assert_allclose([maps["map_x"][40, 100], maps["map_y"][40, 100]], at, atol=1e-3)
    inside = ~flat.seen_by.outside if flat.seen_by is not None else None
    np.testing.assert_array_equal(next(flat.pictures())[inside], mine[inside])


def test_the_command_rectifies_and_takes_a_shot(tmp_path: Path) -> None:
    write_room(tmp_path / "in", "mei", cuts=(4,))
    arguments = [str(tmp_path / "in"), str(tmp_path / "out"), "--format", "pictures", "--rectify", "--shot", "2"]
    done = CliRunner().invoke(app, ["export", *arguments])
    assert done.exit_code == 0, done.output
    out = tmp_path / "out" / "room-shot2"
    assert len(list((out / "images").iterdir())) == len(POSES) - 4
    known = read_calibration(out / "camera.json")
    assert known.camera.model == "pinhole"
    with np.load(out / "rectification.npz") as maps:
        assert tuple(maps["params"]) == known.camera.params
    assert json.loads((out / "export.json").read_text())["format"] == "pictures"
    again = CliRunner().invoke(app, ["export", *arguments[:2], "--format", "npz", "--fov", "80"])
    assert again.exit_code == 2
    assert "--rectify" in again.output
    assert read_artifacts(tmp_path / "in", "room").cuts == (4,)
