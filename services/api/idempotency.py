"""`Idempotency-Key`: what a repeated request is told by.

The answer is kept by the store, in the transaction that does what was asked. Here is what only the HTTP side knows: the
hash of the request, and which keys this process is working on.
"""

from __future__ import annotations

import hashlib
import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Annotated

from fastapi import Depends, Header, Request

from services.domain.errors import IdempotencyInFlight

IdempotencyKey = Annotated[
    str | None,
    Header(
        min_length=1,
        max_length=255,
        pattern=r"^[\x21-\x7e]+$",
        description="Chosen by the caller: the same key and request is done once.",
    ),
]


async def _request_hash(request: Request) -> str:
    """sha256 of method, path and body; of the body's JSON, so that another spelling of it is the same request."""
    body = await request.body()
    with suppress(ValueError, RecursionError):  # what is no JSON is refused anyway
        body = json.dumps(json.loads(body), sort_keys=True).encode()
    return hashlib.sha256(b"\n".join([request.method.encode(), request.url.path.encode(), body])).hexdigest()


RequestHash = Annotated[str, Depends(_request_hash)]


class KeysInWork:
    """The keys whose first request this process has not answered yet. Thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._keys: set[tuple[str, str]] = set()

    @contextmanager
    def on(self, tenant: str, key: str | None) -> Iterator[None]:
        """Work on a request; without a key there is nothing to watch.

        Raises:
            IdempotencyInFlight: A request with this key is being worked on.
        """
        if key is None:
            yield
            return
        with self._lock:
            if (tenant, key) in self._keys:
                raise IdempotencyInFlight(f"a request with Idempotency-Key {key!r} is being worked on; ask again soon")
            self._keys.add((tenant, key))
        try:
            yield
        finally:
            with self._lock:
                self._keys.discard((tenant, key))
