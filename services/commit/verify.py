"""Reopen what was written, and take nothing on trust."""

from __future__ import annotations

import hashlib
import tarfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from services.commit.layout import MEMBERS
from services.commit.tar_reader import check_member
from services.commit.tar_writer import WrittenTar
from services.domain.errors import IntegrityError
from services.domain.models import Attribute

Members = dict[str, dict[str, tuple[int, int]]]


def sha256_of(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def index_tar(path: Path) -> Members:
    """Sample key -> member name -> (offset, size) of the data, in tar order, by webdataset's own rule for keys.

    Raises:
        IntegrityError: Not a tar, cut short, a member that is no plain file, a name without a webdataset key, a name
            that occurs twice, or members of one sample that do not lie together.
    """
    index: Members = {}
    current: str | None = None
    size_bytes = path.stat().st_size
    try:
        with tarfile.open(path, "r:") as tar:
            for info in tar:
                key, _ = check_member(info, path.name)
                if info.offset_data + info.size > size_bytes:
                    raise IntegrityError(f"{path.name} is cut short in {info.name}")
                if key != current and key in index:
                    raise IntegrityError(f"{path.name} holds sample {key} in two places")
                files = index.setdefault(key, {})
                if info.name in files:
                    raise IntegrityError(f"{path.name} holds {info.name} twice")
                files[info.name] = (info.offset_data, info.size)
                current = key
    except (tarfile.TarError, EOFError, ValueError, OverflowError, RecursionError) as error:
        raise IntegrityError(f"{path.name} is not a readable tar: {error}") from error
    return index


def verify_tar(tar: WrittenTar, attribute: Attribute, keys: Sequence[str]) -> Members:
    """Read a tar back from the disk and compare it with what was meant to be in it.

    Returns:
        Its index, see `index_tar`.

    Raises:
        IntegrityError: Other bytes than were written, other keys or another order, or members that do not belong.
    """
    if tar.path.stat().st_size != tar.size_bytes or sha256_of(tar.path) != tar.sha256:
        raise IntegrityError(f"{tar.path.name} does not hold the bytes that were written; check the scratch disk")
    index = index_tar(tar.path)
    check_keys({attribute: index}, keys)
    check_members(attribute, index)
    return index


def check_keys(indexes: Mapping[Attribute, Iterable[str]], keys: Sequence[str]) -> None:
    """Every attribute holds exactly `keys`, in this order, so that the tars can be read side by side."""
    for attribute, found in indexes.items():
        if list(found) != list(keys):
            raise IntegrityError(f"the samples of {attribute}.tar differ from those of the shard, or in their order")


def check_members(attribute: Attribute, index: Members) -> None:
    """Every sample holds the members of its attribute and no others."""
    allowed = {m.extension for m in MEMBERS[attribute]}
    needed = {m.extension for m in MEMBERS[attribute] if not m.optional}
    for key, files in index.items():
        extensions = {name[len(key) + 1 :] for name in files}
        if not needed <= extensions <= allowed:
            raise IntegrityError(f"sample {key} of {attribute}.tar holds {sorted(files)}")
