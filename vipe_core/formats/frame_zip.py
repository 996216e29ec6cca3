"""A zip with one picture per frame: members `%05d.SUFFIX`, DEFLATE, fixed dates, readable one by one."""

from __future__ import annotations

import lzma
import re
import zipfile
import zlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import IO, Any, ClassVar, Generic, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from vipe_core.errors import FormatError

Pixel = TypeVar("Pixel", bound=np.generic)

_EPOCH = (1980, 1, 1, 0, 0, 0)
_UNIX = 3
_FILE_MODE = 0o100644
# The members are compressed already: the method is DEFLATE for the format's sake, at the least effort.
_DEFLATE_LEVEL = 1


class _FrameZip:
    """An open archive that closes itself."""

    _zip: zipfile.ZipFile

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        self._zip.close()


class FrameZipWriter(_FrameZip, ABC):
    """Appends pictures in frame order; same pictures, same bytes. Use as a context manager.

    Args:
        path: File to write. Callers that need it to appear complete write to a temporary name and rename.

    Attributes:
        suffix: Of the members' names, without the dot.
    """

    suffix: ClassVar[str]

    def __init__(self, path: str | Path) -> None:
        self._zip = zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED)
        self._count = 0

    def append(self, picture: NDArray[Any]) -> None:
        """Add the (H, W) picture of the next frame."""
        info = zipfile.ZipInfo(f"{self._count:05d}.{self.suffix}", _EPOCH)
        info.compress_type = zipfile.ZIP_DEFLATED
        info.create_system = _UNIX
        info.external_attr = _FILE_MODE << 16
        self._zip.writestr(info, self._encoded(picture), compresslevel=_DEFLATE_LEVEL)
        self._count += 1

    @abstractmethod
    def _encoded(self, picture: NDArray[Any]) -> bytes:
        """The member."""


class FrameZipReader(_FrameZip, ABC, Generic[Pixel]):
    """Random access to the pictures of one zip. Use as a context manager.

    Attributes:
        suffix: Of the members' names, without the dot.
        kind: What messages call a picture.
        max_bytes: A larger member is refused before it is unpacked.
        resample: What every picture goes through once it is read; None leaves it as it is.

    Raises:
        FormatError: Not a zip, or its members are not consecutive pictures from 0 on.
    """

    suffix: ClassVar[str]
    kind: ClassVar[str]
    max_bytes: ClassVar[int]

    def __init__(self, source: str | Path | IO[bytes], label: str | None = None) -> None:
        """Open a file, or bytes that messages call `label`."""
        self.resample: Callable[[NDArray[Pixel]], NDArray[Pixel]] | None = None
        self._name = label or (Path(source).name if isinstance(source, (str, Path)) else "archive")
        try:
            self._zip = zipfile.ZipFile(source)
        except FileNotFoundError as error:
            raise FormatError(f"{self._name}: no such archive of {self.kind}s") from error
        except (OSError, zipfile.BadZipFile, ValueError, NotImplementedError, EOFError) as error:
            raise FormatError(f"{self._name}: not a readable zip; write the artifact again") from error
        try:
            self._members = self._checked_members()
        except FormatError:
            self._zip.close()
            raise

    def __len__(self) -> int:
        return len(self._members)

    def keep(self, frames: range) -> None:
        """Read these frames only, numbered from 0 again."""
        self._members = [self._members[index] for index in frames]

    def __iter__(self) -> Iterator[NDArray[Pixel]]:
        for index in range(len(self)):
            yield self.read(index)

    def read(self, index: int) -> NDArray[Pixel]:
        """The (H, W) picture of frame `index`.

        Raises:
            IndexError: No such frame.
            FormatError: The member is damaged.
        """
        if not 0 <= index < len(self._members):
            raise IndexError(f"{self._name}: frame {index} of {len(self._members)}")
        member = self._members[index]
        label = f"{self._name}:{member.filename}"
        if member.file_size > self.max_bytes:
            raise FormatError(f"{label}: {member.file_size} bytes are no {self.kind}")
        try:
            data = self._zip.read(member)
        except (zipfile.BadZipFile, zlib.error, OSError, EOFError, ValueError, RuntimeError, lzma.LZMAError) as error:
            raise FormatError(f"{label}: the member is damaged; write the artifact again") from error
        picture = self._decoded(data, label)
        return picture if self.resample is None else self.resample(picture)

    @abstractmethod
    def _decoded(self, data: bytes, label: str) -> NDArray[Pixel]:
        """The picture of a member that messages call `label`; raises FormatError when it is none."""

    def _checked_members(self) -> list[zipfile.ZipInfo]:
        named = re.compile(rf"(\d{{5,}})\.{self.suffix}")
        by_index: dict[int, zipfile.ZipInfo] = {}
        for member in self._zip.infolist():
            match = named.fullmatch(member.filename)
            if match is None:
                raise FormatError(f"{self._name}: member {member.filename!r} is not named like 00000.{self.suffix}")
            by_index[int(match[1])] = member
        if sorted(by_index) != list(range(len(by_index))):
            raise FormatError(f"{self._name}: {self.kind}s are missing; {len(by_index)} members are not 0, 1, 2 ...")
        return [by_index[index] for index in range(len(by_index))]
