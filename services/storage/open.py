"""From an address to a store, and the question whether a store can decide a commit."""

from __future__ import annotations

import os
import secrets
import threading
from concurrent.futures import ThreadPoolExecutor
from urllib.parse import unquote, urlsplit

from services.domain.errors import ConditionUnsupported, InvalidRequest
from services.storage.base import ObjectStore
from services.storage.directory import DirectoryStore
from services.storage.observer import StorageObserver
from services.storage.s3 import S3Store

ENDPOINT_VARIABLE = "VIPE_S3_ENDPOINT_URL"
# Writers that come within a few milliseconds of each other, several times: a service that looks before it writes lets
# two through in most rounds.
_PROBE_WRITERS = 6
_PROBE_RACES = 5


def open_store(uri: str, *, endpoint_url: str | None = None, observer: StorageObserver | None = None) -> ObjectStore:
    """Open the store at `uri`. Nothing is contacted or created yet.

    Args:
        uri: An absolute path, `file:///path`, or `s3://bucket[/prefix]`.
        endpoint_url: S3 service other than AWS; default: the environment's `VIPE_S3_ENDPOINT_URL`, then what boto3
            finds (`AWS_ENDPOINT_URL_S3`, profile).
        observer: Receives the traffic.

    Raises:
        InvalidRequest: Not an address of these kinds.
    """
    if uri.startswith("/"):
        return DirectoryStore(uri, observer=observer)
    parts = urlsplit(uri)
    if parts.query or parts.fragment:
        raise InvalidRequest(f"the address {uri!r} must not hold '?' or '#'")
    if parts.scheme == "file" and parts.netloc in ("", "localhost") and parts.path.startswith("/"):
        return DirectoryStore(unquote(parts.path), observer=observer)
    if parts.scheme == "s3" and parts.netloc and "@" not in parts.netloc:
        endpoint = endpoint_url or os.environ.get(ENDPOINT_VARIABLE) or None
        return S3Store(parts.netloc, parts.path, endpoint_url=endpoint, observer=observer)
    raise InvalidRequest(f"the address {uri!r} must be an absolute path, file:///path or s3://bucket/prefix")


def supports_create_once(store: ObjectStore) -> bool:
    """Whether `create` really lets only the first writer through.

    Some S3 services ignore `If-None-Match`, some refuse it, and some look first and write afterwards, so that it holds
    only as long as nobody else writes. Tries all of it with probe objects and removes them.

    Raises:
        StorageError: The store refuses to be written at all.
    """
    folder = f"_probe/{secrets.token_hex(8)}"
    keys = [f"{folder}/{number}" for number in range(_PROBE_RACES)]
    try:
        first = store.create(keys[0], b"first")
        second = store.create(keys[0], b"second")
        if not first or second or store.get_bytes(keys[0]) != b"first":
            return False
        return all(_one_wins(store, key) for key in keys[1:])
    except ConditionUnsupported:
        store.put_bytes(keys[0], b"plain")  # or the output cannot be written in any way
        return False
    finally:
        for key in keys:
            store.delete(key)


def _one_wins(store: ObjectStore, key: str) -> bool:
    """Whether of several writers at once exactly one is told that it was the first, and it is its object that stays."""
    start = threading.Barrier(_PROBE_WRITERS)

    def write(number: int) -> bool:
        start.wait()
        return store.create(key, b"%d" % number)

    with ThreadPoolExecutor(_PROBE_WRITERS) as pool:
        told = list(pool.map(write, range(_PROBE_WRITERS)))
    # Nobody may have been told so: the answer was lost and the request sent again. More than one must not.
    winners = [b"%d" % number for number, first in enumerate(told) if first]
    return not winners or winners == [store.get_bytes(key)]
