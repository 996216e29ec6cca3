"""Masks that come with a video: what its user says must not be used."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vipe_core.errors import EmptyMedia, MaskMismatch, MediaNotFound
from vipe_core.video.image_directory import ImageDirectorySource
from vipe_core.video.limits import Limits
from vipe_core.video.probe import is_directory
from vipe_core.video.source import FrameSource, FrameStream, VideoInfo


class MaskedView:
    """A frame source whose frames say which of their pixels must not be used.

    A mask is an 8-bit PNG of the size of the pictures, non-zero (in any channel) where a pixel must not be used. There
    is one for each frame: with the name of the picture, where the source is a directory of images and they all have
    one, else with the number of the frame, counted from 0, with or without leading zeros.

    Args:
        source: What is looked at; other views go inside of this one.
        masks: Directory of the masks.
        limits: Bounds on their size and number.

    Raises:
        MediaNotFound: No such directory.
        EmptyMedia: No PNG in it.
        MaskMismatch: The names do not fit to the frames, or the pictures have another size.
        CorruptMedia, MediaTooLarge: The first mask; names it.
    """

    def __init__(self, source: FrameSource, masks: str | Path, *, limits: Limits | None = None) -> None:
        self._source = source
        info = source.info
        root = Path(masks)
        self._name = root.name
        files = _in_order(root, info)
        self._masks = ImageDirectorySource(root, limits=limits, files=files)
        self._count = len(files)
        found = self._masks.info
        if (found.width, found.height) != (info.width, info.height):
            raise MaskMismatch(
                f"{root.name}: masks of {found.width}x{found.height} pixels, but pictures of "
                f"{info.width}x{info.height}; they must be of one size"
            )

    @property
    def info(self) -> VideoInfo:
        return self._source.info

    @property
    def num_masks(self) -> int:
        return self._count

    def frames(self, size: tuple[int, int] | None = None, start: int = 0, stop: int | None = None) -> FrameStream:
        """See `FrameSource.frames`. A pixel of a smaller picture is masked where any of those that it shows is.

        Raises:
            MaskMismatch: There are more or fewer masks than frames.
        """
        with (
            closing(self._source.frames(size, start, stop)) as frames,
            closing(self._masks.frames(None, start)) as masks,
        ):
            end = start
            for frame in frames:
                mask = next(masks, None)
                if mask is None:
                    raise self._wrong_count(f"frame {frame.index} has none")
                masked = _reduced(np.asarray(mask.rgb.max(axis=2) > 0), frame.rgb.shape[1], frame.rgb.shape[0])
                yield dataclasses.replace(frame, masked=masked)
                end = frame.index + 1
            if (stop is None or end < stop) and end < self._count:
                raise self._wrong_count(f"the video has {end} frames")

    def _wrong_count(self, reason: str) -> MaskMismatch:
        return MaskMismatch(f"{self._name}: {self._count} masks, but {reason}; one PNG per frame is needed")


def _in_order(root: Path, info: VideoInfo) -> list[str]:
    """Names of the mask files in the order of the frames."""
    if not is_directory(root):
        raise MediaNotFound(f"{root.name}: no such directory of masks; check the path")
    by_stem = dict(_pictures(root))
    if not by_stem:
        raise EmptyMedia(f"{root.name}: the directory holds no PNG; one mask per frame is needed")
    names = info.frame_names
    if names and by_stem.keys() >= set(names):
        return [by_stem[stem] for stem in names]
    numbers = {int(stem): name for stem, name in by_stem.items() if stem.isascii() and stem.isdecimal()}
    if len(numbers) == len(by_stem) and sorted(numbers) == list(range(len(numbers))):
        if names and len(numbers) != len(names):
            raise MaskMismatch(f"{root.name}: {len(numbers)} masks for {len(names)} pictures; one PNG each is needed")
        return [numbers[number] for number in sorted(numbers)]
    missing = next((stem for stem in names if stem not in by_stem), None)
    if missing is not None and not numbers:
        raise MaskMismatch(f"{root.name}: no mask {missing}.png for the picture of that name; one PNG each is needed")
    raise MaskMismatch(
        f"{root.name}: the {len(by_stem)} masks are not named by the frames 0 to {len(by_stem) - 1}"
        f"{', nor like the pictures' if names else ''}; one PNG per frame is needed"
    )


def _pictures(root: Path) -> Iterator[tuple[str, str]]:
    """(stem, name) of the PNG files."""
    try:
        entries = sorted(file.name for file in root.iterdir() if not file.name.startswith("."))
    except OSError as error:
        raise MediaNotFound(f"{root.name}: {error.strerror or 'cannot be listed'}; check the path") from error
    for name in entries:
        file = Path(name)
        if file.suffix.lower() == ".png":
            yield file.stem, name


def _reduced(mask: NDArray[np.bool_], width: int, height: int) -> NDArray[np.bool_]:
    """The mask at another size: set where any pixel of it lies that is set."""
    if mask.shape == (height, width):
        return mask
    import cv2

    share = cv2.resize(mask.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(share > 1e-6, dtype=np.bool_)
