"""Points followed through consecutive frames, by OpenCV and by (a stand-in for) PyCuVSLAM."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any, ClassVar

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from vipe_core.cameras import Camera
from vipe_core.errors import ConfigError, LibraryMissing
from vipe_core.priors.classical.following import CornerFollower
from vipe_core.priors.cuvslam import CuvslamFollower
from vipe_core.video.source import Frame

WIDTH, HEIGHT = 160, 120
CAMERA = Camera.pinhole_from_fov(60, WIDTH, HEIGHT)
CPU = torch.device("cpu")


def pan(count: int, step_px: tuple[float, float], masked: NDArray[np.bool_] | None = None) -> Iterator[Frame]:
    """A window that slides over a large picture of blobs: what is in it moves by minus `step_px` a frame."""
    rng = np.random.default_rng(3)
    large = cv2.resize(
        rng.uniform(0, 255, (80, 80)).astype(np.float32), None, fx=6, fy=6, interpolation=cv2.INTER_CUBIC
    )
    for index in range(count):
        centre = (200 + index * step_px[0], 200 + index * step_px[1])
        gray = cv2.getRectSubPix(large, (WIDTH, HEIGHT), centre)
        rgb = np.repeat(np.clip(gray, 0, 255).astype(np.uint8)[..., None], 3, axis=2)
        yield Frame(index, index / 30, rgb, masked)


def test_corners_keep_their_ids_and_go_where_the_picture_goes() -> None:
    step = np.array([1.3, -0.7])
    tracks = list(CornerFollower(most=80).follow(pan(15, (1.3, -0.7)), CAMERA))
    assert len(tracks) == 15
    first, last = tracks[0], tracks[-1]
    assert len(first.ids) > 40
    shared, here, there = np.intersect1d(first.ids, last.ids, return_indices=True)
    # What does not slide out of the picture, with what is around it, is followed to the end.
    stays = ((first.px - 14 * step > 8) & (first.px - 14 * step < (WIDTH - 9, HEIGHT - 9))).all(axis=1)
    assert len(shared) > 0.9 * stays.sum()
    error = np.linalg.norm(last.px[there] - (first.px[here] - 14 * step), axis=1)
    assert np.median(error) < 0.1
    assert error.max() < 0.5
    # What slid out is made up for, under new ids.
    assert len(last.ids) >= 0.8 * 80
    assert all(len(set(one.ids.tolist())) == len(one.ids) for one in tracks)
    assert max(last.ids) > max(first.ids)


def test_nothing_is_followed_on_what_is_masked_nor_in_what_shows_nothing() -> None:
    masked = np.zeros((HEIGHT, WIDTH), np.bool_)
    masked[:, :70] = True
    tracks = list(CornerFollower(most=80).follow(pan(12, (2.0, 0.0), masked), CAMERA))
    assert all(len(one.ids) for one in tracks)
    assert all(not masked[tuple(np.rint(one.px).astype(int).T[::-1])].any() for one in tracks)
    black = [Frame(index, index / 30, np.zeros((HEIGHT, WIDTH, 3), np.uint8)) for index in range(3)]
    assert [len(one.ids) for one in CornerFollower().follow(black, CAMERA)] == [0, 0, 0]
    assert list(CornerFollower().follow([], CAMERA)) == []


def test_large_pictures_are_followed_at_a_bounded_size() -> None:
    for follower in (CornerFollower(), CuvslamFollower(cuvslam_double([]), CPU)):
        assert follower.input_size(3840, 2160) == (1280, 720)
        assert follower.input_size(640, 480) == (640, 480)


def cuvslam_double(observed: list[list[tuple[int, float, float]]]) -> Any:
    """A package with the interface of PyCuVSLAM that sees what it is told, and keeps what it is given."""

    class Odometry:
        OdometryMode = SimpleNamespace(Mono="mono")
        made: ClassVar[list[Odometry]] = []

        @staticmethod
        def Config(  # noqa: N802 (the package's name)
            *,
            odometry_mode: str,
            async_sba: bool,
            enable_observations_export: bool,
            enable_landmarks_export: bool,
            max_frame_delta_s: float,
        ) -> dict[str, Any]:
            return dict(locals())

        def __init__(self, rig: Any, cfg: Any) -> None:
            self.rig, self.cfg = rig, cfg
            self.given: list[tuple[int, list[NDArray[np.uint8]], list[NDArray[np.uint8]] | None]] = []
            self.made.append(self)

        def track(
            self, timestamp: int, images: list[NDArray[np.uint8]], masks: list[NDArray[np.uint8]] | None = None
        ) -> None:
            assert all(image.flags.c_contiguous and image.dtype == np.uint8 for image in images)
            self.given.append((timestamp, images, masks))

        def get_last_observations(self, camera_index: int) -> list[Any]:
            assert camera_index == 0
            seen = observed[len(self.given) - 1]
            return [SimpleNamespace(id=one, u=u, v=v) for one, u, v in seen]

    return SimpleNamespace(
        core=SimpleNamespace(Odometry=Odometry),
        Camera=lambda *, size, principal, focal: SimpleNamespace(size=size, principal=principal, focal=focal),
        Rig=lambda cameras: SimpleNamespace(cameras=cameras),
    )


def test_cuvslam_is_given_every_frame_its_camera_and_masks_and_says_where_points_are() -> None:
    seen = [[(3, 10.5, 20.25)], [(3, 11.5, 20.0), (9, 50.0, 60.0)]]
    library = cuvslam_double(seen)
    masked = np.zeros((HEIGHT, WIDTH), np.bool_)
    masked[60, 50] = True
    tracks = list(CuvslamFollower(library, CPU).follow(pan(2, (1.0, 0.0), masked), CAMERA))
    assert [one.ids.tolist() for one in tracks] == [[3], [3]]
    assert tracks[0].px.tolist() == [[10.5, 20.25]]
    assert tracks[1].px.dtype == np.float32
    (odometry,) = library.core.Odometry.made
    (eye,) = odometry.rig.cameras
    fx, fy, cx, cy = CAMERA.index_params()
    assert (eye.size, eye.principal, eye.focal) == ([WIDTH, HEIGHT], [cx, cy], [fx, fy])
    assert odometry.cfg["odometry_mode"] == "mono"
    assert odometry.cfg["enable_observations_export"]
    assert not odometry.cfg["async_sba"]
    assert [timestamp for timestamp, _, _ in odometry.given] == [0, 33333333]
    assert all(np.array_equal(masks[0], np.where(masked, 255, 0)) for _, _, masks in odometry.given)


def test_what_cuvslam_saw_before_it_was_lost_is_not_taken_for_the_present() -> None:
    seen = [[(1, 10.0, 20.0)], [(1, 12.0, 20.0)], [(1, 12.0, 20.0)], [(2, 30.0, 30.0)], []]
    tracks = CuvslamFollower(cuvslam_double(seen), CPU).follow(pan(5, (1.0, 0.0)), CAMERA)
    assert [one.ids.tolist() for one in tracks] == [[1], [1], [], [2], []]


def test_a_newer_package_has_its_odometry_at_the_top_and_each_shot_its_own() -> None:
    library = cuvslam_double([[(1, 1.0, 1.0)], [(1, 2.0, 2.0)]])
    library.Odometry = library.core.Odometry
    del library.core
    follower = CuvslamFollower(library, CPU)
    for _ in range(2):
        assert len(list(follower.follow(pan(2, (1.0, 0.0)), CAMERA))) == 2
    assert len(library.Odometry.made) == 2


def test_cuvslam_needs_a_gpu_and_its_package() -> None:
    with pytest.raises(ConfigError, match="CUDA only"):
        CuvslamFollower.load(CPU)
    with pytest.raises(LibraryMissing, match=r"cuvslam cannot be used.*releases"):
        CuvslamFollower.load(torch.device("cuda"))
