"""A clip's masks in one zip: members `%05d.png`, 8-bit instance ids, DEFLATE, fixed dates, readable one by one."""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType

import cv2
import numpy as np
from numpy.typing import NDArray

from vipe_core.errors import FormatError
from vipe_core.formats.depth_zip import member_info

_MAX_MEMBER_BYTES = 1 << 28
# A PNG is compressed already.
_DEFLATE_LEVEL = 1


class MaskZipWriter:
    """Appends masks in frame order; same masks, same bytes. Use as a context manager.

    Args:
        path: File to write. Callers that need it to appear complete write to a temporary name and rename.
    """

    def __init__(self, path: str | Path) -> None:
        self._zip = zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED)
        self._count = 0

    def __enter__(self) -> MaskZipWriter:
        return self

    def __exit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def append(self, mask: NDArray[np.uint8]) -> None:
        """Add the (H, W) instance ids of the next frame."""
        _, data = cv2.imencode(".png", mask, [cv2.IMWRITE_PNG_COMPRESSION, 3])
        info = member_info(f"{self._count:05d}.png")
        self._zip.writestr(info, data.tobytes(), compresslevel=_DEFLATE_LEVEL)
        self._count += 1

    def close(self) -> None:
        self._zip.close()


class MaskZipReader:
    """Random access to the masks of one zip. Use as a context manager.

    Raises:
        FormatError: Not a zip, or its members are not consecutive masks from 0 on.
    """

    def __init__(self, path: str | Path) -> None:
        self._name = Path(path).name
        try:
            self._zip = zipfile.ZipFile(path)
        except FileNotFoundError as error:
            raise FormatError(f"{self._name}: no such mask archive") from error
        except (OSError, zipfile.BadZipFile) as error:
            raise FormatError(f"{self._name}: not a readable zip; write the artifact again") from error
        members = self._zip.infolist()
        if [member.filename for member in members] != [f"{index:05d}.png" for index in range(len(members))]:
            self._zip.close()
            raise FormatError(f"{self._name}: its members are not 00000.png, 00001.png, ...")
        self._members = members

    def __enter__(self) -> MaskZipReader:
        return self

    def __exit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def __len__(self) -> int:
        return len(self._members)

    def __iter__(self) -> Iterator[NDArray[np.uint8]]:
        for index in range(len(self)):
            yield self.read(index)

    def close(self) -> None:
        self._zip.close()

    def read(self, index: int) -> NDArray[np.uint8]:
        """(H, W) uint8 instance ids of frame `index`; 0 is background.

        Raises:
            IndexError: No such frame.
            FormatError: The member is damaged.
        """
        if not 0 <= index < len(self._members):
            raise IndexError(f"{self._name}: frame {index} of {len(self._members)}")
        member = self._members[index]
        label = f"{self._name}:{member.filename}"
        if member.file_size > _MAX_MEMBER_BYTES:
            raise FormatError(f"{label}: {member.file_size} bytes are no mask")
        try:
            data = self._zip.read(member)
        except (zipfile.BadZipFile, zlib.error, OSError, EOFError, ValueError, RuntimeError) as error:
            raise FormatError(f"{label}: the member is damaged; write the artifact again") from error
        mask = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_UNCHANGED) if data else None
        if mask is None or mask.dtype != np.uint8 or mask.ndim != 2:
            raise FormatError(f"{label}: not an 8-bit picture of one channel")
        return np.asarray(mask, dtype=np.uint8)
