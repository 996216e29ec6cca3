"""Samples of a data set, their attributes joined: in order for training, or one by its name."""

from __future__ import annotations

import io
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray
from webdataset.tariterators import group_by_keys

from services.commit.layout import ATTRIBUTES, MEMBERS, REQUIRED, payload_key
from services.commit.tar_reader import read_members
from services.dataset.index import DatasetIndex, Row
from services.dataset.schema import member_column
from services.domain.errors import IntegrityError, ObjectMissing
from services.domain.models import Attribute
from services.storage.base import ObjectStore
from services.storage.object_file import open_object
from services.storage.open import open_store
from vipe_core.annotation import DepthKind
from vipe_core.cameras import Camera
from vipe_core.errors import FormatError
from vipe_core.formats import DepthZipReader, read_artifacts

_READ_AHEAD_BYTES = 8 << 20

Files = dict[Attribute, dict[str, bytes]]


@dataclass(frozen=True, slots=True)
class Sample:
    """One video of a data set.

    Attributes:
        key: The sequence.
        world_from_cam: (N, 4, 4) float64, OpenCV axes.
        camera: At the resolution of depth and rgb.
        depth_kind: What the values of `depth` are.
        timestamps_s: (N,) float64, None in data sets of other origin.
        info: The engine's description (quality, provenance, keyframes); empty in data sets of other origin.
        row: Its row of the index.
        files: Attribute -> extension -> bytes, as they lie in the tars.
    """

    key: str
    world_from_cam: NDArray[np.float64]
    camera: Camera
    depth_kind: DepthKind
    timestamps_s: NDArray[np.float64] | None
    info: dict[str, Any]
    row: Row
    files: Files

    @property
    def num_frames(self) -> int:
        return len(self.world_from_cam)

    @property
    def rgb_mp4(self) -> bytes | None:
        """The video file, None if rgb was not read."""
        return self.files.get("rgb", {}).get("mp4")

    def depth(self) -> Iterator[NDArray[np.float32]]:
        """(H, W) float32 depth of every frame in order, 0 where there is no value.

        Raises:
            FormatError: Depth was not read, or its archive is damaged.
        """
        data = self.files.get("depth", {}).get("zip")
        if data is None:
            raise FormatError(f"{self.key}: its depth was not read; ask for the attribute `depth`")
        with DepthZipReader(io.BytesIO(data), label=f"{self.key}.zip") as archive:
            if len(archive) != self.num_frames:
                raise FormatError(f"{self.key}.zip: {len(archive)} depth maps for {self.num_frames} poses")
            yield from archive


def iterate(source: ObjectStore | str, attributes: Sequence[Attribute] | None = None) -> Iterator[Sample]:
    """All samples, in the order of the index's tars; the tars of a shard are read side by side, front to back.

    Holds one sample at a time, as bytes; for very long videos `read_one` with fewer attributes needs less.

    Args:
        source: The output, or its address.
        attributes: What to read on top of poses and intrinsics; None for all that the data set has.

    Raises:
        ObjectMissing: Not finalised, or a tar is missing.
        IntegrityError: Tars of a shard do not hold the same samples in the same order as each other, or not those of
            the index.
    """
    store = open_store(source) if isinstance(source, str) else source
    with DatasetIndex(store) as index:
        for tar_name, rows in index.shards():
            wanted = _present(store, tar_name, attributes)
            seen = 0
            for key, files in _lockstep(store, tar_name, wanted):
                row = rows.get(key)
                if row is None:
                    raise IntegrityError(f"{tar_name} holds sample {key}, which the index does not know")
                seen += 1
                yield _sample(key, files, row)
            if seen != len(rows):
                raise IntegrityError(f"{tar_name} holds {seen} of the {len(rows)} samples of the index")


def read_one(source: ObjectStore | str, key: str, attributes: Sequence[Attribute] | None = None) -> Sample:
    """One sample by range requests, without the rest of its tars.

    Args:
        source: The output, or its address.
        key: The sequence.
        attributes: As `iterate` has it.

    Raises:
        ObjectMissing: No such sequence, or the data set is not finalised.
    """
    store = open_store(source) if isinstance(source, str) else source
    with DatasetIndex(store) as index:
        row = index.row(key)
    if row is None:
        raise ObjectMissing(f"{store.uri} holds no sequence {key!r}")
    tar_name = str(row["tar_name"])
    wanted = _present(store, tar_name, attributes)
    if ranges := member_ranges(row, wanted):
        files: Files = {attribute: {} for attribute in wanted}
        for attribute, extension, offset, size in ranges:
            data = store.get_bytes(payload_key(tar_name, attribute), offset, size)
            if len(data) != size:
                raise IntegrityError(f"{payload_key(tar_name, attribute)} ends inside sample {key}")
            files[attribute][extension] = data
        return _sample(key, files, row)
    for found, files in _lockstep(store, tar_name, wanted):  # an index without offsets, of other origin
        if found == key:
            return _sample(key, files, row)
    raise IntegrityError(f"{tar_name} does not hold {key}, although the index says so")


def member_ranges(row: Row, attributes: Sequence[Attribute]) -> list[tuple[Attribute, str, int, int]]:
    """(attribute, extension, offset, size) of the members of a row; empty if the index has no offsets."""
    ranges = []
    for attribute in attributes:
        for member in MEMBERS[attribute]:
            stem = member_column(attribute, member)
            offset, size = row.get(f"{stem}_offset"), row.get(f"{stem}_size")
            if offset is not None and size is not None:
                ranges.append((attribute, member.extension, int(offset), int(size)))
            elif not member.optional:
                return []
    return ranges


def _present(store: ObjectStore, tar_name: str, wanted: Sequence[Attribute] | None) -> tuple[Attribute, ...]:
    if wanted is not None:
        return tuple(a for a in ATTRIBUTES if a in wanted or a in REQUIRED)
    names = {info.key for info in store.list(f"payload/{tar_name}/")}
    return tuple(a for a in ATTRIBUTES if payload_key(tar_name, a) in names or a in REQUIRED)


def _lockstep(store: ObjectStore, tar_name: str, attributes: Sequence[Attribute]) -> Iterator[tuple[str, Files]]:
    with ExitStack() as stack:
        streams = []
        for attribute in attributes:
            key = payload_key(tar_name, attribute)
            file = stack.enter_context(open_object(store, key, buffer_bytes=_READ_AHEAD_BYTES))
            streams.append(group_by_keys(_webdataset_members(file, key)))
        try:
            for samples in zip(*streams, strict=True):
                keys = {sample["__key__"] for sample in samples}
                if len(keys) != 1:
                    raise IntegrityError(f"the tars of {tar_name} are out of step at {sorted(keys)}")
                yield (
                    keys.pop(),
                    {
                        attribute: {name: data for name, data in sample.items() if not name.startswith("__")}
                        for attribute, sample in zip(attributes, samples, strict=True)
                    },
                )
        except ValueError as error:
            raise IntegrityError(f"the tars of {tar_name} do not hold the same number of samples") from error


def _webdataset_members(file: BinaryIO, key: str) -> Iterator[dict[str, Any]]:
    for info, _, _, data in read_members(file, key):
        content = data.read()
        if len(content) != info.size:
            raise IntegrityError(f"{key} ends inside {info.name}")
        yield {"__url__": key, "fname": info.name, "data": content}


def _sample(key: str, files: Files, row: Row) -> Sample:
    """Parse with the reader of artifacts, which wants files; depth and rgb are only needed where nothing else says how
    large the pictures are."""
    with tempfile.TemporaryDirectory(prefix="sample-") as name:
        root = Path(name)
        small = "json" in files.get("pose", {})
        for attribute, members in files.items():
            if small and attribute not in REQUIRED:
                continue
            for member in MEMBERS[attribute]:
                if member.extension in members:
                    path = member.path(root, key)
                    path.parent.mkdir(exist_ok=True)
                    path.write_bytes(members[member.extension])
        artifacts = read_artifacts(root, key)
    return Sample(
        key=key,
        world_from_cam=artifacts.world_from_cam,
        camera=artifacts.camera,
        depth_kind=artifacts.depth_kind,
        timestamps_s=artifacts.timestamps_s,
        info=artifacts.info,
        row=row,
        files=files,
    )
