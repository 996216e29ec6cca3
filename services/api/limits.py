"""How much one caller may ask for: requests per second, and streams at the same time. Kept in this process."""

from __future__ import annotations

import ipaddress
import time
from collections import Counter, OrderedDict
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from starlette.types import Scope

from services.api.problems import TooManyStreams

_MAX_BUCKETS = 10_000


def address_of(scope: Scope) -> str:
    """Where a request comes from, as far as one owner goes: an IPv6 host has its whole /64 to choose from."""
    client = scope.get("client")
    if not client:
        return "unknown"
    try:
        address = ipaddress.ip_address(client[0].partition("%")[0])
    except ValueError:
        return str(client[0])[:64]
    if isinstance(address, ipaddress.IPv6Address):
        if address.ipv4_mapped is not None:
            return str(address.ipv4_mapped)
        if not address.is_loopback:
            return str(ipaddress.ip_network((address, 64), strict=False))
    return str(address)


class TokenBuckets:
    """A bucket of `burst` tokens for each name, refilled with `rate_per_s`. Used in the event loop only.

    The names that were heard of last are remembered; one that is forgotten begins with a full bucket, which it had or
    will have soon.
    """

    def __init__(self, rate_per_s: float, burst: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._rate_per_s = rate_per_s
        self._burst = burst
        self._clock = clock
        self._buckets: OrderedDict[str, tuple[float, float]] = OrderedDict()  # name -> (tokens, at)

    def wait_s(self, name: str) -> float:
        """How long until there is a token; 0 if there is one."""
        return max(0.0, (1.0 - self._tokens(name)) / self._rate_per_s)

    def take(self, name: str) -> None:
        """Take a token, also one that is not there yet."""
        self._buckets[name] = (self._tokens(name) - 1.0, self._clock())
        self._buckets.move_to_end(name)
        if len(self._buckets) > _MAX_BUCKETS:
            self._buckets.popitem(last=False)

    def _tokens(self, name: str) -> float:
        tokens, at = self._buckets.get(name, (self._burst, self._clock()))
        return min(self._burst, tokens + (self._clock() - at) * self._rate_per_s)


class StreamLimit:
    """Counts open streams by caller. Used in the event loop only."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._open: Counter[str] = Counter()

    @contextmanager
    def hold(self, name: str) -> Iterator[None]:
        """One more stream while the context lasts.

        Raises:
            TooManyStreams: The caller has as many as it may.
        """
        if self._open[name] >= self._most:
            raise TooManyStreams(f"{self._most} event streams are open already; close one, or poll the job instead")
        self._open[name] += 1
        try:
            yield
        finally:
            self._open[name] -= 1
            if not self._open[name]:
                del self._open[name]
