"""An object, or a part of one, as a seekable file for libraries that want files."""

from __future__ import annotations

import io
from typing import BinaryIO, cast

from services.domain.errors import ObjectMissing
from services.storage.base import ObjectStore


class _Window(io.RawIOBase):
    def __init__(self, store: ObjectStore, key: str, start: int, length: int) -> None:
        self._store, self._key, self._start, self._length = store, key, start, length
        self._position = 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        base = {io.SEEK_SET: 0, io.SEEK_CUR: self._position, io.SEEK_END: self._length}[whence]
        if base + offset < 0:
            raise ValueError("cannot seek before the start")
        self._position = base + offset
        return self._position

    def tell(self) -> int:
        return self._position

    def readinto(self, buffer: object) -> int:
        target = memoryview(cast(bytearray, buffer)).cast("B")
        wanted = min(len(target), self._length - self._position)
        if wanted <= 0:
            return 0
        data = self._store.get_bytes(self._key, self._start + self._position, wanted)
        target[: len(data)] = data
        self._position += len(data)
        return len(data)


def open_object(
    store: ObjectStore, key: str, start: int = 0, length: int | None = None, *, buffer_bytes: int = 1 << 20
) -> BinaryIO:
    """Open an object for reading by range requests of about `buffer_bytes`; nothing is read yet.

    Args:
        start: First byte of the part to show.
        length: Its size; None for the rest of the object.

    Raises:
        ObjectMissing: No such object (only noticed here where `length` is None).
    """
    if length is None:
        info = store.head(key)
        if info is None:
            raise ObjectMissing(f"{store.uri}/{key} does not exist")
        length = max(0, info.size_bytes - start)
    return cast(BinaryIO, io.BufferedReader(_Window(store, key, start, length), buffer_bytes))
