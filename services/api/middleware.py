"""Around every request: an id, a clock, a limit on the body, and an answer also when something breaks."""

from __future__ import annotations

import logging
import re
import time
import uuid

import anyio
from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from services.api import problems
from services.observability.logging import context
from services.observability.metrics import Metrics

_log = logging.getLogger(__name__)
_ID_HEADER = "X-Request-ID"
_ACCEPTABLE_ID = re.compile(r"[A-Za-z0-9._:-]{1,128}")


_NO_FURTHER = "default-src 'none'; frame-ancestors 'none'"
# The page loads its program from there; it has no use for anything else.
_DOCS = (
    "default-src 'none'; connect-src 'self'; frame-ancestors 'none'; img-src https://fastapi.tiangolo.com data:; "
    "script-src https://cdn.jsdelivr.net 'unsafe-inline'; style-src https://cdn.jsdelivr.net 'unsafe-inline'"
)
_EVERYWHERE = {
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Permissions-Policy": "camera=(), geolocation=(), microphone=()",
}


def _secure(headers: MutableHeaders, scope: Scope) -> None:
    """What tells browsers and caches to make nothing of an answer but what it is."""
    for name, value in _EVERYWHERE.items():
        headers[name] = value
    headers["Content-Security-Policy"] = _DOCS if scope["path"] == "/docs" else _NO_FURTHER
    headers.setdefault("Cache-Control", "no-store")
    if scope.get("scheme") == "https":
        headers["Strict-Transport-Security"] = "max-age=31536000"


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
                _secure(headers, scope)
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
    """Refuses a body that is larger than allowed, whatever its headers promise, or that does not arrive in time.

    Never holds more than is allowed.
    """

    def __init__(self, app: ASGIApp, *, max_bytes: int, timeout_s: float) -> None:
        self._app = app
        self._max_bytes = max_bytes
        self._timeout_s = timeout_s

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
        complete = False
        deadline_s = anyio.current_time() + self._timeout_s

        async def counted() -> Message:
            nonlocal read_bytes, complete
            if complete:  # what comes now is the end of the connection, for which a stream waits as long as it lasts
                return await receive()
            try:
                with anyio.fail_after(deadline_s - anyio.current_time()):
                    message = await receive()
            except TimeoutError:
                late = f"the request body did not arrive within {self._timeout_s:g} s"
                raise HTTPException(408, late, {"Connection": "close"}) from None
            complete = not message.get("more_body", False)
            read_bytes += len(message.get("body", b""))
            if read_bytes > self._max_bytes:
                if message.get("more_body", False):
                    await self._discard(receive)
                raise HTTPException(413, detail)
            return message

        await self._app(scope, counted, send)

    async def _discard(self, receive: Receive) -> None:
        dropped_bytes = 0
        with anyio.move_on_after(self._timeout_s):
            while dropped_bytes <= _PATIENCE * self._max_bytes:
                message = await receive()
                dropped_bytes += len(message.get("body", b""))
                if not message.get("more_body", False):
                    return
