"""Which hosts and which network addresses the service may connect to on behalf of a user.

Two questions, asked separately. Whether a URL names a host that the operator allows is asked of the URL. Whether an
address may be connected to is asked of the numbers that the name resolved to, and the connection is made to exactly
these numbers: a name that resolves differently the second time gains nothing.
"""

from __future__ import annotations

import ipaddress
import re
import socket
from collections.abc import Sequence
from dataclasses import dataclass
from ipaddress import IPv4Address, IPv4Network, IPv6Address, IPv6Network
from urllib.parse import SplitResult, urlsplit

from services.domain.errors import AddressRefused, NameUnresolved

Network = IPv4Network | IPv6Network
Address = IPv4Address | IPv6Address

_DEFAULT_PORTS = {"http": 80, "https": 443}
_UNSAFE = re.compile(r"[\x00-\x20\x7f-\x9f\\]")
_LABEL = re.compile(r"[a-z0-9_]([a-z0-9_-]{0,61}[a-z0-9])?")
_PATTERN = re.compile(r"(?P<host>\*|(\*\.)?[a-z0-9_.-]+|\[[0-9a-f:.]+\])(:(?P<port>\d{1,5}|\*))?")

# What `is_global` lets through, in one Python release or another, although it is nobody's public address.
_NOT_PUBLIC: tuple[tuple[Network, str], ...] = (
    (ipaddress.ip_network("100.64.0.0/10"), "shared by carriers"),
    (ipaddress.ip_network("192.0.0.0/24"), "reserved"),
    (ipaddress.ip_network("192.88.99.0/24"), "a relay"),
    (ipaddress.ip_network("::/96"), "an IPv4 address in disguise"),
    (ipaddress.ip_network("::ffff:0:0:0/96"), "an IPv4 address in disguise"),
    (ipaddress.ip_network("64:ff9b:1::/48"), "a private translator"),
    (ipaddress.ip_network("100::/64"), "reserved"),
    (ipaddress.ip_network("2001::/23"), "reserved"),
    (ipaddress.ip_network("2002::/16"), "a relay"),
    (ipaddress.ip_network("3fff::/20"), "reserved"),
    (ipaddress.ip_network("5f00::/16"), "reserved"),
    (ipaddress.ip_network("fec0::/10"), "private"),
)
_NAT64 = ipaddress.ip_network("64:ff9b::/96")


@dataclass(frozen=True, slots=True)
class Endpoint:
    """Where a URL that was allowed points to.

    Attributes:
        host: Lower case, in the ASCII form of international names; an IPv6 address without brackets.
        target: Path and query as they go into the request line.
    """

    scheme: str
    host: str
    port: int
    target: str

    @property
    def authority(self) -> str:
        """`host` or `host:port` as the Host header has it."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return host if self.port == _DEFAULT_PORTS[self.scheme] else f"{host}:{self.port}"

    @property
    def origin(self) -> str:
        return f"{self.scheme}://{self.authority}"


@dataclass(frozen=True, slots=True)
class NetworkPolicy:
    """Where connections may go.

    Attributes:
        hosts: Patterns: `media.example.org`, `*.example.org` (every name below it), `*` (every name). Ports are those
            of the scheme; `media.example.org:8443` and `media.example.org:*` allow another, or all.
        networks: Networks that are not public and that may be reached nevertheless, such as `10.1.0.0/16`.
        schemes: What a URL may begin with.
    """

    hosts: tuple[str, ...] = ()
    networks: tuple[Network, ...] = ()
    schemes: tuple[str, ...] = ("https", "http")

    def __post_init__(self) -> None:
        for pattern in self.hosts:
            if _PATTERN.fullmatch(pattern) is None:
                raise ValueError(
                    f"{pattern!r} is no pattern of hosts; write host, *.domain or *, each with or without :port"
                )

    def endpoint(self, url: str) -> Endpoint:
        """Read a URL and check its scheme, host and port.

        Raises:
            AddressRefused: It cannot be read in one way only, carries credentials, or names a host or port that is not
                allowed.
        """
        shown = shown_url(url)
        if _UNSAFE.search(url):
            raise AddressRefused(f"the URL {shown} holds white space, a control character or a backslash")
        try:
            parts = urlsplit(url)
            port = parts.port
            host = _normal_host(parts)
        except ValueError as error:
            raise AddressRefused(f"the URL {shown} cannot be read: {error}") from error
        if parts.scheme not in self.schemes or parts.scheme not in _DEFAULT_PORTS:
            raise AddressRefused(f"the URL {shown} must begin with {' or '.join(f'{s}://' for s in self.schemes)}")
        if "@" in parts.netloc:
            raise AddressRefused(f"the URL {shown} must not hold a user name or a password")
        if not (parts.path + parts.query).isascii():
            raise AddressRefused(f"the path of the URL {shown} must be percent-encoded")
        port = _DEFAULT_PORTS[parts.scheme] if port is None else port
        if not any(_matches(pattern, host, port, parts.scheme) for pattern in self.hosts):
            allowed = ", ".join(self.hosts) or "none"
            raise AddressRefused(f"the URL {shown} names a host or port that is not allowed; allowed: {allowed}")
        target = (parts.path or "/") + (f"?{parts.query}" if parts.query else "")
        return Endpoint(parts.scheme, host, port, target)

    def refusal(self, address: str | Address) -> str | None:
        """Why an address must not be connected to; None if it may be."""
        parsed = ipaddress.ip_address(address)
        if any(parsed in network for network in self.networks):
            return None
        inner = _embedded(parsed)
        if inner is not None and any(inner in network for network in self.networks):
            return None
        return refusal_of(parsed)

    def resolve(self, host: str, port: int) -> tuple[str, ...]:
        """The addresses of a host that may be connected to, in the resolver's order.

        Raises:
            AddressRefused: It has addresses, but one of them must not be connected to.
            NameUnresolved: It has none, or the resolver does not answer.
        """
        try:
            found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, proto=socket.IPPROTO_TCP)
        except (OSError, UnicodeError) as error:
            reason = error.strerror if isinstance(error, OSError) else "not a name"
            raise NameUnresolved(f"the host {host!r} cannot be resolved: {reason}") from error
        addresses = tuple(dict.fromkeys(str(entry[4][0]) for entry in found))
        for address in addresses:
            # One is enough: a name with a public and a private address is how checks of the first one are passed.
            if reason := self.refusal(address):
                raise AddressRefused(
                    f"the host {host!r} has the address {address}, which is {reason}; it is not allowed"
                )
        if not addresses:
            raise NameUnresolved(f"the host {host!r} has no address")
        return addresses


def refusal_of(address: Address) -> str | None:
    """Why an address is not a public one of a single machine, in words that fit behind "which is"; None if it is."""
    if getattr(address, "scope_id", None):
        return "link-local"
    inner = _embedded(address)
    if inner is not None:
        return refusal_of(inner)
    named: Sequence[tuple[bool, str]] = (
        (address.is_unspecified, "unspecified"),
        (address.is_loopback, "loopback"),
        (address.is_link_local, "link-local"),
        (address.is_multicast, "multicast"),
    )
    for applies, reason in named:
        if applies:
            return reason
    for network, reason in _NOT_PUBLIC:
        if address in network:
            return reason
    return "private" if address.is_private else None if address.is_global else "reserved"


def shown_url(url: str) -> str:
    """A URL for messages: without the credentials, query and fragment it may carry, and not too long."""
    text = "".join(c if c.isprintable() else "?" for c in url)
    bare = text.partition("?")[0].partition("#")[0]
    scheme, mark, rest = bare.partition("://")
    authority, slash, path = rest.partition("/")
    return f"{scheme}{mark}{authority.rpartition('@')[2]}{slash}{path}"[:300]


def _embedded(address: Address) -> IPv4Address | None:
    """The IPv4 address that a translator on the way would connect to."""
    if isinstance(address, IPv6Address):
        if address.ipv4_mapped is not None:
            return address.ipv4_mapped
        if address in _NAT64:
            return IPv4Address(int(address) & 0xFFFFFFFF)
    return None


def _normal_host(parts: SplitResult) -> str:
    host = parts.hostname
    if not host:
        raise ValueError("it names no host")
    if ":" in host:
        return str(IPv6Address(host)) if "%" not in host else _no_zone()
    host = host.removesuffix(".")
    if not host.isascii():
        host = host.encode("idna").decode("ascii")
    if len(host) > 253 or not all(_LABEL.fullmatch(label) for label in host.split(".")):
        raise ValueError("its host is no valid name")
    return host


def _no_zone() -> str:
    raise ValueError("an address must not name a zone")


def _matches(pattern: str, host: str, port: int, scheme: str) -> bool:
    match = _PATTERN.fullmatch(pattern)
    assert match is not None, "checked when the policy was made"
    wanted, wanted_port = match["host"].strip("[]"), match["port"]
    if wanted_port is None:
        port_fits = port == _DEFAULT_PORTS[scheme]
    else:
        port_fits = wanted_port == "*" or int(wanted_port) == port
    if wanted == "*":
        return port_fits
    host_fits = host.endswith(wanted[1:]) if wanted.startswith("*.") else host == wanted
    return port_fits and host_fits
