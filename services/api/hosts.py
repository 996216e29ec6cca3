"""Under which names the service answers, and for which web pages."""

from __future__ import annotations

import ipaddress
from collections.abc import Sequence
from fnmatch import fnmatchcase

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send

from services.api import problems

_READING = frozenset({"GET", "HEAD", "OPTIONS"})


def is_loopback(host: str) -> bool:
    """Whether a name or address (IPv6 without brackets) can only be this machine."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host.lower() == "localhost"


class KnownHosts:
    """Refuses requests under a name that is not the service's.

    A web page can point its own name at 127.0.0.1 (DNS rebinding) and then read every answer as its own; what it cannot
    change is the name that the browser sends.

    Args:
        app: What answers the others.
        names: Names that are the service's, `*.example.org` for all below one.
        loopback: Whether it answers as localhost (and, without `names`, as nothing else).
    """

    def __init__(self, app: ASGIApp, *, names: Sequence[str], loopback: bool) -> None:
        self._app = app
        self._names = [name.lower() for name in names]
        self._loopback = loopback

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http":
            name = _host_name(Headers(scope=scope).get("host", "")).lower()
            known = (self._loopback and is_loopback(name)) or any(fnmatchcase(name, n) for n in self._names)
            if not known:
                detail = (
                    "this service does not answer under this name: see VIPE_ALLOWED_HOSTS"
                    if self._names
                    else "this service answers to localhost only; to serve under a name, set VIPE_API_KEY"
                )
                await problems.response(scope, 400, "unknown_host", detail)(scope, receive, send)
                return
        await self._app(scope, receive, send)


class OwnOrigins:
    """Refuses requests that change something and that a browser sends for a web page of somebody else.

    Without credentials a browser would send some of them unasked (a form's POST), and where no key is needed they would
    be obeyed, although the page never sees the answer.
    """

    def __init__(self, app: ASGIApp, *, allowed: Sequence[str]) -> None:
        self._app = app
        self._allowed = frozenset(origin.rstrip("/").lower() for origin in allowed)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http" and scope["method"] not in _READING:
            headers = Headers(scope=scope)
            origin = headers.get("origin", "").lower()
            own = origin.partition("://")[2] == headers.get("host", "").lower()
            if origin and not own and origin not in self._allowed:
                detail = "web pages of other origins may not use this service: see VIPE_CORS_ORIGINS"
                await problems.response(scope, 403, "origin_not_allowed", detail)(scope, receive, send)
                return
        await self._app(scope, receive, send)


def _host_name(header: str) -> str:
    """The name or address in a Host header, without port and brackets."""
    if header.startswith("["):
        return header[1:].partition("]")[0]
    return header.partition(":")[0]
