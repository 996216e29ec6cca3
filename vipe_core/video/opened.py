"""Opening a file once, and judging what was opened instead of its name: names can change between two looks."""

from __future__ import annotations

import io
import os
import stat
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from vipe_core.errors import MediaNotFound, UnsupportedMedia
from vipe_core.video.limits import Limits


@dataclass(frozen=True, slots=True)
class OpenedMedia:
    """A regular file that is open for reading.

    Attributes:
        label: Its name, for messages.
    """

    file: BinaryIO
    label: str


def open_media(path: str, limits: Limits, *, inside: str | None = None) -> OpenedMedia:
    """Open a file without waiting for anybody, as a pipe or a device would have us do.

    Args:
        inside: The directory in or below which the file must lie, links resolved; None for anywhere.

    Raises:
        MediaNotFound: No such file, no permission to read it, or a link that leads out of `inside`.
        UnsupportedMedia: A pipe, a device, a socket or a directory.
        MediaTooLarge: More bytes than `limits` allows.
    """
    label = Path(path).name
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
    except (OSError, ValueError) as error:
        raise not_found(label, error) from error
    try:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            raise UnsupportedMedia(f"{label}: not a regular file; provide a video file or a directory of images")
        limits.check_file(label, status.st_size)
        if inside is not None and not opened_path(path, descriptor).is_relative_to(os.path.realpath(inside)):
            raise MediaNotFound(f"{label}: the name is a link that leads out of its directory; check the path")
    except BaseException:
        os.close(descriptor)
        raise
    # A reader that knows the name of the file; `os.fdopen` would know a number.
    raw = io.FileIO(path, opener=lambda *_: descriptor)
    return OpenedMedia(io.BufferedReader(raw), label)


def opened_path(path: str | Path, descriptor: int) -> Path:
    """Where an open file or directory lies in truth. Where the system cannot tell: where its name leads now."""
    link = Path(f"/proc/self/fd/{descriptor}")
    return link.readlink() if link.is_symlink() else Path(os.path.realpath(path))


def not_found(label: str, error: OSError | ValueError) -> MediaNotFound:
    reason = (error.strerror if isinstance(error, OSError) else None) or "cannot be opened"
    return MediaNotFound(f"{label}: {reason}; check the path")
