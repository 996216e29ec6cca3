"""A real web server on a loopback address that counts what it is asked for."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

Handler = Callable[[BaseHTTPRequestHandler], None]


@dataclass
class Web:
    """A running server.

    Attributes:
        pages: What a path answers; others answer 404.
        asked: The paths it was asked for, in order.
    """

    host: str
    port: int
    pages: dict[str, Handler] = field(default_factory=dict)
    asked: list[str] = field(default_factory=list)

    def url(self, path: str) -> str:
        return f"http://{self.host}:{self.port}{path}"


@contextlib.contextmanager
def serve(host: str = "127.0.0.1") -> Iterator[Web]:
    class Requests(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_GET(self) -> None:
            web.asked.append(self.path)
            web.pages.get(self.path.partition("?")[0], not_found)(self)

        def log_message(self, format: str, *args: object) -> None:
            return

    for method in ("do_POST", "do_HEAD"):
        setattr(Requests, method, Requests.do_GET)
    server = ThreadingHTTPServer((host, 0), Requests)
    server.daemon_threads = True
    web = Web(host, server.server_port)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
    thread.start()
    try:
        yield web
    finally:
        server.shutdown()
        server.server_close()


def page(body: bytes, status: int = 200, **headers: str) -> Handler:
    def answer(request: BaseHTTPRequestHandler) -> None:
        request.send_response(status)
        for name, value in headers.items():
            request.send_header(name.replace("_", "-"), value)
        request.send_header("Content-Length", str(len(body)))
        request.end_headers()
        if request.command != "HEAD":
            request.wfile.write(body)

    return answer


def redirect(to: str, status: int = 302) -> Handler:
    return page(b"", status, Location=to)


not_found = page(b"nothing here", 404)
