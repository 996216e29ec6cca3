"""Connections for users go to public addresses of allowed hosts, whatever the URL, the resolver or a redirect says."""

from __future__ import annotations

import ipaddress
import socket
import threading
from collections.abc import Iterator
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from web_server import Web, page, redirect, serve

from services.domain.errors import AddressRefused, HttpFailed, NameUnresolved, ServiceError
from services.network import GuardedHttp, NetworkPolicy, refusal_of

EVERYWHERE = NetworkPolicy(("*:*",))


def here(*networks: str, hosts: tuple[str, ...] = ("*:*",)) -> NetworkPolicy:
    return NetworkPolicy(hosts, tuple(ipaddress.ip_network(n) for n in networks))


@pytest.fixture
def web() -> Iterator[Web]:
    with serve() as running:
        yield running


@pytest.mark.parametrize(
    "address",
    [
        "127.0.0.1", "127.8.8.8", "0.0.0.0", "10.0.0.1", "172.16.9.9", "192.168.1.1", "169.254.169.254", "100.64.0.1",
        "100.100.100.200", "192.0.0.192", "198.18.0.1", "192.0.2.7", "224.0.0.1", "239.1.1.1", "240.0.0.1",
        "255.255.255.255", "::", "::1", "fe80::1", "fe80::1%eth0", "fc00::1", "fd00:ec2::254", "fec0::1", "ff02::1",
        "::ffff:127.0.0.1", "::ffff:169.254.169.254", "::ffff:10.0.0.1", "::127.0.0.1", "64:ff9b::7f00:1",
        "64:ff9b::a9fe:a9fe", "64:ff9b:1::1", "2002:7f00:1::", "2001::1", "2001:db8::1", "100::1", "::ffff:0:127.0.0.1",
    ],
)  # fmt: skip
def test_what_is_no_public_address(address: str) -> None:
    assert refusal_of(ipaddress.ip_address(address)) is not None
    assert EVERYWHERE.refusal(address) is not None


@pytest.mark.parametrize(
    "address", ["1.1.1.1", "93.184.216.34", "2606:4700::1111", "64:ff9b::101:101", "::ffff:1.1.1.1"]
)
def test_public_addresses(address: str) -> None:
    assert EVERYWHERE.refusal(address) is None


@given(st.ip_addresses(v=4))
def test_a_disguise_changes_nothing(address: ipaddress.IPv4Address) -> None:
    plain = EVERYWHERE.refusal(address)
    for prefix in ("::ffff:0:0", "64:ff9b::"):
        disguised = ipaddress.IPv6Address(int(ipaddress.IPv6Address(prefix)) | int(address))
        assert EVERYWHERE.refusal(disguised) == plain


def test_a_network_that_is_allowed() -> None:
    policy = here("10.1.0.0/16", "fd00:1::/32")
    assert policy.refusal("10.1.2.3") is None
    assert policy.refusal("::ffff:10.1.2.3") is None
    assert policy.refusal("fd00:1::5") is None
    assert policy.refusal("10.2.0.1") == "private"


@pytest.mark.parametrize(
    "url",
    [
        "ftp://a.example/x", "file:///etc/passwd", "gopher://a.example/", "//a.example/x", "http:///x", "http://",
        "http://user@a.example/", "http://user:secret@a.example/", "http://@a.example/", "http://a.example\\@b.example/",
        "http://a.example /", "http://a.example/\n", "http://a.example:99999/", "http://a.example:x/", "http://[::1",
        "http://[fe80::1%25eth0]/", "http://a..example/", "http://%61.example/", "http://a.example/ü", "http://-a.example/",
        "http://a.example:22/", "https://a.example:80/", "http://b.example/", "http://a.example.evil.net/",
        "http://evil.net/?a.example", "http://evil.net#a.example", "http://xa.example/",
    ],
)  # fmt: skip
def test_urls_that_are_refused(url: str) -> None:
    with pytest.raises(AddressRefused) as caught:
        NetworkPolicy(("a.example",)).endpoint(url)
    assert "secret" not in str(caught.value)
    assert str(caught.value).isprintable()


@pytest.mark.parametrize(
    ("hosts", "url", "authority"),
    [
        ("a.example", "https://A.Example./v.mp4?x=1#f", "a.example"),
        ("*.example", "http://a.b.example:80/v.mp4", "a.b.example"),
        ("a.example:8443", "https://a.example:8443/", "a.example:8443"),
        ("*", "https://xn--mnchen-3ya.example/", "xn--mnchen-3ya.example"),
        ("*", "https://münchen.example/", "xn--mnchen-3ya.example"),
        ("*:*", "http://[2606:4700::1111]:9/", "[2606:4700::1111]:9"),
        ("[::1]:*", "http://[0::1]:9/", "[::1]:9"),
    ],
)
def test_urls_that_are_allowed(hosts: str, url: str, authority: str) -> None:
    assert NetworkPolicy((hosts,)).endpoint(url).authority == authority


@pytest.mark.parametrize("pattern", ["", "http://a", "a b", "a.*", "**", "a:b", "*.", "a/b"])
def test_patterns_that_are_none(pattern: str) -> None:
    with pytest.raises(ValueError, match="no pattern"):
        NetworkPolicy((pattern,))


def test_nothing_is_allowed_where_no_host_is() -> None:
    with pytest.raises(AddressRefused, match="allowed: none"):
        NetworkPolicy().endpoint("https://a.example/")


@given(st.text(max_size=40))
def test_no_url_breaks_the_check(text: str) -> None:
    for url in (text, f"http://{text}", f"https://a.example/{text}"):
        try:
            endpoint = NetworkPolicy(("a.example",)).endpoint(url)
        except AddressRefused:
            continue
        assert endpoint.host == "a.example"
        assert endpoint.target.isascii()


def fetch(policy: NetworkPolicy, url: str, **options: Any) -> bytes:
    with GuardedHttp(policy) as http, http.open("GET", url, follow_redirects=True, **options) as answer:
        return b"".join(answer.body)


def test_an_allowed_network_is_reached(web: Web) -> None:
    web.pages["/v"] = page(b"hello")
    assert fetch(here("127.0.0.0/8"), web.url("/v?q=1")) == b"hello"
    assert web.asked == ["/v?q=1"]


@pytest.mark.parametrize("name", ["127.0.0.1", "localhost", "2130706433", "0x7f.1", "0177.0.0.1", "[::ffff:127.0.0.1]"])
def test_loopback_by_any_name_is_not_contacted(web: Web, name: str) -> None:
    with pytest.raises((AddressRefused, NameUnresolved)):
        fetch(EVERYWHERE, f"http://{name}:{web.port}/secret")
    assert web.asked == []


def test_a_redirect_is_checked_like_the_first_url(web: Web) -> None:
    with serve("127.0.0.2") as inner:
        inner.pages["/secret"] = page(b"secret")
        web.pages["/out"] = redirect(inner.url("/secret"))
        web.pages["/scheme"] = redirect("file:///etc/passwd")
        web.pages["/user"] = redirect(f"http://user:pw@127.0.0.1:{web.port}/v")
        web.pages["/broken"] = redirect("http://[")
        for path in ("/out", "/scheme", "/user", "/broken"):
            with pytest.raises(AddressRefused):
                fetch(here("127.0.0.1/32"), web.url(path))
        assert inner.asked == []
        assert fetch(here("127.0.0.0/8"), web.url("/out")) == b"secret", "and followed where it is allowed"


def test_redirects_end(web: Web) -> None:
    web.pages["/loop"] = redirect("/loop")
    with pytest.raises(AddressRefused, match="redirects"):
        fetch(here("127.0.0.1/32"), web.url("/loop"))
    assert len(web.asked) == 6


def test_a_name_that_changes_its_address_gains_nothing(web: Web, monkeypatch: pytest.MonkeyPatch) -> None:
    """The check and the connection use one and the same answer of the resolver."""
    web.pages["/secret"] = page(b"secret")
    answers: Iterator[str] = iter(["198.51.100.7", "127.0.0.1"])
    asked: list[str] = []

    def resolver(host: str, port: int, *args: Any, **options: Any) -> list[Any]:
        if host != "rebind.example":
            return real(host, port, *args, **options)
        asked.append(address := next(answers))
        return [(socket.AF_INET, socket.SOCK_STREAM, 6, "", (address, port))]

    real = socket.getaddrinfo
    monkeypatch.setattr(socket, "getaddrinfo", resolver)
    policy = here("198.51.100.0/24")
    with GuardedHttp(policy, connect_timeout_s=0.2) as http, pytest.raises(HttpFailed):
        http.open("GET", f"http://rebind.example:{web.port}/secret").__enter__()
    assert asked == ["198.51.100.7"]
    with pytest.raises(AddressRefused, match=r"127\.0\.0\.1, which is loopback"):
        fetch(policy, f"http://rebind.example:{web.port}/secret")
    assert web.asked == []


def test_one_forbidden_address_among_several_is_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    found = [(socket.AF_INET, socket.SOCK_STREAM, 6, "", (a, 80)) for a in ("1.1.1.1", "169.254.169.254")]
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: found)
    with pytest.raises(AddressRefused, match="link-local"):
        EVERYWHERE.resolve("two.example", 80)


def test_the_environment_cannot_set_a_proxy(web: Web, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("http_proxy", "HTTP_PROXY", "ALL_PROXY", "all_proxy"):
        monkeypatch.setenv(name, web.url(""))
    with pytest.raises(AddressRefused):
        fetch(EVERYWHERE, "http://127.0.0.1:9/x")
    assert web.asked == []


def test_a_post_is_not_redirected(web: Web) -> None:
    web.pages["/hook"] = redirect("/other", 307)
    with GuardedHttp(here("127.0.0.1/32")) as http, http.open("POST", web.url("/hook"), content=b"{}") as answer:
        assert answer.status == 307
    assert web.asked == ["/hook"]


@pytest.mark.parametrize("raw", [b"", b"HTTP/1.1 200 OK\r\nContent-Length: 100\r\n\r\nshort", b"\x00\xff" * 50])
def test_a_server_that_breaks_off_is_worth_another_try(raw: bytes) -> None:
    listener = socket.create_server(("127.0.0.1", 0))

    def answer() -> None:
        peer, _ = listener.accept()
        peer.recv(4096)
        peer.sendall(raw)
        peer.close()

    threading.Thread(target=answer, daemon=True).start()
    with listener, pytest.raises(ServiceError) as caught:
        fetch(here("127.0.0.1/32"), f"http://127.0.0.1:{listener.getsockname()[1]}/v")
    assert caught.value.code == "http_failed"
    assert caught.value.retryable
