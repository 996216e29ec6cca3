"""Buckets, addresses and keys in work, without a server."""

from __future__ import annotations

from pathlib import Path

import pytest

from services.api.audit import AuditTrail
from services.api.authentication import REVOCATION_S, Authenticator
from services.api.idempotency import KeysInWork
from services.api.limits import StreamLimit, TokenBuckets, address_of
from services.api.problems import TooManyStreams, Unauthorized
from services.domain.access import AuditEntry
from services.domain.errors import IdempotencyInFlight
from services.settings import Settings
from services.store.sql import SqlStore


class Clock:
    now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def test_buckets_refill() -> None:
    clock = Clock()
    buckets = TokenBuckets(rate_per_s=2.0, burst=3, clock=clock)
    for _ in range(3):
        assert buckets.wait_s("a") == 0
        buckets.take("a")
    assert buckets.wait_s("a") == pytest.approx(0.5)
    assert buckets.wait_s("b") == 0
    clock.now_s += 0.5
    assert buckets.wait_s("a") == pytest.approx(0)
    clock.now_s += 3600
    for _ in range(3):
        assert buckets.wait_s("a") == 0
        buckets.take("a")
    assert buckets.wait_s("a") > 0, "no more than the burst is saved up"


@pytest.mark.parametrize(
    ("client", "name"),
    [
        (("10.0.0.1", 1), "10.0.0.1"),
        (("2001:db8:1:2:3:4:5:6", 1), "2001:db8:1:2::/64"),
        (("2001:db8:1:2:ffff::1", 1), "2001:db8:1:2::/64"),
        (("::ffff:10.0.0.1", 1), "10.0.0.1"),
        (("::1", 1), "::1"),
        (("fe80::1%eth0", 1), "fe80::/64"),
        (("/run/proxy.sock", 0), "/run/proxy.sock"),
        (None, "unknown"),
    ],
)
def test_addresses(client: tuple[str, int] | None, name: str) -> None:
    assert address_of({"type": "http", "client": client}) == name


def test_streams_are_counted_while_they_are_open() -> None:
    limit = StreamLimit(1)
    with limit.hold("a"), limit.hold("b"), pytest.raises(TooManyStreams), limit.hold("a"):
        pass
    with limit.hold("a"):
        pass


def test_a_key_is_worked_on_once() -> None:
    working = KeysInWork()
    with working.on("a", "k"), working.on("b", "k"), working.on("a", None), working.on("a", None):
        again = working.on("a", "k")
        with pytest.raises(IdempotencyInFlight):
            again.__enter__()
    with pytest.raises(ZeroDivisionError), working.on("a", "k"):
        raise ZeroDivisionError
    with working.on("a", "k"):
        pass


def test_what_is_remembered_of_a_key(tmp_path: Path) -> None:
    store = SqlStore(f"sqlite:///{tmp_path}/store.db")
    clock = Clock()
    authenticator = Authenticator(store, Settings(), clock)
    made, key = store.create_key("x", tenant="a")
    assert authenticator.remembered(key) is None
    caller = authenticator.verify(key)
    assert (caller.tenant, caller.key_id) == ("a", made.id)
    store.revoke_key(made.id)
    clock.now_s += REVOCATION_S - 0.1
    assert authenticator.remembered(key) == caller
    clock.now_s += 0.1
    assert authenticator.remembered(key) is None, "no longer than promised"
    with pytest.raises(Unauthorized, match="revoked"):
        authenticator.verify(key)
    assert not authenticator.seen(key)
    assert not authenticator.holds(caller)
    store.close()


def test_refused_keys_are_counted_at_a_bounded_rate(tmp_path: Path) -> None:
    store = SqlStore(f"sqlite:///{tmp_path}/store.db")
    clock = Clock()
    trail = AuditTrail(store, clock)

    def knock(address: str) -> None:
        trail.refused(AuditEntry(None, None, address, "r", "authenticate", "/v1/jobs", 401, "unauthorized"))

    for number in range(1000):
        knock(f"10.0.{number % 200}.1")
    entries = [event.entry for event in store.audit("default", limit=1000)[0]]
    assert len(entries) == 21
    assert entries[0].address == "others"
    clock.now_s += 61
    trail.flush()
    entries = [event.entry for event in store.audit("default", limit=1000)[0]]
    assert len(entries) == 42
    assert sum(entry.count for entry in entries) == 1000
    knock("10.0.0.1")
    trail.close()
    assert len(store.audit("default", limit=1000)[0]) == 43
    store.close()
