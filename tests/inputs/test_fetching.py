"""A worker gets the file that was planned, whole, within its limits, or a typed error."""

from __future__ import annotations

import ipaddress
import os
from collections.abc import Callable, Iterator
from contextlib import closing
from http.server import BaseHTTPRequestHandler
from pathlib import Path

import pytest
from web_server import Web, page, redirect, serve

from services.domain.errors import AddressRefused, HttpFailed, InputTooLarge, InputUnavailable, ServiceError
from services.domain.models import VideoRef
from services.inputs.download import download, look
from services.inputs.fetching import fetched
from services.inputs.rules import InputRules
from services.network import GuardedHttp, NetworkPolicy

LOCAL = NetworkPolicy(("127.0.0.1:*",), (ipaddress.ip_network("127.0.0.0/8"),))
BODY = bytes(range(256)) * 400


@pytest.fixture
def web() -> Iterator[Web]:
    with serve() as running:
        yield running


@pytest.fixture
def http() -> Iterator[GuardedHttp]:
    with GuardedHttp(LOCAL, read_timeout_s=2) as client, closing(client):
        yield client


def get(http: GuardedHttp, web: Web, path: Path, *, max_bytes: int = 1 << 20, etag: str | None = None) -> bytes:
    waits: list[float] = []
    assert (
        download(http, web.url("/v"), path, max_bytes=max_bytes, etag=etag, sleep=waits.append) == path.stat().st_size
    )
    return path.read_bytes()


def breaking(*cuts: int, etag: str | None = '"one"', ranges: bool = True) -> Callable[[BaseHTTPRequestHandler], None]:
    """A server that closes the connection after so many bytes, each time, and then serves the rest."""
    left = list(cuts)

    def answer(request: BaseHTTPRequestHandler) -> None:
        wanted = request.headers.get("Range")
        begin = int(wanted[6:-1]) if wanted and ranges and request.headers.get("If-Range") == etag else 0
        body = BODY[begin:]
        request.send_response(206 if begin else 200)
        if begin:
            request.send_header("Content-Range", f"bytes {begin}-{len(BODY) - 1}/{len(BODY)}")
        if etag:
            request.send_header("ETag", etag)
        request.send_header("Content-Length", str(len(body)))
        request.end_headers()
        request.wfile.write(body[: left.pop(0)] if left else body)
        request.close_connection = True

    return answer


@pytest.mark.parametrize(("etag", "ranges"), [('"one"', True), ('"one"', False), (None, True), ('W/"weak"', True)])
def test_a_download_that_breaks_off_goes_on(
    http: GuardedHttp, web: Web, tmp_path: Path, etag: str | None, ranges: bool
) -> None:
    web.pages["/v"] = breaking(30_000, 50_000, etag=etag, ranges=ranges)
    assert get(http, web, tmp_path / "v") == BODY
    assert len(web.asked) == 3
    assert [path.name for path in tmp_path.iterdir()] == ["v"]


def test_a_server_that_always_breaks_off(http: GuardedHttp, web: Web, tmp_path: Path) -> None:
    web.pages["/v"] = breaking(*[10] * 20, ranges=False)
    with pytest.raises(HttpFailed):
        get(http, web, tmp_path / "v")
    assert len(web.asked) == 5
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("status", [401, 403, 404, 410, 304, 418])
def test_a_refusal_is_final(http: GuardedHttp, web: Web, tmp_path: Path, status: int) -> None:
    web.pages["/v"] = page(b"", status)
    with pytest.raises(InputUnavailable, match=str(status)):
        get(http, web, tmp_path / "v")
    assert len(web.asked) == 1


@pytest.mark.parametrize("status", [429, 500, 503])
def test_trouble_is_waited_out(http: GuardedHttp, web: Web, tmp_path: Path, status: int) -> None:
    answers = [page(b"", status, Retry_After="7"), page(b"", status), page(BODY)]
    web.pages["/v"] = lambda request: answers.pop(0)(request)
    waits: list[float] = []
    download(http, web.url("/v"), tmp_path / "v", max_bytes=1 << 20, sleep=waits.append)
    assert waits == [7.0 if status != 500 else 0.5, 1.0]


def endless(request: BaseHTTPRequestHandler) -> None:
    request.send_response(200)
    request.send_header("Transfer-Encoding", "chunked")
    request.end_headers()
    try:
        while True:
            request.wfile.write(b"10000\r\n" + bytes(0x10000) + b"\r\n")
    except OSError:
        request.close_connection = True


def test_no_more_than_allowed_is_read(http: GuardedHttp, web: Web, tmp_path: Path) -> None:
    web.pages["/v"] = endless
    with pytest.raises(InputTooLarge):
        get(http, web, tmp_path / "v", max_bytes=1 << 20)
    web.pages["/v"] = page(BODY)
    with pytest.raises(InputTooLarge):
        get(http, web, tmp_path / "v", max_bytes=len(BODY) - 1)
    assert get(http, web, tmp_path / "v", max_bytes=len(BODY)) == BODY


def test_what_is_sent_compressed_is_refused(http: GuardedHttp, web: Web, tmp_path: Path) -> None:
    web.pages["/v"] = page(b"\x1f\x8b", Content_Encoding="gzip")
    with pytest.raises(InputUnavailable, match="compressed"):
        get(http, web, tmp_path / "v")


def test_a_slow_server_does_not_hold_a_worker(http: GuardedHttp, web: Web, tmp_path: Path) -> None:
    web.pages["/v"] = page(BODY)
    hours = iter(range(0, 10**6, 3600))
    with pytest.raises(HttpFailed, match="too slowly"):
        download(
            http,
            web.url("/v"),
            tmp_path / "v",
            max_bytes=1 << 20,
            clock=lambda: float(next(hours)),
            sleep=lambda _: None,
        )


def test_look(http: GuardedHttp, web: Web) -> None:
    web.pages["/v"] = page(BODY, ETag='"e"')
    assert (look(http, web.url("/v")).size_bytes, look(http, web.url("/v")).etag) == (len(BODY), '"e"')
    web.pages["/v"] = lambda r: (
        page(b"", 405) if r.command == "HEAD" else page(b"x", 206, Content_Range="bytes 0-0/77")
    )(r)
    assert look(http, web.url("/v")).size_bytes == 77


def rules(**changes: object) -> InputRules:
    return InputRules(network=LOCAL, **changes)


def read(ref: VideoRef, allowed: InputRules, folder: Path) -> bytes:
    scratch = folder / "scratch"
    scratch.mkdir(exist_ok=True)
    try:
        with fetched(ref, allowed, lambda suffix: scratch / f"{ref.key}{suffix}") as local:
            if local.path.is_dir():
                return b"".join(p.read_bytes() for p in sorted(local.path.iterdir()))
            return local.path.read_bytes()
    finally:
        assert list(scratch.iterdir()) == [], "nothing is left behind"


def test_a_web_input(web: Web, tmp_path: Path) -> None:
    web.pages["/a/clip.mp4"] = page(BODY, ETag='"e"')
    web.pages["/moved"] = redirect("/a/clip.mp4")
    for url in (web.url("/a/clip.mp4?v=1"), web.url("/moved")):
        assert read(VideoRef("k", url, 0, '"e"'), rules(), tmp_path) == BODY
    with pytest.raises(InputUnavailable, match="planned"):
        read(VideoRef("k", web.url("/a/clip.mp4"), 0, '"other"'), rules(), tmp_path)
    for refused in (InputRules(), InputRules(network=NetworkPolicy(("127.0.0.1:*",)))):
        with pytest.raises(AddressRefused):
            read(VideoRef("k", web.url("/a/clip.mp4"), 0), refused, tmp_path)


def test_a_signature_in_a_url_is_not_shown(web: Web, tmp_path: Path) -> None:
    with pytest.raises(ServiceError) as caught:
        read(VideoRef("k", web.url("/gone?X-Amz-Signature=hush"), 0), rules(), tmp_path)
    assert "hush" not in str(caught.value)


def test_a_local_input_inside_of_the_roots(tmp_path: Path) -> None:
    root = tmp_path / "root"
    (root / "images").mkdir(parents=True)
    (root / "a.mp4").write_bytes(b"video")
    (root / "images" / "1.png").write_bytes(b"one")
    for allowed in (rules(), rules(roots=(root,))):
        assert read(VideoRef("k", f"{root}/a.mp4", 5), allowed, tmp_path) == b"video"
        assert read(VideoRef("k", f"{root}/images", 5), allowed, tmp_path) == b"one"


def test_local_inputs_that_are_not_inside(tmp_path: Path) -> None:
    root = tmp_path / "root"
    root.mkdir()
    (tmp_path / "secret.mp4").write_bytes(b"secret")
    (root / "link.mp4").symlink_to(tmp_path / "secret.mp4")
    (root / "folder").symlink_to(tmp_path)
    os.mkfifo(root / "pipe.mp4")
    bad = ["link.mp4", "folder/secret.mp4", "../secret.mp4", "folder", "pipe.mp4", "none.mp4", "x" * 300]
    for uri in [*(f"{root}/{name}" for name in bad), "/proc/self/environ", "/dev/zero", "/etc/passwd"]:
        with pytest.raises(InputUnavailable):
            read(VideoRef("k", uri, 0), rules(roots=(root,)), tmp_path)


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="descriptors have no names here")
def test_a_link_put_in_place_after_the_check_changes_nothing(tmp_path: Path) -> None:
    root = tmp_path / "root"
    root.mkdir()
    (tmp_path / "secret.mp4").write_bytes(b"secret")
    (root / "a.mp4").write_bytes(b"mine")
    with fetched(VideoRef("k", f"{root}/a.mp4", 4), rules(roots=(root,)), lambda s: tmp_path / f"k{s}") as local:
        (root / "a.mp4").unlink()
        (root / "a.mp4").symlink_to(tmp_path / "secret.mp4")
        assert local.path.read_bytes() == b"mine"
        assert local.path.name == "k.mp4"
