"""Instance masks of a video on disk for as long as they are wanted, and a frame source that knows them.

The maps of a long video do not fit in memory; compressed, they are a few kilobytes a frame in a file without a name.
"""

from __future__ import annotations

import dataclasses
import tempfile
import zlib
from collections.abc import Collection, Mapping
from contextlib import closing

import cv2
import numpy as np
from numpy.typing import NDArray

from vipe_core.video.source import FrameSource, FrameStream, VideoInfo

# Compression: a map is plain regions, which the fastest level already makes a hundred times smaller.
_LEVEL = 1


class InstanceMaps:
    """Id maps (h, w) uint8 of one size, appended in the order of the frames and read in any.

    Attributes:
        phrases: What the ids stand for; of all frames so far.
        static: Phrases of things that do not move, such as the sky: they are in the maps but may be used.
    """

    def __init__(self, static: Collection[str] = ()) -> None:
        self.static = frozenset(static)
        self.phrases: Mapping[int, str] = {}
        # Closed, and with that deleted, when nothing refers to it any more.
        self._file = tempfile.TemporaryFile(prefix="vipe-masks-")  # noqa: SIM115
        self._places: list[tuple[int, int]] = []
        self._end = 0
        self._shape = (0, 0)

    def __len__(self) -> int:
        return len(self._places)

    def append(self, ids: NDArray[np.uint8], phrases: Mapping[int, str]) -> None:
        """The map of the next frame; `phrases` of all ids so far.

        Raises:
            ValueError: It has another size than those before it.
        """
        if self._places and ids.shape != self._shape:
            raise ValueError(f"maps must be {self._shape}, got {ids.shape}")
        self._shape = (ids.shape[0], ids.shape[1])
        packed = zlib.compress(np.asarray(ids, np.uint8).tobytes(), _LEVEL)
        self._file.seek(self._end)
        self._file.write(packed)
        self._places.append((self._end, len(packed)))
        self._end += len(packed)
        self.phrases = phrases

    def ids(self, index: int, width: int, height: int) -> NDArray[np.uint8]:
        """(height, width) ids of a frame; 0 for frames without a map."""
        found = self._read(index)
        if found is None:
            return np.zeros((height, width), np.uint8)
        if found.shape == (height, width):
            return found
        return np.asarray(cv2.resize(found, (width, height), interpolation=cv2.INTER_NEAREST), np.uint8)

    def moving(self, index: int, width: int, height: int) -> NDArray[np.bool_]:
        """(height, width) bool, True on things that may move; on any pixel of which a smaller picture shows a part."""
        found = self._read(index)
        if found is None:
            return np.zeros((height, width), np.bool_)
        thing = (found > 0) & ~np.isin(found, [number for number, what in self.phrases.items() if what in self.static])
        if thing.shape == (height, width):
            return thing
        smaller = width < thing.shape[1] or height < thing.shape[0]
        how = cv2.INTER_AREA if smaller else cv2.INTER_NEAREST
        share = cv2.resize(thing.astype(np.float32), (width, height), interpolation=how)
        return np.asarray(share > 1e-6, np.bool_)

    def _read(self, index: int) -> NDArray[np.uint8] | None:
        if index >= len(self._places):
            return None
        start, length = self._places[index]
        self._file.seek(start)
        return np.frombuffer(zlib.decompress(self._file.read(length)), np.uint8).reshape(self._shape).copy()


class InstanceView:
    """A frame source whose frames say that the things in `maps` must not be used, besides what they say themselves.

    Attributes:
        source: What is looked at.
    """

    def __init__(self, source: FrameSource, maps: InstanceMaps) -> None:
        self.source = source
        self._maps = maps

    @property
    def info(self) -> VideoInfo:
        return self.source.info

    def frames(self, size: tuple[int, int] | None = None, start: int = 0, stop: int | None = None) -> FrameStream:
        """See `FrameSource.frames`."""
        with closing(self.source.frames(size, start, stop)) as frames:
            for frame in frames:
                height, width = frame.rgb.shape[:2]
                masked = self._maps.moving(frame.index, width, height)
                if frame.masked is not None:
                    masked |= frame.masked
                yield dataclasses.replace(frame, masked=masked)
