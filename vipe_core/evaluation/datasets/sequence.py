"""One sequence of a dataset: where its pictures lie and what is known of them. Nothing is decoded before its time."""

from __future__ import annotations

import bisect
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vipe_core.cameras.pixel_map import PixelMap
from vipe_core.errors import FormatError
from vipe_core.evaluation.truth import GroundTruth
from vipe_core.video import FrameSource, ImageDirectorySource, open_source
from vipe_core.video.views import Crop, FrameView

Array = NDArray[Any]


@dataclass(frozen=True, slots=True)
class Pictures:
    """The frames of a sequence; `open` gives them in bounded memory.

    Attributes:
        path: A video file, or a directory of images.
        files: Names of the images in order of time; all in order of their names if None.
        timestamps_s: Time of each image, starting at 0; the source's own if None.
        stop: Frames from this one on are left out.
        seen_by: The camera that sees the pictures in place of their own.
        crop: Size (width, height) of the part in the middle of the picture that is kept.
    """

    path: Path
    files: tuple[str, ...] | None = None
    timestamps_s: tuple[float, ...] | None = None
    stop: int | None = None
    seen_by: PixelMap | None = None
    crop: tuple[int, int] | None = None

    def open(self, name: str | None = None) -> FrameSource:
        """Raises:
        InputError, DecodeError: The pictures cannot be read, or are smaller than the crop.
        """
        source: FrameSource
        if self.files is None:
            source = open_source(self.path, name=name)
        else:
            source = ImageDirectorySource(self.path, name=name, files=self.files)
        if (self.timestamps_s, self.stop, self.seen_by, self.crop) == (None, None, None, None):
            return source
        size = source.info.width, source.info.height
        return FrameView(
            source,
            stop=self.stop,
            seen_by=self.seen_by,
            crop=None if self.crop is None else Crop.centred(*self.crop, size),
            timestamps_s=self.timestamps_s,
        )


@dataclass(frozen=True, slots=True)
class GroundTruthSequence:
    """A video with what is known to be true of it.

    Attributes:
        dataset: Name of the dataset.
        name: Name of the sequence, as the dataset has it.
        pictures: Its frames.
        truth: Rows for the frames that have one; `truth.camera` is that of `pictures`.
        notes: What a reader of the figures must know.
    """

    dataset: str
    name: str
    pictures: Pictures
    truth: GroundTruth
    notes: tuple[str, ...] = ()


class LazyDepth:
    """Depth maps that are read from their files one by one (`DepthFrames`).

    Args:
        shape: (N, h, w).
        read: Gives map `row`; the shape of each is checked.
    """

    def __init__(self, shape: tuple[int, int, int], read: Callable[[int], Array]) -> None:
        self._shape = shape
        self._read = read

    @property
    def shape(self) -> tuple[int, ...]:
        return self._shape

    def __getitem__(self, row: int, /) -> Array:
        depth = self._read(row)
        if depth.shape != self._shape[1:]:
            raise FormatError(f"depth map {row} is {depth.shape}, the others are {self._shape[1:]}")
        return depth


def read_depth_png(path: Path, per_metre: float, invalid: int = 0) -> NDArray[np.float32]:
    """A 16-bit depth picture in metres; `invalid` becomes 0.

    Raises:
        FormatError: It is missing or no 16-bit picture.
    """
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) if path.is_file() else None
    if image is None or image.dtype != np.uint16 or image.ndim != 2:
        raise FormatError(f"{path.parent.name}/{path.name}: not a 16-bit depth picture; was the download cut short?")
    return np.where(image == invalid, 0, image).astype(np.float32) / np.float32(per_metre)


def picture_size(path: Path) -> tuple[int, int]:
    """(width, height) of an image file.

    Raises:
        FormatError: It cannot be read.
    """
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) if path.is_file() else None
    if image is None:
        raise FormatError(f"{path.parent.name}/{path.name}: not a readable picture; was the download cut short?")
    return image.shape[1], image.shape[0]


def nearest_rows(times_s: Sequence[float] | Array, reference_s: Array, max_apart_s: float) -> NDArray[np.int64]:
    """For each of `times_s` the row of the nearest of `reference_s` (increasing), -1 where none is near enough.

    The earlier one where two are equally near.
    """
    rows = np.full(len(times_s), -1, dtype=np.int64)
    known = reference_s.tolist()
    for k, time_s in enumerate(times_s):
        after = bisect.bisect_left(known, float(time_s))
        around = [row for row in (after - 1, after) if 0 <= row < len(known)]
        best = min(around, key=lambda row: abs(known[row] - time_s), default=-1)
        if best >= 0 and abs(known[best] - time_s) <= max_apart_s:
            rows[k] = best
    return rows


def read_table(path: Path, columns: int, separator: str | None = None) -> Array:
    """(N, columns) float64 numbers of a text file; lines that start with # are comments.

    Args:
        columns: Further ones are ignored.

    Raises:
        FormatError: The file is missing, empty, or a line does not hold that many numbers.
    """
    rows = [line[:columns] for line in read_fields(path, columns, separator)]
    try:
        return np.array(rows, dtype=np.float64).reshape(-1, columns)
    except ValueError as error:
        raise FormatError(f"{label(path)}: {columns} numbers per line are needed ({error})") from error


def read_fields(path: Path, columns: int, separator: str | None = None) -> list[list[str]]:
    """Lines of a text file split into fields, without comments (#) and empty lines.

    Raises:
        FormatError: The file is missing, empty, or a line has fewer than `columns` fields.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except FileNotFoundError as error:
        raise FormatError(f"{label(path)}: no such file; is this a folder of the dataset?") from error
    except (OSError, UnicodeDecodeError) as error:
        raise FormatError(f"{label(path)}: not a readable text file") from error
    fields = [line.strip().split(separator) for line in lines if line.strip() and not line.lstrip().startswith("#")]
    if not fields:
        raise FormatError(f"{label(path)}: holds no data")
    for number, line in enumerate(fields, start=1):
        if len(line) < columns:
            raise FormatError(f"{label(path)}: {columns} fields per line are needed, entry {number} has {len(line)}")
    return fields


def label(path: Path) -> str:
    """How messages name a file: with its folder."""
    return f"{path.parent.name}/{path.name}"
