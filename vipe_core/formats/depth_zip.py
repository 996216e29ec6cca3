"""A clip's depth maps in one zip: members `%05d.exr`, DEFLATE, fixed dates, readable one by one."""

from __future__ import annotations

import re
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from vipe_core.errors import FormatError
from vipe_core.formats.exr import decode_depth, encode_depth

_MEMBER = re.compile(r"(\d{5,})\.exr")
_EPOCH = (1980, 1, 1, 0, 0, 0)
_UNIX = 3
_FILE_MODE = 0o100644
# EXR members are compressed already: the method is DEFLATE for the format's sake, at the least effort.
_DEFLATE_LEVEL = 1
_MAX_MEMBER_BYTES = 1 << 30


def member_name(index: int) -> str:
    return f"{index:05d}.exr"


def member_info(name: str) -> zipfile.ZipInfo:
    """A DEFLATE member whose header depends on its name only."""
    info = zipfile.ZipInfo(name, _EPOCH)
    info.compress_type = zipfile.ZIP_DEFLATED
    info.create_system = _UNIX
    info.external_attr = _FILE_MODE << 16
    return info


class DepthZipWriter:
    """Appends depth maps in frame order; same maps, same bytes. Use as a context manager.

    Args:
        path: File to write. Callers that need it to appear complete write to a temporary name and rename.
    """

    def __init__(self, path: str | Path) -> None:
        self._zip = zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED)
        self._count = 0

    def __enter__(self) -> DepthZipWriter:
        return self

    def __exit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def append(self, depth: NDArray[np.floating]) -> None:
        """Add the (H, W) depth map of the next frame; see `encode_depth` for what becomes of odd values."""
        info = member_info(member_name(self._count))
        self._zip.writestr(info, encode_depth(depth), compresslevel=_DEFLATE_LEVEL)
        self._count += 1

    def close(self) -> None:
        self._zip.close()


class DepthZipReader:
    """Random access to the depth maps of one zip. Use as a context manager.

    Raises:
        FormatError: Not a zip, or its members are not consecutive depth maps from 0 on.
    """

    def __init__(self, path: str | Path) -> None:
        self._path = Path(path)
        try:
            self._zip = zipfile.ZipFile(path)
        except FileNotFoundError as error:
            raise FormatError(f"{self._path.name}: no such depth archive") from error
        except (OSError, zipfile.BadZipFile) as error:
            raise FormatError(f"{self._path.name}: not a readable zip; write the artifact again") from error
        try:
            self._members = self._checked_members()
        except FormatError:
            self._zip.close()
            raise

    def __enter__(self) -> DepthZipReader:
        return self

    def __exit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def __len__(self) -> int:
        return len(self._members)

    def __iter__(self) -> Iterator[NDArray[np.float32]]:
        for index in range(len(self)):
            yield self.read(index)

    def close(self) -> None:
        self._zip.close()

    def read(self, index: int) -> NDArray[np.float32]:
        """(H, W) float32 depth of frame `index`; 0 where there is no value.

        Raises:
            IndexError: No such frame.
            FormatError: The member is damaged.
        """
        if not 0 <= index < len(self._members):
            raise IndexError(f"{self._path.name}: frame {index} of {len(self._members)}")
        member = self._members[index]
        label = f"{self._path.name}:{member.filename}"
        if member.file_size > _MAX_MEMBER_BYTES:
            raise FormatError(f"{label}: {member.file_size} bytes are no depth map")
        try:
            data = self._zip.read(member)
        except (zipfile.BadZipFile, zlib.error, OSError, EOFError, ValueError, RuntimeError) as error:
            raise FormatError(f"{label}: the member is damaged; write the artifact again") from error
        return decode_depth(data, label)

    def _checked_members(self) -> list[zipfile.ZipInfo]:
        by_index: dict[int, zipfile.ZipInfo] = {}
        for member in self._zip.infolist():
            match = _MEMBER.fullmatch(member.filename)
            if match is None:
                raise FormatError(f"{self._path.name}: member {member.filename!r} is not named like 00000.exr")
            by_index[int(match[1])] = member
        if sorted(by_index) != list(range(len(by_index))):
            raise FormatError(f"{self._path.name}: depth maps are missing; {len(by_index)} members are not 0, 1, 2 ...")
        return [by_index[index] for index in range(len(by_index))]
