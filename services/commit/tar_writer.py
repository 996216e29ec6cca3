"""The webdataset writer, made crash-safe and reproducible."""

from __future__ import annotations

import hashlib
import logging
import os
import tarfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from webdataset import TarWriter

logger = logging.getLogger(__name__)

_OWNER = "vipe"


@dataclass(frozen=True, slots=True)
class WrittenTar:
    """What went to the disk, for comparison with what is read back."""

    path: Path
    size_bytes: int
    sha256: str


class _Sink:
    """Passes bytes on, hashing them. After `abandon` it swallows them, so that closing a broken tar adds no trailer."""

    def __init__(self, file: BinaryIO) -> None:
        self._file: BinaryIO | None = file
        self.hash = hashlib.sha256()
        self.size_bytes = 0

    def write(self, data: bytes) -> int:
        if self._file is not None:
            self._file.write(data)
            self.hash.update(data)
            self.size_bytes += len(data)
        return len(data)

    def abandon(self) -> None:
        self._file = None


class _FileTarWriter(TarWriter):  # type: ignore[misc]  # webdataset has no types
    """A webdataset writer that takes members as files.

    The original takes bytes; the depth of an hour of video does not fit into memory. Headers are what the original
    writes (a test compares the bytes), except that a member above 8 GiB gets the extended header that it needs.
    """

    def __init__(self, sink: _Sink) -> None:
        # An integer mtime: a float would add an extended header to every member.
        super().__init__(sink, user=_OWNER, group=_OWNER, mode=0o444, mtime=0, encoder=False, format="PAX_FORMAT")

    def write_member(self, name: str, path: Path) -> None:
        with path.open("rb") as file:
            info = tarfile.TarInfo(name)
            info.size = os.fstat(file.fileno()).st_size
            info.mtime, info.mode, info.uname, info.gname = self.mtime, self.mode, self.user, self.group
            self.tarstream.addfile(info, file)  # OSError if the file is shorter than it was a moment ago


def write_tar(path: Path, samples: Iterable[Sequence[tuple[str, Path]]]) -> WrittenTar:
    """Write samples, each a list of (member name, file), to a new tar.

    The tar takes its name only when it is complete and flushed; on any error nothing is left. The same files in the
    same order give the same bytes.

    Raises:
        FileExistsError: `path` is taken.
        OSError: A file cannot be read, or the disk is full.
    """
    if path.exists():
        raise FileExistsError(f"{path} exists already")
    partial = path.with_name(f".{path.name}.partial")
    try:
        with partial.open("wb") as file:
            sink = _Sink(file)
            writer = _FileTarWriter(sink)
            try:
                for members in samples:
                    for name, source in members:
                        writer.write_member(name, source)
            except BaseException:
                sink.abandon()
                raise
            finally:
                writer.close()
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise
    return WrittenTar(path, sink.size_bytes, sink.hash.hexdigest())
