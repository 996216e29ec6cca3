"""From shards to the directory layout that nvidia-vipe's own tools read."""

from __future__ import annotations

import shutil
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Literal

from services.commit.layout import ATTRIBUTES, MEMBERS, payload_key
from services.commit.tar_reader import read_members, split_name
from services.dataset.index import DatasetIndex
from services.dataset.reader import member_ranges
from services.domain.errors import IntegrityError, ObjectMissing
from services.domain.models import Attribute
from services.storage.base import ObjectStore
from services.storage.object_file import open_object
from services.storage.open import open_store
from vipe_core.formats.atomic import complete_file
from vipe_core.video.naming import sanitise_name

_READ_AHEAD_BYTES = 8 << 20

Names = Literal["key", "stem"]


@dataclass(frozen=True, slots=True)
class Unpacked:
    """What was written: sequence key -> name on disk, files and bytes."""

    names: dict[str, str]
    files: int
    size_bytes: int


def unpack(
    source: ObjectStore | str,
    dest: Path,
    keys: Collection[str] | None = None,
    *,
    attributes: Sequence[Attribute] | None = None,
    names: Names = "key",
) -> Unpacked:
    """Write `pose/S.npz`, `intrinsics/S.npz` and `S_camera.txt`, `depth/S.zip`, `rgb/S.mp4` and `vipe/S_info.json`.

    Every file appears complete or not at all; files that are there are replaced, so running it again is harmless. With
    `keys`, only their ranges of the tars are read.

    Args:
        source: The output, or its address.
        keys: Sequences to unpack; None for all.
        attributes: None for all that are there.
        names: S is the `key`, or the `stem` of the input's file name where no other video of the data set has it.

    Raises:
        ObjectMissing: Not finalised, or one of `keys` does not exist.
        IntegrityError: A tar holds a member that does not belong there, such as one with a path.
    """
    store = open_store(source) if isinstance(source, str) else source
    wanted = None if keys is None else set(keys)
    with DatasetIndex(store) as index:
        chosen = _names(index, wanted, names)
        if wanted is not None and (unknown := sorted(wanted - set(chosen))):
            raise ObjectMissing(f"{store.uri} holds no sequence {unknown[0]!r}")
        target = _Target(dest, chosen)
        for tar_name, rows in index.shards():
            present = _present(store, tar_name, attributes)
            picked = {key: row for key, row in rows.items() if wanted is None or key in wanted}
            if not picked:
                continue
            if wanted is not None and all(member_ranges(row, present) for row in picked.values()):
                for key, row in picked.items():
                    for attribute, extension, offset, size in member_ranges(row, present):
                        source_key = payload_key(tar_name, attribute)
                        with open_object(store, source_key, offset, size, buffer_bytes=_READ_AHEAD_BYTES) as file:
                            target.write(attribute, f"{key}.{extension}", file, size)
            else:
                for attribute in present:
                    _unpack_tar(store, payload_key(tar_name, attribute), attribute, set(picked), target)
    return Unpacked(chosen, target.files, target.size_bytes)


class _Target:
    """Writes members under their names on disk."""

    def __init__(self, dest: Path, names: dict[str, str]) -> None:
        self._dest, self._names = dest, names
        self.files = 0
        self.size_bytes = 0

    def write(self, attribute: Attribute, member: str, data: BinaryIO, size: int) -> None:
        path = self._path(attribute, member)
        with complete_file(path) as partial:
            with partial.open("wb") as out:
                shutil.copyfileobj(data, out, 1 << 20)
            if partial.stat().st_size != size:
                raise IntegrityError(f"{attribute}.tar ends inside {member}")
        self.files += 1
        self.size_bytes += size

    def _path(self, attribute: Attribute, name: str) -> Path:
        key, extension = split_name(name, f"{attribute}.tar")
        for member in MEMBERS[attribute]:
            if member.extension == extension:
                return member.path(self._dest, self._names[key])
        raise IntegrityError(f"{attribute}.tar holds {name!r}, which does not belong there")


def _unpack_tar(store: ObjectStore, key: str, attribute: Attribute, keys: set[str], target: _Target) -> None:
    found: set[str] = set()
    with open_object(store, key, buffer_bytes=_READ_AHEAD_BYTES) as file:
        for info, sample, _, data in read_members(file, key):
            if sample in keys:
                target.write(attribute, info.name, data, info.size)
                found.add(sample)
    if missing := sorted(keys - found):
        raise IntegrityError(f"{key} does not hold {missing[0]}, although the index says so")


def _present(store: ObjectStore, tar_name: str, wanted: Sequence[Attribute] | None) -> tuple[Attribute, ...]:
    found = {info.key for info in store.list(f"payload/{tar_name}/")}
    present = tuple(a for a in ATTRIBUTES if payload_key(tar_name, a) in found)
    if not present:
        raise ObjectMissing(f"{store.uri} has no tars of {tar_name}, although the index names it")
    if wanted is None:
        return present
    if missing := sorted(set(wanted) - set(present)):
        raise ObjectMissing(f"{store.uri}/{tar_name} has no {missing[0]}.tar")
    return tuple(a for a in present if a in wanted)


def _names(index: DatasetIndex, wanted: set[str] | None, names: Names) -> dict[str, str]:
    """Key -> name on disk. Whether a stem is free depends on the whole data set, not on what is unpacked now."""
    if names == "key" or "uri" not in index.columns:
        keys = (str(row["sequence"]) for row in index.rows(["sequence"]))
        chosen = {key: key for key in keys}
    else:
        stems = {str(row["sequence"]): _stem(str(row["uri"])) for row in index.rows(["sequence", "uri"])}
        users: dict[str, int] = {}
        for stem in stems.values():
            users[stem.lower()] = users.get(stem.lower(), 0) + 1
        lower_keys = {key.lower() for key in stems}
        chosen = {
            key: stem if users[stem.lower()] == 1 and (stem == key or stem.lower() not in lower_keys) else key
            for key, stem in stems.items()
        }
    for key in chosen:
        if sanitise_name(key) != key:
            raise IntegrityError(f"the index names a sequence {key!r}, which is not safe in paths")
    return {key: name for key, name in chosen.items() if wanted is None or key in wanted}


def _stem(uri: str) -> str:
    return sanitise_name(uri.rstrip("/").rsplit("/", 1)[-1].rsplit(".", 1)[0])
