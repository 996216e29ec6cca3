"""From an address to a store, and the question whether a store can decide a commit."""

from __future__ import annotations

import os
import secrets
from urllib.parse import unquote, urlsplit

from services.domain.errors import InvalidRequest
from services.storage.base import ObjectStore
from services.storage.directory import DirectoryStore
from services.storage.observer import StorageObserver
from services.storage.s3 import S3Store

ENDPOINT_VARIABLE = "VIPE_S3_ENDPOINT_URL"


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

    Some S3 services ignore `If-None-Match`; on those the commit protocol would lose data without a word, so a service
    asks this once for each output before it writes. Tries with a probe object and removes it.

    Raises:
        StorageError: The store refuses to be written at all.
    """
    key = f"_probe/{secrets.token_hex(8)}"
    try:
        first = store.create(key, b"first")
        second = store.create(key, b"second")
        return first and not second and store.get_bytes(key) == b"first"
    finally:
        store.delete(key)
