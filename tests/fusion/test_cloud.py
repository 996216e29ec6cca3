"""Fused clouds: on the surfaces, within their memory, without what moves."""

from __future__ import annotations

import numpy as np
import pytest
from exact_room import POSES, ROOM, distance_to_surfaces, view

from vipe_core.annotation import DepthKind
from vipe_core.cameras import Camera, CameraModel
from vipe_core.fusion import CloudFuser, SurfaceView, surface_weight

PINHOLE = Camera.pinhole_from_fov(70.0, 160, 120)
CAMERAS = {
    "pinhole": PINHOLE,
    "mei": Camera("mei", (95.0, 95.0, 80.0, 60.0, 0.7), 160, 120),
    "equirect": Camera("equirect", (), 240, 120),
}


@pytest.mark.parametrize(("model", "kind"), [("pinhole", "z"), ("mei", "z"), ("mei", "ray"), ("equirect", "ray")])
def test_points_of_exact_depth_lie_on_the_surfaces(model: CameraModel, kind: DepthKind) -> None:
    camera = CAMERAS[model]
    fuser = CloudFuser(camera, kind, 0.03)
    for pose in POSES:
        fuser.add(view(camera, pose, kind))
    cloud = fuser.cloud(min_frames=2)
    assert len(cloud) > 5000
    away = distance_to_surfaces(cloud.points.astype(np.float64))
    # Where two surfaces meet within a voxel, its mean lies between them.
    assert np.quantile(away, 0.9) < 1e-4
    assert away.max() < 0.03
    on_a_wall = away < 1e-4
    across = np.abs(cloud.normals[on_a_wall]).max(axis=1)
    assert (across > 0.999).mean() > 0.95
    facing = np.einsum("ni,ni->n", cloud.normals, POSES[4][:3, 3] - cloud.points)
    assert (facing > 0).mean() > 0.98


def test_one_point_per_voxel_and_colours_of_what_was_seen() -> None:
    fuser = CloudFuser(PINHOLE, "z", 0.047)
    for pose in POSES:
        fuser.add(view(PINHOLE, pose))
    cloud = fuser.cloud()
    assert cloud.spacing == 0.047
    cells = np.floor(cloud.points.astype(np.float64) / 0.047)
    # A mean in float32 may round across the border of its voxel, no more.
    assert len(np.unique(cells, axis=0)) > 0.97 * len(cloud)
    left = (np.abs(cloud.points[:, 0] + ROOM[0]) < 1e-3) & (np.abs(cloud.points[:, 1]) < ROOM[1] - 0.1)
    assert left.sum() > 100
    assert (cloud.colours[left] == (200, 60, 60)).all(axis=1).mean() > 0.95


def test_memory_is_bounded_by_larger_voxels() -> None:
    bounded = CloudFuser(PINHOLE, "z", 0.01, max_points=4000)
    for pose in POSES:
        bounded.add(view(PINHOLE, pose))
        assert len(bounded) <= 4000
    cloud = bounded.cloud()
    assert cloud.spacing == bounded.voxel > 0.01
    assert 500 < len(cloud) <= 4000
    assert np.quantile(distance_to_surfaces(cloud.points.astype(np.float64)), 0.8) < 1e-3
    # The same as if it had been so coarse from the start.
    coarse = CloudFuser(PINHOLE, "z", bounded.voxel)
    for pose in POSES:
        coarse.add(view(PINHOLE, pose))
    expected = coarse.cloud()
    assert len(expected) == len(cloud)
    order = [np.lexsort(np.rint(c.points * 500).T) for c in (cloud, expected)]
    np.testing.assert_allclose(cloud.points[order[0]], expected.points[order[1]], atol=2e-3)


def test_the_same_frames_give_the_same_points() -> None:
    clouds = []
    for _ in range(2):
        fuser = CloudFuser(PINHOLE, "z", 0.03, max_points=6000)
        for pose in POSES:
            fuser.add(view(PINHOLE, pose))
        clouds.append(fuser.cloud())
    assert clouds[0].points.tobytes() == clouds[1].points.tobytes()
    assert clouds[0].colours.tobytes() == clouds[1].colours.tobytes()


def test_what_moves_or_was_not_measured_stays_out() -> None:
    depth = np.array([[1.0, 2.0, 0.0, np.nan, 3.0, 4.0]], np.float32)
    confidence = np.array([[0.9, 0.0, 0.9, 0.9, 0.1, 0.5]], np.float32)
    mask = np.array([[0, 0, 0, 0, 0, 1]], np.uint8)
    weight = surface_weight(depth, confidence=confidence, mask=mask, min_confidence=0.05)
    np.testing.assert_allclose(weight, [[0.9, 0, 0, 0, 0.1, 0]], rtol=1e-6)
    assert surface_weight(depth).tolist() == [[1, 1, 0, 0, 1, 1]]
    assert surface_weight(depth, confidence=confidence, min_confidence=0.2)[0, 4] == 0


def test_a_thing_that_was_there_once_is_looked_through() -> None:
    """Three frames have a board in the air that the others do not see."""
    fuser = CloudFuser(PINHOLE, "z", 0.03)
    views = [view(PINHOLE, pose) for pose in (POSES[4], POSES[4], POSES[4], *POSES[:3], *POSES[6:])]
    for k in range(3):
        depth = views[k].depth.copy()
        depth[40:80, 60:100] = 1.0
        views[k] = SurfaceView(views[k].world_from_cam, views[k].rgb, depth, views[k].weight)
    for one in views:
        fuser.add(one)
    cloud = fuser.cloud(min_frames=3)
    floating = distance_to_surfaces(cloud.points.astype(np.float64)) > 0.1
    assert floating.sum() > 100
    against = np.zeros(len(cloud), np.int32)
    for one in views:
        fuser.looked_through(cloud, one, against)
    gone = against >= 3
    assert gone[floating].mean() > 0.9
    assert gone[~floating].mean() < 0.005


def test_edges_between_objects_are_no_points() -> None:
    """Pixels half on the box and half on the wall, as interpolation makes them, lie on neither."""
    smeared = []
    for pose in POSES:
        exact = view(PINHOLE, pose)
        padded = np.pad(exact.depth, 1, mode="edge")
        blurred = (padded[1:-1, :-2] + padded[1:-1, 1:-1] + padded[1:-1, 2:]) / 3
        smeared.append(SurfaceView(pose, exact.rgb, blurred.astype(np.float32), exact.weight))
    fuser = CloudFuser(PINHOLE, "z", 0.03)
    for one in smeared:
        fuser.add(one)
    cloud = fuser.cloud()
    in_the_air = distance_to_surfaces(cloud.points.astype(np.float64)) > 0.15
    assert in_the_air.mean() < 0.002


def test_a_frame_of_another_size_is_refused() -> None:
    fuser = CloudFuser(PINHOLE, "z", 0.03)
    with pytest.raises(ValueError, match="size"):
        fuser.add(view(PINHOLE.resized(80, 60), POSES[0]))
    with pytest.raises(ValueError, match="voxel"):
        CloudFuser(PINHOLE, "z", 0.0)
    with pytest.raises(ValueError, match="eight"):
        CloudFuser(PINHOLE, "z", 0.1, max_points=7)


def test_the_least_memory_still_ends() -> None:
    fuser = CloudFuser(PINHOLE, "z", 0.01, max_points=8)
    for pose in POSES[:3]:
        fuser.add(view(PINHOLE, pose))
    assert 0 < len(fuser) <= 8
