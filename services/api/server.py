"""Run the application under uvicorn, and stop it without leaving event streams hanging."""

from __future__ import annotations

import socket
import ssl

import uvicorn
from anyio import to_thread
from fastapi import FastAPI

from services.api.authentication import serves_anonymous
from services.api.connections import ServerConfig
from services.domain.errors import InvalidRequest
from services.settings import Settings
from services.store.base import Store

_DRAIN_S = 10
# What runs in them is short and mostly Python: more of them only take turns with the interpreter's lock.
_THREADS = 16


class ApiServer(uvicorn.Server):
    """`run()` in the main thread (stops on SIGINT and SIGTERM), or in another one (stop it by `should_exit = True`)."""

    def __init__(self, app: FastAPI, config: uvicorn.Config) -> None:
        super().__init__(config)
        self._app = app

    @property
    def url(self) -> str:
        """Where it listens, once `started` is true; tells the port that was taken for port 0."""
        host, port = self.servers[0].sockets[0].getsockname()[:2]
        scheme = "https" if self.config.is_ssl else "http"
        return f"{scheme}://[{host}]:{port}" if ":" in host else f"{scheme}://{host}:{port}"

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        to_thread.current_default_thread_limiter().total_tokens = _THREADS
        await super().startup(sockets)

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        self._app.state.draining.set()
        await super().shutdown(sockets)
        self._app.state.trail.close()


def create_server(app: FastAPI, settings: Settings) -> ApiServer:
    """A server for `create_app`'s application at the address of the settings. Logging stays as it is configured.

    Raises:
        InvalidRequest: Nobody could use it, see `check_exposure`; or the certificate cannot be read.
    """
    check_exposure(settings, app.state.store)
    config = ServerConfig(
        app,
        receive_timeout_s=settings.receive_timeout_s,
        host=settings.host,
        port=settings.port,
        log_config=None,
        access_log=False,
        server_header=False,
        lifespan="off",
        timeout_graceful_shutdown=_DRAIN_S,
        limit_concurrency=settings.max_connections,
        proxy_headers=bool(settings.trusted_proxies),
        forwarded_allow_ips=list(settings.trusted_proxies),
        ssl_certfile=settings.tls_cert_file,
        ssl_keyfile=settings.tls_key_file,
    )
    try:
        config.load()
    except (OSError, ssl.SSLError) as error:
        raise InvalidRequest(
            f"VIPE_TLS_CERT_FILE {settings.tls_cert_file} and VIPE_TLS_KEY_FILE {settings.tls_key_file}"
            f" cannot be used: {error}"
        ) from error
    return ApiServer(app, config)


def check_exposure(settings: Settings, store: Store) -> None:
    """For a program that starts other things before its server.

    Raises:
        InvalidRequest: The API would wait on an address for keys that nobody has.
    """
    if settings.api_key is None and not serves_anonymous(settings) and not store.list_keys(limit=1)[0]:
        raise InvalidRequest(
            f"nobody could use the API on {settings.host}: create a key with `vipectl keys create`, set VIPE_API_KEY,"
            " or VIPE_ALLOW_ANONYMOUS=true where something else keeps strangers out"
        )
