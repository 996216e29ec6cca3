"""Videos that lie in tars, as webdataset keeps them, each with an address of its own.

    s3://bucket/clips-000.tar!/indoor/a.mp4#1536

names member `indoor/a.mp4` whose contents begin at byte 1536 of the tar, so that a worker reads that part alone. The
number may be left out, in a list that somebody wrote by hand, say; then the tar is searched from its beginning.
"""

from __future__ import annotations

import tarfile
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, BinaryIO

from services.domain.errors import InputUnavailable

_MARK = ".tar!/"
# A header is read, then the contents are passed over: a large buffer would fetch them after all.
HEADER_BUFFER_BYTES = 16 << 10
_UNREADABLE = (tarfile.TarError, EOFError, ValueError, OverflowError, RecursionError)


@dataclass(frozen=True, slots=True)
class Member:
    """A file in a tar.

    Attributes:
        tar: Address of the tar.
        name: Of the member.
        start: First byte of its contents in the tar; None if it is not known.
    """

    tar: str
    name: str
    start: int | None = None

    @property
    def uri(self) -> str:
        return f"{self.tar}!/{self.name}" + ("" if self.start is None else f"#{self.start}")


def is_tar(uri: str) -> bool:
    return uri.endswith(".tar")


def as_member(uri: str) -> Member | None:
    """The member that an address names; None if it names something else."""
    head, mark, rest = uri.partition(_MARK)
    if not mark:
        return None
    name, hash_sign, number = rest.rpartition("#")
    if hash_sign and number.isascii() and number.isdigit():
        return Member(f"{head}.tar", name, int(number))
    return Member(f"{head}.tar", rest)


def list_members(file: BinaryIO, tar: str) -> Iterator[tuple[Member, int]]:
    """The plain files of an uncompressed tar with their sizes, in order, by reading its headers only.

    Args:
        file: The tar, seekable.
        tar: Its address.

    Raises:
        InputUnavailable: Not a tar, cut short, or with a name or a size that no honest tar has.
    """
    try:
        with tarfile.open(fileobj=file, mode="r:") as opened:
            reader: Any = opened
            while (info := reader.next()) is not None:
                reader.members.clear()  # A list of all that were read: the tar may hold millions.
                if info.type not in (tarfile.REGTYPE, tarfile.AREGTYPE) or info.sparse is not None:
                    continue  # Folders are usual; links, devices and files with holes are no videos.
                if not info.name.isprintable() or info.size < 0:
                    raise InputUnavailable(f"{tar} holds a member with the impossible name or size {info.name[:200]!a}")
                yield Member(tar, info.name, info.offset_data), info.size
            # tarfile takes whatever is no header for the end.
            file.seek(reader.offset)
            if file.read(tarfile.BLOCKSIZE) not in (b"", bytes(tarfile.BLOCKSIZE)):
                raise tarfile.ReadError("it is damaged or cut short")
    except _UNREADABLE as error:
        reason = next(iter(str(error).splitlines()), type(error).__name__)
        raise InputUnavailable(f"{tar} is not a readable tar: {reason}; compressed tars are not read") from error


def find_member(file: BinaryIO, member: Member) -> tuple[int, int]:
    """(first byte, size) of a member that was named without its place.

    Raises:
        InputUnavailable: There is none of this name, or the tar is not readable.
    """
    for found, size_bytes in list_members(file, member.tar):
        if found.name == member.name and found.start is not None:
            return found.start, size_bytes
    raise InputUnavailable(f"there is no {member.name} in {member.tar}")
