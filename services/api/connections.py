"""The HTTP/1.1 protocol with an end to its patience.

uvicorn times the pause between two requests, and forgets it at the first byte: a client that sends a header's letters
one by one, or nothing at all, would keep its connection for ever.
"""

from __future__ import annotations

import asyncio
from typing import Any

import uvicorn
from starlette.types import ASGIApp
from uvicorn.protocols.http.h11_impl import H11Protocol


class ServerConfig(uvicorn.Config):
    """uvicorn's settings, and for how long a request's headers may take."""

    def __init__(self, app: ASGIApp, *, receive_timeout_s: float, **options: Any) -> None:
        super().__init__(app, **{**options, "http": ImpatientProtocol})
        self.receive_timeout_s = receive_timeout_s


class ImpatientProtocol(H11Protocol):
    """Closes a connection on which no whole request head arrives in time, counted from the end of the last answer."""

    def __init__(self, config: ServerConfig, *args: Any, **kwargs: Any) -> None:
        super().__init__(config, *args, **kwargs)
        self._receive_timeout_s = config.receive_timeout_s
        self._timer: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._expect_request()

    def on_response_complete(self) -> None:
        self._expect_request()  # before a request that waits already begins
        super().on_response_complete()

    def connection_lost(self, exc: Exception | None) -> None:
        self._forget_timer()
        super().connection_lost(exc)

    def _expect_request(self) -> None:
        self._forget_timer()
        self._timer = self.loop.call_later(self._receive_timeout_s, self._give_up, self.cycle)

    def _give_up(self, last_cycle: object) -> None:
        if self.cycle is last_cycle:  # each request begins a cycle of its own
            self.transport.close()

    def _forget_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
