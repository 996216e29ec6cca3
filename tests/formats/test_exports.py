"""Exports read back: by other people's readers where they are there, and against the exact room."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import plyfile
import pytest
from exact_room import POSES, depth_and_colour, distance_to_surfaces
from hypothesis import given
from hypothesis import strategies as st
from room_artifacts import CAMERAS, MOVING_PATCH, write_room

from vipe_core.errors import ExportUnsupported, FormatError
from vipe_core.formats import export_png16, read_png16
from vipe_core.formats.colmap import export_colmap
from vipe_core.formats.fused import fuse_cloud, fuse_mesh
from vipe_core.formats.nerfstudio import export_nerfstudio
from vipe_core.formats.ply import write_ply
from vipe_core.formats.png16 import Png16Code


@given(
    st.lists(st.floats(0.05, 60.0), min_size=1, max_size=20),
    st.sampled_from([Png16Code("depth", 1e-3, 0.0), Png16Code("inverse_depth", 20.0 / 65535, 0.0)]),
)
def test_sixteen_bits_hold_depth_to_half_a_step(values: list[float], code: Png16Code) -> None:
    depth = np.array([[*values, 0.0, np.nan, -1.0]], np.float32)
    found = code.decode(code.encode(depth))
    assert (found[0, -3:] == 0).all()
    true, got = depth[0, :-3].astype(np.float64), found[0, :-3].astype(np.float64)
    if code.encoding == "inverse_depth":
        true, got = 1 / true, 1 / got
    assert np.abs(true - got).max() <= 0.5 * code.scale * (1 + 1e-3)


def test_png16_of_a_metric_and_of_a_relative_sequence(tmp_path: Path) -> None:
    metric = write_room(tmp_path / "m")
    relative = write_room(tmp_path / "r", scale="relative")
    out = export_png16(metric, tmp_path / "x" / "m")
    description = json.loads((out / "export.json").read_text())
    assert description["depth"] == {"encoding": "depth", "scale": 1e-3, "offset": 0, "unit": "m", "kind": "z"}
    picture = cv2.imread(str(out / "depth/00002.png"), cv2.IMREAD_UNCHANGED)
    assert picture.dtype == np.uint16
    exact, _ = depth_and_colour(CAMERAS["pinhole"], POSES[2], "z")
    assert abs(int(picture[5, 100]) - 1000 * exact[5, 100]) < 3
    found = list(read_png16(export_png16(relative, tmp_path / "x" / "r")))
    assert len(found) == len(POSES)
    with relative.open_depth() as depth:
        for index, stored in enumerate(depth):
            np.testing.assert_allclose(found[index], stored, rtol=1e-3)
    assert json.loads((tmp_path / "x/r/export.json").read_text())["depth"]["encoding"] == "inverse_depth"
    export_png16(metric, out)  # an earlier export is replaced
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").touch()
    with pytest.raises(FormatError, match="mine"):
        export_png16(metric, tmp_path / "mine")
    assert (tmp_path / "mine/thesis.txt").is_file()
    assert not list(tmp_path.rglob(".*"))


@pytest.mark.parametrize("model", ["pinhole", "mei", "equirect"])
def test_a_cloud_in_ply_is_on_the_surfaces_for_another_reader(tmp_path: Path, model: str) -> None:
    artifacts = write_room(tmp_path, model)
    path = write_ply(tmp_path / "out" / "c.ply", fuse_cloud(artifacts, voxel=0.05), comments=["sequence room"])
    data = plyfile.PlyData.read(path)
    assert data.comments == ["sequence room"]
    vertex = data["vertex"]
    points = np.stack([vertex[axis] for axis in "xyz"], axis=1).astype(np.float64)
    assert len(points) > 1500
    # Neither the moving patch nor the filled one is among them; depth on disk has eleven bits.
    away = distance_to_surfaces(points)
    assert np.quantile(away, 0.99) < 0.02
    assert vertex["red"].dtype == np.uint8
    normals = np.stack([vertex[f"n{axis}"] for axis in "xyz"], axis=1)
    assert np.abs(np.linalg.norm(normals, axis=1) - 1).max() < 1e-3


def test_a_mesh_in_ply(tmp_path: Path) -> None:
    mesh = fuse_mesh(write_room(tmp_path), voxel=0.06)
    data = plyfile.PlyData.read(write_ply(tmp_path / "m.ply", mesh))
    faces = np.stack(data["face"]["vertex_indices"])
    np.testing.assert_array_equal(faces, mesh.faces)
    points = np.stack([data["vertex"][axis] for axis in "xyz"], axis=1).astype(np.float64)
    assert len(faces) > 2000
    assert np.quantile(distance_to_surfaces(points), 0.98) < 0.03


@pytest.mark.parametrize("model", ["pinhole", "mei", "equirect"])
@pytest.mark.parametrize("text", [False, True])
def test_colmap_reads_the_model_back(tmp_path: Path, model: str, text: bool) -> None:
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is not installed")
    if not hasattr(pycolmap.CameraModelId, "EUCM"):
        pytest.skip("this pycolmap is older than the camera models")
    artifacts = write_room(tmp_path, model)
    out = export_colmap(artifacts, tmp_path / "colmap", text=text, step=2)
    found = pycolmap.Reconstruction(str(out / "sparse" / "0"))
    assert sorted(image.name for image in found.images.values()) == [f"{k:05d}.jpg" for k in (0, 2, 4, 6, 8)]
    assert len(found.points3D) > 500
    points = np.array([point.xyz for point in found.points3D.values()])
    assert np.quantile(distance_to_surfaces(points), 0.98) < 0.03
    camera = found.cameras[1]
    for image in found.images.values():
        index = int(Path(image.name).stem)
        pose = image.cam_from_world()
        np.testing.assert_allclose(pose.matrix(), np.linalg.inv(POSES[index])[:3], atol=1e-6)
        assert cv2.imread(str(out / "images" / image.name)).shape == (
            artifacts.camera.height,
            artifacts.camera.width,
            3,
        )
        # Their projection of our points, with our parameters, is where we say that the picture shows them.
        seen = [p for p in image.points2D if p.has_point3D()]
        assert 100 < len(seen) <= 2000
        local = np.array([pose * found.points3D[p.point3D_id].xyz for p in seen])
        px = np.array([camera.img_from_cam(point) for point in local])
        error = np.abs(px - [p.xy for p in seen])
        assert error.max() < 0.02
        patch = np.array([p.xy for p in seen])
        rows, cols = MOVING_PATCH
        moving = (patch[:, 0] > cols.start) & (patch[:, 0] < cols.stop)
        moving &= (patch[:, 1] > rows.start) & (patch[:, 1] < rows.stop)
        assert not moving.any()
    assert max(point.track.length() for point in found.points3D.values()) >= 3


@pytest.mark.parametrize("model", ["pinhole", "equirect"])
def test_nerfstudio_has_opengl_axes_and_z_up(tmp_path: Path, model: str) -> None:
    artifacts = write_room(tmp_path, model)
    out = export_nerfstudio(artifacts, tmp_path / "ns", step=4)
    transforms = json.loads((out / "transforms.json").read_text())
    assert [frame["file_path"] for frame in transforms["frames"]] == [f"images/{k:05d}.jpg" for k in (0, 4, 8)]
    applied = np.vstack([np.array(transforms["applied_transform"]), [0, 0, 0, 1]])
    # A level camera's up is the world's z.
    assert applied[:3, :3] @ [0, -1, 0] == pytest.approx([0, 0, 1])
    cloud = plyfile.PlyData.read(out / transforms["ply_file_path"])["vertex"]
    points = np.stack([cloud[axis] for axis in "xyz"], axis=1).astype(np.float64)
    back = points @ applied[:3, :3]
    assert np.quantile(distance_to_surfaces(back), 0.98) < 0.03
    for frame in transforms["frames"]:
        depth = cv2.imread(str(out / frame["depth_file_path"]), cv2.IMREAD_UNCHANGED)
        row, col = 80, 130
        x = (col + 0.5 - transforms["cx"]) / transforms["fl_x"]
        y = -(row + 0.5 - transforms["cy"]) / transforms["fl_y"]
        if model == "equirect":  # as its documentation maps them
            theta, phi = -np.pi * x, np.pi * (0.5 - y)
            ray = np.array([-np.sin(theta) * np.sin(phi), np.cos(phi), -np.cos(theta) * np.sin(phi)])
        else:
            ray = np.array([x, y, -1.0])
        point = np.array(frame["transform_matrix"]) @ [*(ray * depth[row, col] / 1000), 1]
        assert distance_to_surfaces((np.linalg.inv(applied) @ point)[None, :3])[0] < 0.01


def test_nothing_measured_is_an_empty_export_and_no_error(tmp_path: Path) -> None:
    artifacts = write_room(tmp_path, measured=False)
    cloud, mesh = fuse_cloud(artifacts), fuse_mesh(artifacts)
    assert len(cloud) == len(mesh.faces) == 0
    assert plyfile.PlyData.read(write_ply(tmp_path / "c.ply", cloud))["vertex"].count == 0
    assert plyfile.PlyData.read(write_ply(tmp_path / "m.ply", mesh))["face"].count == 0
    assert (export_colmap(artifacts, tmp_path / "colmap") / "sparse/0/points3D.bin").stat().st_size == 8
    assert (export_nerfstudio(artifacts, tmp_path / "ns") / "transforms.json").is_file()


def test_what_a_format_cannot_hold_is_said(tmp_path: Path) -> None:
    artifacts = write_room(tmp_path, "mei")
    with pytest.raises(ExportUnsupported, match="mei") as error:
        export_nerfstudio(artifacts, tmp_path / "ns")
    assert error.value.code == "export_unsupported"
    assert not (tmp_path / "ns").exists()
