"""The faces of panoramic frames show what the panorama shows, over its seam and its poles, with its masks."""

from __future__ import annotations

import numpy as np
import pytest
from clip_source import ClipSource

from vipe_core.cameras import Camera
from vipe_core.cameras.cube import FACES, CubeFaces
from vipe_core.video.faces import FaceSource


def painted(rays: np.ndarray) -> np.ndarray:
    """A colour for every direction, without edges."""
    return np.asarray(np.rint(127 + 100 * rays / np.linalg.norm(rays, axis=-1, keepdims=True)), np.uint8)


@pytest.mark.parametrize(("width", "height"), [(256, 128), (320, 180), (255, 128), (1024, 512)])
def test_faces_show_the_directions_that_they_look_at(width: int, height: int) -> None:
    picture = painted(Camera("equirect", (), width, height).rays())
    faces = CubeFaces.of_size(64)
    source = FaceSource(ClipSource(np.stack([picture, picture])), faces)
    views = list(source.frames(start=1))
    assert [[frame.index for frame in instant] for instant in views] == [[1] * 6]
    assert (source.infos[0].width, source.infos[0].height) == (64, 64)
    for frame, pose in zip(views[0], faces.panorama_from_face, strict=True):
        expected = painted(faces.camera.rays() @ pose[:3, :3].T)
        assert frame.rgb.shape == expected.shape
        # A pixel of the panorama is 2 to 4 levels wide, most of all at the poles of a low one.
        assert np.abs(frame.rgb.astype(int) - expected).max() <= 3


def test_masks_go_along_and_grow_rather_than_shrink() -> None:
    picture = painted(Camera("equirect", (), 256, 128).rays())
    masked = np.zeros((1, 128, 256), np.bool_)
    masked[0, -10:] = True
    instant = next(FaceSource(ClipSource(picture[None], masked), CubeFaces.of_size(64)).frames())
    down = instant[FACES.index("down")].masked
    up = instant[FACES.index("up")].masked
    assert down is not None
    assert up is not None
    assert not up.any()
    middle = np.hypot(*(np.mgrid[:64, :64] - 31.5))
    radius_px = 28 * np.tan(np.radians(10 / 128 * 180))
    assert down[middle < radius_px].all()
    assert not down[middle > radius_px + 2].any()


def test_closing_early_closes_the_decoder() -> None:
    clip = ClipSource(np.zeros((3, 64, 128, 3), np.uint8))
    frames = FaceSource(clip, CubeFaces.of_size(64)).frames()
    next(frames)
    assert clip.open == 1
    frames.close()
    assert clip.open == 0
