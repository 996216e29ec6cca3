"""Run the application under uvicorn, and stop it without leaving event streams hanging."""

from __future__ import annotations

import socket

import uvicorn
from fastapi import FastAPI

from services.api.middleware import is_loopback
from services.domain.errors import InvalidRequest
from services.settings import Settings

_DRAIN_S = 10


class ApiServer(uvicorn.Server):
    """`run()` in the main thread (stops on SIGINT and SIGTERM), or in another one (stop it by `should_exit = True`)."""

    def __init__(self, app: FastAPI, config: uvicorn.Config) -> None:
        super().__init__(config)
        self._app = app

    @property
    def url(self) -> str:
        """Where it listens, once `started` is true; tells the port that was taken for port 0."""
        host, port = self.servers[0].sockets[0].getsockname()[:2]
        return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        self._app.state.draining.set()
        await super().shutdown(sockets)


def create_server(app: FastAPI, settings: Settings) -> ApiServer:
    """A server for `create_app`'s application at the address of the settings. Logging stays as it is configured.

    Raises:
        InvalidRequest: Whoever reaches the address could use it: no key, not loopback, and nobody said that it may be.
    """
    check_exposure(settings)
    config = uvicorn.Config(
        app,
        host=settings.host,
        port=settings.port,
        log_config=None,
        access_log=False,
        server_header=False,
        lifespan="off",
        timeout_graceful_shutdown=_DRAIN_S,
    )
    return ApiServer(app, config)


def check_exposure(settings: Settings) -> None:
    """Raises InvalidRequest where `create_server` would; for a program that starts other things first."""
    if settings.api_key is None and not settings.allow_anonymous and not is_loopback(settings.host):
        raise InvalidRequest(
            f"the API would answer everybody who reaches {settings.host}: set VIPE_API_KEY,"
            " or VIPE_ALLOW_ANONYMOUS=true where something else keeps strangers out"
        )
