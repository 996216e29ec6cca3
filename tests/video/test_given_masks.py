"""Masks that come with a video: each frame gets its own, and what does not belong to the video is refused."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from video_clips import number_of, write_clip

from vipe_core.errors import CorruptMedia, EmptyMedia, MaskMismatch, MediaNotFound
from vipe_core.slam.working import working_frame
from vipe_core.video import Frame, ImageDirectorySource, MaskedView, VideoFileSource
from vipe_core.video.views import FrameView, ReversedView

WIDTH, HEIGHT, COUNT = 96, 64, 6


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_clip(tmp_path_factory.mktemp("clip") / "clip.mp4", COUNT, (WIDTH, HEIGHT))


def write_masks(folder: Path, names: list[str], size: tuple[int, int] = (WIDTH, HEIGHT)) -> Path:
    """Mask k has the value 1 in the columns from 8 k to 8 k + 7."""
    folder.mkdir(parents=True)
    for k, name in enumerate(names):
        mask = np.zeros((size[1], size[0]), np.uint8)
        mask[:, 8 * k : 8 * k + 8] = 1
        assert cv2.imwrite(str(folder / f"{name}.png"), mask)
    return folder


def columns(frame: Frame) -> list[int]:
    assert frame.masked is not None
    assert (frame.masked == frame.masked[0]).all()
    return [int(x) for x in np.flatnonzero(frame.masked[0])]


@pytest.mark.parametrize("digits", [1, 5])
def test_each_frame_of_a_video_has_the_mask_of_its_number(clip: Path, tmp_path: Path, digits: int) -> None:
    masks = write_masks(tmp_path / "masks", [f"{k:0{digits}d}" for k in range(COUNT)])
    view = MaskedView(VideoFileSource(clip), masks)
    assert view.num_masks == COUNT
    shown = list(view.frames())
    assert [number_of(frame.rgb) for frame in shown] == list(range(COUNT))
    assert [columns(frame) for frame in shown] == [list(range(8 * k, 8 * k + 8)) for k in range(COUNT)]
    assert [columns(frame)[0] for frame in view.frames(start=2, stop=4)] == [16, 24]
    # Of a smaller picture, every pixel that shows any of the mask.
    small = next(view.frames((WIDTH // 6, HEIGHT // 4), start=1))
    assert columns(small) == [1, 2]
    backwards = ReversedView(view, [k / 25 for k in range(COUNT)])
    assert [columns(frame)[0] for frame in backwards.frames()] == [40, 32, 24, 16, 8, 0]


def test_pictures_have_the_masks_of_their_names(tmp_path: Path) -> None:
    names = ["cat", "dog", "owl"]
    images = write_masks(tmp_path / "images", names)
    masks = write_masks(tmp_path / "masks", names)
    view = MaskedView(ImageDirectorySource(images), masks)
    assert [columns(frame)[0] for frame in view.frames()] == [0, 8, 16]
    part = MaskedView(FrameView(ImageDirectorySource(images), stop=2), masks)
    assert [columns(frame)[0] for frame in part.frames()] == [0, 8]
    numbered = write_masks(tmp_path / "numbered", ["0", "1", "2"])
    assert [columns(frame)[0] for frame in MaskedView(ImageDirectorySource(images), numbered).frames()] == [0, 8, 16]
    (masks / "owl.png").unlink()
    with pytest.raises(MaskMismatch, match=r"owl\.png"):
        MaskedView(ImageDirectorySource(images), masks)


def test_masks_of_something_else_are_refused(clip: Path, tmp_path: Path) -> None:
    video = VideoFileSource(clip)
    with pytest.raises(MediaNotFound, match="nowhere"):
        MaskedView(video, tmp_path / "nowhere")
    with pytest.raises(EmptyMedia, match="no PNG"):
        MaskedView(video, write_masks(tmp_path / "empty", []))
    with pytest.raises(MaskMismatch, match=r"48x32.*96x64"):
        MaskedView(video, write_masks(tmp_path / "small", ["0", "1"], (48, 32)))
    with pytest.raises(MaskMismatch, match="0 to 5"):
        MaskedView(video, write_masks(tmp_path / "from_one", [str(k + 1) for k in range(COUNT)]))
    with pytest.raises(MaskMismatch, match="frame 4 has none"):
        list(MaskedView(video, write_masks(tmp_path / "few", [str(k) for k in range(4)])).frames())
    with pytest.raises(MaskMismatch, match="8 masks, but the video has 6 frames"):
        list(MaskedView(video, write_masks(tmp_path / "many", [str(k) for k in range(8)])).frames())
    broken = write_masks(tmp_path / "broken", [str(k) for k in range(COUNT)])
    (broken / "3.png").write_bytes(b"no picture")
    with pytest.raises(CorruptMedia, match=r"3\.png"):
        list(MaskedView(video, broken).frames())


def test_what_is_masked_is_not_valid() -> None:
    rgb = np.full((HEIGHT, WIDTH, 3), 120, np.uint8)
    masked = np.zeros((HEIGHT, WIDTH), np.bool_)
    masked[20:30, 40:60] = True
    work = working_frame(Frame(0, 0.0, rgb, masked))
    assert work.valid is not None
    np.testing.assert_array_equal(work.valid, ~masked)
    # A letterbox is not valid either.
    rgb[:8] = 0
    work = working_frame(Frame(0, 0.0, rgb, masked))
    assert work.valid is not None
    assert not work.valid[:8].any()
    np.testing.assert_array_equal(work.valid[8:], ~masked[8:])
