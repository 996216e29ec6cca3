"""One way in: a path becomes a frame source."""

from __future__ import annotations

from pathlib import Path

from vipe_core.video.image_directory import ImageDirectorySource
from vipe_core.video.limits import Limits
from vipe_core.video.probe import is_directory
from vipe_core.video.source import FrameSource
from vipe_core.video.video_file import VideoFileSource


def open_source(path: str | Path, *, limits: Limits | None = None, name: str | None = None) -> FrameSource:
    """Frames of a video file or of a directory of images (in plain order of names).

    Args:
        path: File or directory.
        limits: Bounds on picture size and length; the defaults of `Limits` if None.
        name: Name of the sequence; the sanitised stem if None.

    Raises:
        InputError: MediaNotFound, EmptyMedia, CorruptMedia, NoVideoStream, UnsupportedMedia or MediaTooLarge.
        DecodeTimeout, DecodeCrashed: The decoder process hangs or died.
    """
    if is_directory(Path(path)):
        return ImageDirectorySource(path, limits=limits, name=name)
    return VideoFileSource(path, limits=limits, name=name)
