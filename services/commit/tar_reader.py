"""Reading tars that may mean harm: plain files with plain names and honest sizes, or an error that names the member."""

from __future__ import annotations

import tarfile
from collections.abc import Iterator
from typing import BinaryIO, cast

from webdataset.tariterators import base_plus_ext

from services.domain.errors import IntegrityError

# A member is the depth of one video at most.
MAX_MEMBER_BYTES = 1 << 38
_UNREADABLE = (tarfile.TarError, EOFError, ValueError, OverflowError, RecursionError)


def read_members(file: BinaryIO, where: str) -> Iterator[tuple[tarfile.TarInfo, str, str, BinaryIO]]:
    """(header, webdataset key, extension, contents) of each member, front to back; contents while it is their turn.

    Only uncompressed tars: what is in ours is compressed already, and a compressed tar can be a bomb.

    Args:
        file: The tar; read in order, never sought.
        where: Name of the tar, for messages.

    Raises:
        IntegrityError: Not a tar, cut short, or a member that `check_member` refuses.
    """
    try:
        with tarfile.open(fileobj=file, mode="r|") as tar:
            for info in tar:
                key, extension = check_member(info, where)
                yield info, key, extension, cast(BinaryIO, _Contents(tar, info, where))
    except _UNREADABLE as error:
        raise _unreadable(where, error) from error


class _Contents:
    """The contents of a member, front to back."""

    def __init__(self, tar: tarfile.TarFile, info: tarfile.TarInfo, where: str) -> None:
        self._file, self._where = cast(BinaryIO, tar.extractfile(info)), where

    def read(self, size: int = -1) -> bytes:
        try:
            return self._file.read(size)
        except _UNREADABLE as error:
            raise _unreadable(self._where, error) from error


def _unreadable(where: str, error: Exception) -> IntegrityError:
    return IntegrityError(f"{where} is not a readable tar: {next(iter(str(error).splitlines()), type(error).__name__)}")


def check_member(info: tarfile.TarInfo, where: str) -> tuple[str, str]:
    """(key, extension) of a member, by webdataset's rule.

    Raises:
        IntegrityError: A link, a device, a folder, a file with holes (a few bytes can claim any size), a name with a
            folder or without a key, or an absurd size.
    """
    if info.type not in (tarfile.REGTYPE, tarfile.AREGTYPE) or info.sparse is not None:
        raise IntegrityError(f"{where} holds {info.name!r}, which is not a plain file")
    if not 0 <= info.size <= MAX_MEMBER_BYTES:
        raise IntegrityError(f"{where} holds {info.name!r} of {info.size} bytes")
    return split_name(info.name, where)


def split_name(name: str, where: str) -> tuple[str, str]:
    """(key, extension) of a member's name.

    Raises:
        IntegrityError: A name with a folder, or none that webdataset takes.
    """
    key, extension = base_plus_ext(name)
    if not key or not extension or "/" in name or "\\" in name or not name.isprintable():
        raise IntegrityError(f"{where} holds {name!r}, which is not a member of a sample")
    return key, extension
