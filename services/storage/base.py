"""One interface for a directory and for S3."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol


@dataclass(frozen=True, slots=True)
class ObjectInfo:
    key: str
    size_bytes: int
    etag: str | None


class ObjectStore(Protocol):
    """Objects under one root (a directory, or a bucket with a prefix). Keys are relative, with `/`.

    Every method raises `ObjectMissing` for an absent key and `StorageError` when the store refuses or does not answer
    after the client's own retries. An object is visible whole or not at all.
    """

    @property
    def uri(self) -> str:
        """The root as the user wrote it: an absolute path, or `s3://bucket/prefix`."""

    def put_file(self, key: str, path: Path) -> ObjectInfo:
        """Upload, replacing what is there."""

    def put_bytes(self, key: str, data: bytes) -> ObjectInfo:
        """Upload, replacing what is there."""

    def create(self, key: str, data: bytes) -> bool:
        """Create only if absent, atomically. False if an object with this key exists (also after a lost response).

        Raises `ConditionUnsupported` where the store does not know such a write. One that ignores the condition is
        found by `supports_create_once` only.
        """

    def get_bytes(self, key: str, start: int = 0, length: int | None = None) -> bytes:
        """Read an object or a range of it."""

    def download(self, key: str, path: Path) -> None:
        """Fetch to a local file, atomically (temporary name, then rename)."""

    def head(self, key: str) -> ObjectInfo | None:
        """None if absent."""

    def list(self, prefix: str = "") -> Iterator[ObjectInfo]:
        """All objects whose key starts with `prefix`, in key order, in bounded memory. Hides temporary files."""

    def delete(self, key: str) -> None:
        """Delete; absent is fine."""
