"""Meshes of exact depth: on the surfaces to half a voxel, closed over block borders, facing the cameras."""

from __future__ import annotations

import numpy as np
import pytest
from exact_room import BOX, BOX_CENTRE, POSES, distance_to_surfaces, pose, view

from vipe_core.annotation import DepthKind
from vipe_core.cameras import Camera
from vipe_core.fusion import Mesh, TsdfVolume

PINHOLE = Camera.pinhole_from_fov(70.0, 240, 180)
VOXEL = 0.04


@pytest.fixture(scope="module")
def mesh() -> Mesh:
    volume = TsdfVolume(PINHOLE, "z", VOXEL)
    for one in POSES:
        volume.add(view(PINHOLE, one))
    return volume.mesh()


def test_vertices_lie_on_the_box_to_half_a_voxel(mesh: Mesh) -> None:
    points = mesh.vertices.astype(np.float64)
    assert len(points) > 5000
    away = distance_to_surfaces(points)
    assert np.quantile(away, 0.99) < VOXEL / 2
    assert np.median(away) < VOXEL / 20
    # The front of the box, which all cameras see, without its edges.
    front = (np.abs(points[:, 2] - (BOX_CENTRE[2] - BOX[2])) < VOXEL) & (
        np.abs(points - BOX_CENTRE)[:, :2] < BOX[:2] - 2 * VOXEL
    ).all(axis=1)
    front &= points[:, 1] < 1.9
    assert front.sum() > 500
    assert np.abs(points[front, 2] - 0.7).max() < VOXEL / 2


def test_faces_turn_to_the_cameras_and_have_no_cracks(mesh: Mesh) -> None:
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(np.float64) for k in range(3))
    normals, middle = np.cross(b - a, c - a), (a + b + c) / 3
    seen = [np.einsum("ni,ni->n", normals, one[:3, 3] - middle) > 0 for one in POSES]
    assert np.any(seen, axis=0).mean() > 0.99
    # Every edge inside of the front of the box has a face on each side: blocks are joined.
    edges = np.sort(np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]]), axis=1)
    edges, count = np.unique(edges, axis=0, return_counts=True)
    ends = mesh.vertices[edges].mean(axis=1).astype(np.float64)
    inside = (np.abs(ends[:, 2] - 0.7) < VOXEL) & (np.abs(ends[:, 0] - 0.3) < 0.5) & (ends[:, 1] > 0) & (ends[:, 1] < 1)
    assert inside.sum() > 500
    assert (count[inside] == 2).all()
    assert np.abs(np.linalg.norm(mesh.normals(), axis=1) - 1).max() < 1e-3


def test_colours_are_those_of_the_surfaces(mesh: Mesh) -> None:
    front = (np.abs(mesh.vertices[:, 2] - 0.7) < 0.01) & (np.abs(mesh.vertices[:, 0] - 0.3) < 0.4)
    front &= np.abs(mesh.vertices[:, 1] - 0.6) < 0.4
    assert front.sum() > 100
    assert (mesh.colours[front] == (60, 60, 200)).all(axis=1).mean() > 0.95


def test_memory_is_bounded_by_larger_voxels() -> None:
    volume = TsdfVolume(PINHOLE, "z", 0.02, max_blocks=700)
    for one in POSES:
        volume.add(view(PINHOLE, one))
    found = volume.mesh()
    assert found.spacing == volume.voxel > 0.02
    away = distance_to_surfaces(found.vertices.astype(np.float64))
    assert len(away) > 300
    assert np.quantile(away, 0.95) < volume.voxel / 2


@pytest.mark.parametrize(
    ("camera", "kind"),
    [(Camera("mei", (140.0, 140.0, 120.0, 90.0, 0.7), 240, 180), "z"), (Camera("equirect", (), 360, 180), "ray")],
)
def test_other_cameras(camera: Camera, kind: DepthKind) -> None:
    volume = TsdfVolume(camera, kind, 0.06)
    for one in (pose(-0.9, -0.5, -1.5), pose(-0.6, -0.4, -1.5), pose(-0.3, -0.5, -1.4)):
        volume.add(view(camera, one, kind))
    found = volume.mesh()
    away = distance_to_surfaces(found.vertices.astype(np.float64))
    assert len(away) > 3000
    assert np.quantile(away, 0.98) < 0.03


def test_small_pieces_are_left_out(mesh: Mesh) -> None:
    volume = TsdfVolume(PINHOLE, "z", VOXEL)
    for one in POSES[:3]:
        volume.add(view(PINHOLE, one))
    whole, cleaned = volume.mesh(min_faces=1), volume.mesh(min_faces=400)
    assert len(whole.faces) >= len(cleaned.faces) > 1000
    assert cleaned.faces.max() == len(cleaned.vertices) - 1
    assert len(volume.mesh(min_faces=10**9).faces) == len(volume.mesh(min_faces=10**9).vertices) == 0


def test_the_least_memory_still_ends() -> None:
    volume = TsdfVolume(PINHOLE, "z", 0.02, max_blocks=8)
    for one in POSES[:2]:
        volume.add(view(PINHOLE, one))
    assert volume.voxel > 0.1


def test_nothing_seen_is_an_empty_mesh() -> None:
    empty = TsdfVolume(PINHOLE, "z", VOXEL).mesh()
    assert empty.vertices.shape == empty.normals().shape == (0, 3)
