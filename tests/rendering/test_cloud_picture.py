"""The software renderer: the nearest wins, backs are not drawn, points land where the camera model puts them."""

from __future__ import annotations

import numpy as np
import pytest
from exact_room import POSES, WALL_COLOURS, depth_and_colour, view
from hypothesis import given
from hypothesis import strategies as st

from vipe_core.cameras import Camera
from vipe_core.fusion import CloudFuser, PointCloud
from vipe_core.rendering.cloud_picture import Path3D, path_colour, render_cloud
from vipe_core.rendering.viewpoints import Stage, foreground

VIEWER = Camera.pinhole_from_fov(60.0, 96, 72)
FRONT = np.eye(4)


def board(z: float, colour: tuple[int, int, int], half: float = 0.5, toward: float = -1.0) -> PointCloud:
    """A square across the optical axis whose normals face the viewer (-1) or turn away (1)."""
    side = np.linspace(-half, half, 60)
    x, y = np.meshgrid(side, side)
    points = np.stack([x, y, np.full_like(x, z)], axis=-1).reshape(-1, 3).astype(np.float32)
    normals = np.tile(np.float32([0, 0, toward]), (len(points), 1))
    return PointCloud(points, np.tile(np.uint8(colour), (len(points), 1)), normals, 2 * half / 59)


def joined(*clouds: PointCloud) -> PointCloud:
    parts = zip(*[(c.points, c.colours, c.normals) for c in clouds], strict=True)
    points, colours, normals = (np.concatenate(part) for part in parts)
    return PointCloud(points, colours, normals, max(c.spacing for c in clouds))


@pytest.mark.parametrize("near_first", [True, False])
def test_the_nearest_surface_is_seen(near_first: bool) -> None:
    near, far = board(2.0, (250, 20, 20), half=0.3), board(3.0, (20, 20, 250), half=1.0)
    picture = render_cloud(joined(near, far) if near_first else joined(far, near), FRONT, VIEWER)
    assert tuple(picture[36, 48]) == (250, 20, 20)
    beside = picture[36, 70].astype(int)
    assert beside[2] > 200
    assert beside[0] < 40
    assert picture[2, 2].max() < 60, "the background is dark"


def test_backs_are_drawn_only_when_asked_for() -> None:
    cloud = joined(board(2.0, (250, 20, 20), toward=1.0), board(3.0, (20, 20, 250), half=1.0))
    assert tuple(render_cloud(cloud, FRONT, VIEWER)[36, 48]) == (20, 20, 250)
    assert tuple(render_cloud(cloud, FRONT, VIEWER, back_faces=True)[36, 48]) == (250, 20, 20)


def test_the_picture_from_a_camera_is_the_frame_of_that_camera() -> None:
    camera = Camera.pinhole_from_fov(70.0, 160, 120)
    fuser = CloudFuser(camera, "z", 0.02)
    for pose in POSES:
        fuser.add(view(camera, pose))
    picture = render_cloud(fuser.cloud(), POSES[4], camera)
    _, rgb = depth_and_colour(camera, POSES[4], "z")
    drawn = picture.max(axis=-1) > 70
    assert drawn.mean() > 0.97
    # The colours of the three directions of walls, shading aside.
    right = picture[drawn].argmax(axis=-1) == rgb[drawn].argmax(axis=-1)
    assert right.mean() > 0.97
    assert len(WALL_COLOURS) == 3


def test_what_is_beside_something_nearer_is_shaded() -> None:
    cloud = joined(board(2.0, (200, 200, 200), half=0.3), board(4.0, (200, 200, 200), half=2.0))
    picture = render_cloud(cloud, FRONT, VIEWER)[..., 0].astype(int)
    edge = round(36 + VIEWER.params[0] * 0.3 / 2.0)
    assert picture[36, 48] == 200
    assert min(picture[edge : edge + 4, 48]) < 170
    assert picture[66, 48] > 190


def test_a_path_is_hidden_behind_surfaces() -> None:
    poses = np.tile(np.eye(4), (9, 1, 1))
    poses[:, 0, 3], poses[:, 2, 3] = np.linspace(-0.8, 0.8, 9), 3.0
    cloud = board(2.0, (90, 90, 90), half=0.25)
    path = Path3D(poses, VIEWER, frustum=0.02, num_frusta=2)
    with_path = render_cloud(cloud, FRONT, VIEWER, paths=[path]).astype(int)
    without = render_cloud(cloud, FRONT, VIEWER).astype(int)
    change = np.abs(with_path - without).sum(axis=-1)
    middle, beside = change[36, 44:53].max(), change[36, 62:70].max()
    assert beside > 150
    assert 0 < middle < 0.6 * beside
    partly = render_cloud(cloud, FRONT, VIEWER, paths=[Path3D(poses, VIEWER, 0.02, 2, upto=1)]).astype(int)
    assert np.abs(partly - without).sum(axis=-1)[36, 60:].max() == 0
    assert path_colour(0.0) != path_colour(1.0)


@given(st.floats(-180, 180), st.floats(5, 80), st.booleans())
def test_the_stage_is_in_the_picture_and_upright(azimuth: float, elevation: float, wide: bool) -> None:
    rng = np.random.default_rng(3)
    points = rng.uniform(-1, 1, (4000, 3)).astype(np.float32) * np.float32([2, 1, 1.5]) + np.float32([5, 0, 2])
    cloud = PointCloud(points, np.zeros((4000, 3), np.uint8), np.zeros((4000, 3), np.float32), 0.1)
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, :3, 3] = np.linspace([3, 0, 0], [7, 0, 0], 5)
    stage = Stage.of(cloud, poses)
    assert not stage.all_around
    viewer = Camera.pinhole_from_fov(45.0, 160, 90 if wide else 160)
    pose = stage.around(azimuth, elevation, viewer)
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-9)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)
    # The viewer stands above (y is down) and sees up as up.
    assert pose[1, 3] < stage.centre[1]
    assert pose[1, 1] > 0
    px, ahead = viewer.project((points.astype(np.float64) - pose[:3, 3]) @ pose[:3, :3])
    inside = ahead & (px >= 0).all(axis=1) & (px[:, 0] < viewer.width) & (px[:, 1] < viewer.height)
    assert inside.mean() > 0.96
    px, ahead = viewer.project((poses[:, :3, 3] - pose[:3, 3]) @ pose[:3, :3])
    assert (ahead & (px >= 0).all(axis=1) & (px[:, 0] < viewer.width) & (px[:, 1] < viewer.height)).all()


def test_up_is_across_the_floor_however_the_cameras_are_held() -> None:
    camera = Camera.pinhole_from_fov(70.0, 160, 120)
    angle = np.radians(25.0)
    down, rolled = np.eye(4), np.eye(4)
    down[1:3, 1:3] = [[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]
    rolled[:2, :2] = [[np.cos(0.15), -np.sin(0.15)], [np.sin(0.15), np.cos(0.15)]]
    poses = np.stack([pose @ down @ rolled for pose in POSES])
    fuser = CloudFuser(camera, "z", 0.03)
    for pose in poses:
        fuser.add(view(camera, pose))
    stage = Stage.of(fuser.cloud(), poses)
    assert np.degrees(np.arccos(stage.axes[1] @ [0, -1, 0])) < 0.5
    azimuth, elevation = stage.best(VIEWER)
    assert 0 < elevation < 45
    assert abs(azimuth) <= 40


def test_far_background_is_not_framed() -> None:
    near = board(2.0, (9, 9, 9))
    far = board(60.0, (9, 9, 9), half=20.0)
    few = far.where(np.arange(0, len(far), 20))
    kept = foreground(joined(near, few), FRONT[None])
    assert kept[: len(near)].all()
    assert not kept[len(near) :].any()
