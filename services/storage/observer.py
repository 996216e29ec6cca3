"""The hook through which a store reports its traffic, so that metrics stay out of this package."""

from __future__ import annotations

from typing import Protocol


class StorageObserver(Protocol):
    """Receives one call per request and per finished transfer. Called from any thread; must not raise or block."""

    def request(self, op: str, status: str) -> None:
        """One request was answered.

        Args:
            op: put, create, get, head, list or delete.
            status: The HTTP status (a directory answers with the status that S3 would give: 200, 404, 412), or `error`
                where no answer came.
        """

    def transferred(self, op: str, size_bytes: int) -> None:
        """`size_bytes` of object data went out (`put`, `create`) or came in (`get`)."""


class SilentObserver:
    """Ignores everything."""

    def request(self, op: str, status: str) -> None:
        return None

    def transferred(self, op: str, size_bytes: int) -> None:
        return None
