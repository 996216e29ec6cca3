"""HTTP to hosts that users name. Every connection, also that of a redirect, goes to an address that was checked.

No proxy of the environment is used: a proxy would resolve names itself, behind the check.
"""

from __future__ import annotations

import contextlib
import ssl
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from types import TracebackType
from urllib.parse import urljoin

import httpcore

from services.domain.errors import AddressRefused, HttpFailed
from services.network.addresses import Endpoint, NetworkPolicy, shown_url

_REDIRECTS = {301, 302, 303, 307, 308}
_MAX_REDIRECTS = 5


@dataclass(frozen=True, slots=True)
class Answer:
    """An answer whose body is read as it comes.

    Attributes:
        url: Where it came from in the end, after redirects.
        headers: Names in lower case; of one that came twice, the last.
        body: The body as it was sent, in pieces.
    """

    url: str
    status: int
    headers: Mapping[str, str]
    body: Iterable[bytes]


class GuardedHttp:
    """A client for `http` and `https`; thread-safe, as a context manager.

    Args:
        policy: Where connections may go.
        connect_timeout_s: For one connection, the handshake included.
        read_timeout_s: For each piece of an answer.
    """

    def __init__(
        self,
        policy: NetworkPolicy,
        *,
        connect_timeout_s: float = 10.0,
        read_timeout_s: float = 30.0,
        user_agent: str = "vipe-cluster",
    ) -> None:
        self._policy = policy
        self._timeouts = {
            "connect": connect_timeout_s,
            "read": read_timeout_s,
            "write": read_timeout_s,
            "pool": connect_timeout_s,
        }
        self._user_agent = user_agent
        self._pool = httpcore.ConnectionPool(
            ssl_context=ssl.create_default_context(),
            max_connections=16,
            max_keepalive_connections=4,
            keepalive_expiry=5.0,
            network_backend=_CheckedBackend(policy),
        )

    def __enter__(self) -> GuardedHttp:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        self._pool.close()

    @contextlib.contextmanager
    def open(
        self,
        method: str,
        url: str,
        *,
        headers: Mapping[str, str] | None = None,
        content: bytes = b"",
        follow_redirects: bool = False,
    ) -> Iterator[Answer]:
        """Send a request and give its answer, whatever its status.

        Args:
            headers: Added to Host, User-Agent and `Accept-Encoding: identity`.
            follow_redirects: Ask again where a 3xx answer points to, each time as strictly as at first.

        Raises:
            AddressRefused: The URL, or what a redirect points to, must not be contacted.
            HttpFailed: No answer came, or it broke off; trying again may help.
        """
        for _ in range(_MAX_REDIRECTS + 1):
            endpoint = self._policy.endpoint(url)
            with self._mapped(url), self._send(method, endpoint, headers or {}, content) as response:
                named = {k.decode("latin-1").lower(): v.decode("latin-1") for k, v in response.headers}
                location = named.get("location")
                if not (follow_redirects and response.status in _REDIRECTS and location):
                    yield Answer(url, response.status, named, self._pieces(url, response))
                    return
            url = _redirected(url, location)
        raise AddressRefused(f"the URL {shown_url(url)} is the end of more than {_MAX_REDIRECTS} redirects")

    def _send(
        self, method: str, endpoint: Endpoint, headers: Mapping[str, str], content: bytes
    ) -> contextlib.AbstractContextManager[httpcore.Response]:
        # From parts, so that no second parser can read the URL in another way than the check did.
        url = httpcore.URL(
            scheme=endpoint.scheme.encode(),
            host=endpoint.host.encode(),
            port=endpoint.port,
            target=endpoint.target.encode("ascii"),
        )
        all_headers = {
            "Host": endpoint.authority,
            "User-Agent": self._user_agent,
            "Accept-Encoding": "identity",
            **({"Content-Length": str(len(content))} if content or method not in ("GET", "HEAD") else {}),
            **headers,
        }
        return self._pool.stream(
            method,
            url,
            headers=[(name.encode("ascii"), value.encode("latin-1")) for name, value in all_headers.items()],
            content=content or None,
            extensions={"timeout": self._timeouts},
        )

    def _pieces(self, url: str, response: httpcore.Response) -> Iterator[bytes]:
        with self._mapped(url):
            yield from response.iter_stream()

    @contextlib.contextmanager
    def _mapped(self, url: str) -> Iterator[None]:
        try:
            yield
        except httpcore.TimeoutException as error:
            raise HttpFailed(f"{shown_url(url)} did not answer in time") from error
        except (httpcore.NetworkError, httpcore.ProtocolError, httpcore.UnsupportedProtocol, ssl.SSLError) as error:
            reason = next(iter(str(error).splitlines()), "") or type(error).__name__
            raise HttpFailed(f"{shown_url(url)} cannot be read: {reason[:200]}") from error


class _CheckedBackend(httpcore.SyncBackend):
    """Opens connections to checked addresses only."""

    def __init__(self, policy: NetworkPolicy) -> None:
        super().__init__()
        self._policy = policy

    def connect_tcp(
        self,
        host: str,
        port: int,
        timeout: float | None = None,
        local_address: str | None = None,
        socket_options: Iterable[httpcore.SOCKET_OPTION] | None = None,
    ) -> httpcore.NetworkStream:
        failure: httpcore.ConnectError | httpcore.ConnectTimeout | None = None
        for address in self._policy.resolve(host, port):
            try:
                return super().connect_tcp(address, port, timeout, local_address, socket_options)
            except (httpcore.ConnectError, httpcore.ConnectTimeout) as error:
                failure = error
        assert failure is not None, "a host has at least one address"
        raise failure

    def connect_unix_socket(
        self,
        path: str,
        timeout: float | None = None,
        socket_options: Iterable[httpcore.SOCKET_OPTION] | None = None,
    ) -> httpcore.NetworkStream:
        raise AddressRefused(f"no connection to the socket {path!r} is ever made for a user")


def _redirected(url: str, location: str) -> str:
    try:
        target = urljoin(url, location)
    except ValueError as error:
        raise AddressRefused(f"the URL {shown_url(url)} redirects to what is no URL") from error
    if url.startswith("https://") and not target.startswith("https://"):
        raise AddressRefused(f"the URL {shown_url(url)} redirects from https to {shown_url(target)}")
    return target
