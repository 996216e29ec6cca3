"""Give videos their keys and pack them into shards, in the order in which they come."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Iterator
from types import TracebackType

from services.domain.errors import InvalidManifest
from services.domain.models import ShardPlan, VideoRef, video_key
from services.planner.listing import Found

_SHARDS_PER_STEP = 8


class SeenVideos:
    """Which addresses and keys are taken: a temporary database on disk, so that a million of them need no memory."""

    def __init__(self) -> None:
        self._db = sqlite3.connect("", isolation_level=None)  # an unnamed file that goes with the connection
        self._db.execute("PRAGMA journal_mode = OFF")
        self._db.execute("PRAGMA synchronous = OFF")
        self._db.execute("CREATE TABLE seen (key TEXT PRIMARY KEY, uri TEXT NOT NULL UNIQUE) WITHOUT ROWID")
        self._db.execute("BEGIN")

    def __enter__(self) -> SeenVideos:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._db.close()

    def add(self, key: str, uri: str) -> None:
        """Remember a video that is planned already."""
        self._db.execute("INSERT INTO seen VALUES (?, ?)", (key, uri))

    def new_key(self, uri: str, wanted: str | None = None) -> str | None:
        """The key of a video, None if its address was there before.

        Args:
            wanted: The key that its list gives it.

        Raises:
            InvalidManifest: Another video has this key.
        """
        if self._db.execute("SELECT 1 FROM seen WHERE uri = ?", (uri,)).fetchone() is not None:
            return None
        if wanted is not None:
            if self._db.execute("SELECT 1 FROM seen WHERE key = ?", (wanted,)).fetchone() is not None:
                raise InvalidManifest(f"two videos of the job have the key {wanted!r}; one of them is {uri}")
            self.add(wanted, uri)
            return wanted
        key = video_key(uri)
        if self._db.execute("SELECT 1 FROM seen WHERE key = ?", (key,)).fetchone() is not None:
            key = video_key(uri, hex_digits=16)
        self.add(key, uri)
        return key


def new_videos(found: Iterable[Found], seen: SeenVideos) -> Iterator[VideoRef]:
    """The videos whose address was not there before."""
    for video in found:
        key = seen.new_key(video.uri, video.key)
        if key is not None:
            yield VideoRef(key, video.uri, video.size_bytes, video.etag)


def shard_room(ordinal: int, max_videos: int) -> int:
    """How many videos a shard takes: one at first, one more after every eight shards, `max_videos` in the end.

    So a small job spreads over all slots, a large one shows early what it will be like, and its shards still reach
    their full size soon.
    """
    return min(max_videos, 1 + ordinal // _SHARDS_PER_STEP)


def pack(
    videos: Iterable[VideoRef], *, max_videos: int, max_input_bytes: int, first_ordinal: int = 0
) -> Iterator[ShardPlan]:
    """Fill one shard after the other. A video larger than `max_input_bytes` has a shard for itself."""
    ordinal = first_ordinal
    members: list[VideoRef] = []
    size_bytes = 0
    for video in videos:
        full = len(members) >= shard_room(ordinal, max_videos)
        if members and (full or size_bytes + video.size_bytes > max_input_bytes):
            yield ShardPlan(ordinal, tuple(members))
            ordinal += 1
            members, size_bytes = [], 0
        members.append(video)
        size_bytes += video.size_bytes
    if members:
        yield ShardPlan(ordinal, tuple(members))
