"""An S3 endpoint that misbehaves on request: a proxy in front of a real one.

Modes, switched on and off while it runs:

    down        503 for everything
    refused     the connection is closed without an answer, and nothing reaches the service
    lost        the request reaches the service, its answer does not reach the client
    slow        every answer comes late
    truncated   tars are cut in half on the way, by a service that looks at no checksum
    strip       `If-None-Match` is removed: a service that ignores conditions
    not-implemented, bad-request    501 or 400 to every conditional write: services that refuse conditions
    races       the condition is looked up first and the write follows later: a service that only seems to know it
"""

from __future__ import annotations

import http.client
import random
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import urlsplit

MODES = ("down", "refused", "truncated", "lost", "slow", "strip", "not-implemented", "bad-request", "races")
_ABOUT_CONDITIONS = {"strip", "not-implemented", "bad-request", "races"}
_CONDITION = "If-None-Match"
_HOP_BY_HOP = {"connection", "keep-alive", "transfer-encoding", "host", "expect"}


class S3Proxy:
    """Listens on a port of its own from `start` until `stop`.

    Attributes:
        modes: Each of `MODES` that is on, and the share of the requests that it befalls, 0..1; those about conditions
            befall all. The first that applies to a request counts, in the order of `MODES`.
        slow_s: Delay of the mode `slow`, and of the write in the mode `races`.
        befallen: Requests that a mode changed.
    """

    def __init__(self, upstream: str, *, seed: int = 0) -> None:
        parts = urlsplit(upstream)
        self._upstream = (str(parts.hostname), parts.port or 80)
        self.modes: dict[str, float] = {}
        self.slow_s = 0.05
        self.befallen = 0
        self._random = random.Random(seed)
        methods = {f"do_{name}": _Handler.handle_any for name in ("GET", "PUT", "POST", "DELETE", "HEAD")}
        handler = type("Handler", (_Handler,), {"proxy": self, **methods})
        self._server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
        self._server.daemon_threads = True
        self._thread = threading.Thread(target=self._server.serve_forever, name="s3-proxy", daemon=True)

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self._server.server_port}"

    def start(self) -> S3Proxy:
        self._thread.start()
        return self

    def stop(self) -> None:
        self._server.shutdown()
        self._server.server_close()

    def befalls(self, method: str, path: str, headers: dict[str, str]) -> str:
        """The mode that applies to one request."""
        conditional = method == "PUT" and _CONDITION in headers
        for mode, share in sorted(self.modes.items(), key=lambda item: MODES.index(item[0])):
            if mode in _ABOUT_CONDITIONS:
                applies = conditional
            else:
                # A record is one small PUT with a checksum; a service that stores half of one cannot be helped.
                fits = mode != "truncated" or (method == "PUT" and "/payload/" in path)
                applies = fits and self._random.random() < share
            if applies:
                self.befallen += 1
                return mode
        return "pass"

    def forward(self, method: str, path: str, headers: dict[str, str], body: bytes) -> tuple[int, Any, bytes]:
        """(status, headers, body) of the service behind."""
        connection = http.client.HTTPConnection(*self._upstream, timeout=60)
        try:
            connection.request(method, path, body, headers)
            answer = connection.getresponse()
            return answer.status, answer.headers, answer.read()
        finally:
            connection.close()


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    proxy: S3Proxy

    def handle_any(self) -> None:
        proxy = self.proxy
        body = self._body()
        headers = {name: value for name, value in self.headers.items() if name.lower() not in _HOP_BY_HOP}
        headers["Content-Length"] = str(len(body))
        mode = proxy.befalls(self.command, self.path, headers)
        if mode == "refused":
            self.close_connection = True
            return
        if mode == "down":
            self._answer(503, {}, b"<Error><Code>SlowDown</Code></Error>")
            return
        if mode in ("not-implemented", "bad-request"):
            code = {"not-implemented": (501, b"NotImplemented"), "bad-request": (400, b"InvalidArgument")}[mode]
            self._answer(code[0], {}, b"<Error><Code>%s</Code></Error>" % code[1])
            return
        if mode == "truncated":
            body = body[: len(body) // 2]
            headers = {n: v for n, v in headers.items() if "checksum" not in n.lower() and n.lower() != "content-md5"}
            headers["Content-Length"] = str(len(body))
        if mode == "races":
            status, _, _ = proxy.forward("HEAD", self.path, {}, b"")
            if status == 200:
                self._answer(412, {}, b"<Error><Code>PreconditionFailed</Code></Error>")
                return
            time.sleep(proxy.slow_s)
        if mode in ("races", "strip"):
            del headers[_CONDITION]
        try:
            status, answer_headers, data = proxy.forward(self.command, self.path, headers, body)
        except OSError:  # the service itself is gone
            self.close_connection = True
            return
        if mode == "lost":
            self.close_connection = True
            return
        if mode == "slow":
            time.sleep(proxy.slow_s)
        self._answer(status, answer_headers, data)

    def _body(self) -> bytes:
        if "chunked" not in self.headers.get("Transfer-Encoding", ""):
            return self.rfile.read(int(self.headers.get("Content-Length") or 0))
        pieces = []
        while size := int(self.rfile.readline().split(b";")[0], 16):
            pieces.append(self.rfile.read(size))
            self.rfile.readline()
        self.rfile.readline()
        return b"".join(pieces)

    def _answer(self, status: int, headers: Any, data: bytes) -> None:
        try:
            self.send_response(status)
            for name, value in headers.items():
                if name.lower() not in (*_HOP_BY_HOP, "content-length", "server", "date"):
                    self.send_header(name, value)
            length = headers.get("Content-Length", "0") if self.command == "HEAD" else str(len(data))
            self.send_header("Content-Length", length)
            self.end_headers()
            if self.command != "HEAD":
                self.wfile.write(data)
        except OSError:  # the client is gone
            self.close_connection = True

    def log_message(self, format: str, *args: Any) -> None:
        return None
