"""The contract between the engine and whatever holds the frames."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass
from typing import Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class VideoInfo:
    """What is known before decoding. Sizes are of the upright picture, after rotation metadata.

    Attributes:
        num_frames_hint: Frame count as the container states it, or None; decoding has the last word.
        fps: Average frame rate (30 for a directory of images).
        rotation_deg: Clockwise rotation that was applied to make the picture upright: 0, 90, 180 or 270.
        pixel_aspect: Width of a pixel over its height, as the container states it.
        frame_names: Names of the files that the pictures are from, without suffix; empty for a video.
        spherical: Whether the container says that the pictures are equirectangular panoramas.
    """

    name: str
    path: str
    width: int
    height: int
    fps: float
    num_frames_hint: int | None
    duration_s: float | None
    rotation_deg: int
    codec: str
    pixel_format: str
    size_bytes: int
    frame_names: tuple[str, ...] = ()
    spherical: bool = False
    pixel_aspect: float = 1.0


@dataclass(frozen=True, slots=True)
class Frame:
    """One decoded picture.

    Attributes:
        index: 0, 1, 2 ... in presentation order.
        timestamp_s: Presentation time from the container, strictly increasing; index / fps for images.
        rgb: (height, width, 3) uint8, upright.
        masked: (height, width) bool, True on pixels that must not be used because the user says so; None where nothing
            is said.
    """

    index: int
    timestamp_s: float
    rgb: NDArray[np.uint8]
    masked: NDArray[np.bool_] | None = None


# A generator, so that `close` (or `contextlib.closing`) is there to end the decoder early.
FrameStream: TypeAlias = Generator[Frame, None, None]


class FrameSource(Protocol):
    """Frames of one video, in bounded memory: every call decodes again what it needs."""

    @property
    def info(self) -> VideoInfo: ...

    def frames(self, size: tuple[int, int] | None = None, start: int = 0, stop: int | None = None) -> FrameStream:
        """Frames [start, stop) in order, area-resized to `size` = (width, height) if given.

        Raises:
            InputError, DecodeError: typed, naming the input. Closing the iterator early kills the decoder.
        """
