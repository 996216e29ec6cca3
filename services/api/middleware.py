"""Around every request: an id, a clock, a limit on the body, and an answer also when something breaks."""

from __future__ import annotations

import ipaddress
import logging
import re
import time
import uuid

from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from services.api import problems
from services.observability.logging import context
from services.observability.metrics import Metrics

_log = logging.getLogger(__name__)
_ID_HEADER = "X-Request-ID"
_ACCEPTABLE_ID = re.compile(r"[A-Za-z0-9._:-]{1,128}")


def is_loopback(host: str) -> bool:
    """Whether a name or address (IPv6 without brackets) can only be this machine."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host.lower() == "localhost"


class LoopbackHost:
    """Refuses requests to a loopback service under a name that is not this machine's.

    A web page can point its own name at 127.0.0.1 (DNS rebinding) and then read every answer as its own; what it cannot
    change is the name that the browser sends.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http" and not is_loopback(_host_name(Headers(scope=scope).get("host", ""))):
            detail = "this service answers to localhost only; to serve under a name, set VIPE_API_KEY"
            await problems.response(scope, 400, "unknown_host", detail)(scope, receive, send)
            return
        await self._app(scope, receive, send)


def _host_name(header: str) -> str:
    """The name or address in a Host header, without port and brackets."""
    if header.startswith("["):
        return header[1:].partition("]")[0]
    return header.partition(":")[0]


class RequestContext:
    """Gives the request its id (the caller's, if it is a plain one), times it, and turns a crash into a problem.

    An ASGI application itself, so that streams pass through unbuffered.
    """

    def __init__(self, app: ASGIApp, *, metrics: Metrics) -> None:
        self._app = app
        self._metrics = metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        given = Headers(scope=scope).get(_ID_HEADER, "")
        request_id = given if _ACCEPTABLE_ID.fullmatch(given) else uuid.uuid4().hex
        scope.setdefault("state", {})["request_id"] = request_id
        status = 0
        answered_s: float | None = None  # A stream lives as long as its job; what it took to answer is its start.

        async def send_with_id(message: Message) -> None:
            nonlocal status, answered_s
            if message["type"] == "http.response.start":
                status = message["status"]
                headers = MutableHeaders(scope=message)
                headers[_ID_HEADER] = request_id
                if headers.get("content-type", "").startswith("text/event-stream"):
                    answered_s = time.perf_counter() - start
            await send(message)

        start = time.perf_counter()
        with context(request_id=request_id):
            try:
                await self._app(scope, receive, send_with_id)
            except Exception:
                _log.exception("%s %s broke", scope["method"], scope["path"])
                if status:  # the answer is under way: cutting the connection is all that tells the client
                    raise
                detail = "the service has a defect; its log holds the request id"
                await problems.response(scope, 500, "internal_error", detail)(scope, receive, send_with_id)
            finally:
                elapsed_s = time.perf_counter() - start
                route = getattr(scope.get("route"), "path", "unmatched")
                method = scope["method"] if scope["method"] in _METHODS else "other"
                self._metrics.api_request_duration.labels(route=route, method=method, status=str(status)).observe(
                    elapsed_s if answered_s is None else answered_s
                )
                _log.info("%s %s %d in %.0f ms", scope["method"], scope["path"], status, 1e3 * elapsed_s)


_METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})


# A client that is still sending when the connection closes never sees the answer: so much more is read and dropped.
_PATIENCE = 16


class BodyLimit:
    """Refuses a body that is larger than allowed, whatever its headers promise; never holds more than that."""

    def __init__(self, app: ASGIApp, *, max_bytes: int) -> None:
        self._app = app
        self._max_bytes = max_bytes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        detail = f"the request body is larger than {self._max_bytes} bytes"
        length = Headers(scope=scope).get("content-length", "")
        if length.isdigit() and int(length) > self._max_bytes:
            await self._discard(receive)
            await problems.response(scope, 413, "body_too_large", detail)(scope, receive, send)
            return
        read_bytes = 0

        async def counted() -> Message:
            nonlocal read_bytes
            message = await receive()
            read_bytes += len(message.get("body", b""))
            if read_bytes > self._max_bytes:
                if message.get("more_body", False):
                    await self._discard(receive)
                raise HTTPException(413, detail)
            return message

        await self._app(scope, counted, send)

    async def _discard(self, receive: Receive) -> None:
        dropped_bytes = 0
        while dropped_bytes <= _PATIENCE * self._max_bytes:
            message = await receive()
            dropped_bytes += len(message.get("body", b""))
            if not message.get("more_body", False):
                return
