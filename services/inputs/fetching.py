"""A planned video as a local path, for as long as a worker needs it."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from urllib.parse import urlsplit

from services.domain.errors import InputTooLarge, InputUnavailable
from services.domain.models import VideoRef
from services.inputs.download import download
from services.inputs.rules import WEB_SCHEMES, InputRules
from services.network.http import GuardedHttp
from services.storage.base import ObjectStore
from services.storage.observer import StorageObserver
from services.storage.open import open_store

_MAX_SUFFIX = 10


@dataclass(frozen=True, slots=True)
class Fetched:
    """A local path of a video, and the seconds that it took to get it (0 where it was there)."""

    path: Path
    seconds: float


@contextmanager
def fetched(
    video: VideoRef,
    rules: InputRules,
    place: Callable[[str], Path],
    *,
    s3_endpoint_url: str | None = None,
    observer: StorageObserver | None = None,
) -> Iterator[Fetched]:
    """Make a video readable under a local path; what was made for it is removed at the end.

    Args:
        place: A path in an empty folder of the worker's own, for a suffix.
        s3_endpoint_url: S3 service other than AWS.
        observer: Receives the traffic of object stores.

    Raises:
        InputUnavailable: It does not exist any more, may not be read, or has changed since the job was planned.
        InputTooLarge: It has more bytes than `rules` allow.
        AddressRefused: `rules` do not allow its address.
        HttpFailed, StorageError: Whoever has it does not answer.
    """
    started = time.perf_counter()
    if not video.uri.startswith(("s3://", *WEB_SCHEMES)):
        with _pinned(video.uri, rules, place) as path:
            yield Fetched(path, 0.0)
        return
    rules.check(video.uri)
    path = place(_suffix(urlsplit(video.uri).path))
    try:
        if video.uri.startswith("s3://"):
            bucket, _, key = video.uri.removeprefix("s3://").partition("/")
            store = open_store(f"s3://{bucket}", endpoint_url=s3_endpoint_url, observer=observer)
            _download_object(video, store, key, rules, path)
        else:
            with GuardedHttp(rules.network) as http:
                size_bytes = download(http, video.uri, path, max_bytes=rules.max_file_bytes, etag=video.etag)
            if observer is not None:
                observer.transferred("get", size_bytes)
        yield Fetched(path, round(time.perf_counter() - started, 4))
    finally:
        path.unlink(missing_ok=True)


@contextmanager
def _pinned(uri: str, rules: InputRules, place: Callable[[str], Path]) -> Iterator[Path]:
    """The file that was judged, whatever becomes of its name: a link to the open descriptor, where there is one."""
    if not rules.roots:
        yield Path(uri)
        return
    descriptor = rules.open_local(uri)
    try:
        opened = Path(f"/proc/{os.getpid()}/fd/{descriptor}")
        if not opened.exists():
            yield Path(uri)
            return
        link = place(_suffix(uri))
        link.symlink_to(opened)
        try:
            yield link
        finally:
            link.unlink(missing_ok=True)
    finally:
        os.close(descriptor)


def _download_object(video: VideoRef, store: ObjectStore, key: str, rules: InputRules, path: Path) -> None:
    info = store.head(key)
    if info is None:
        raise InputUnavailable(f"{video.uri} does not exist any more")
    if info.size_bytes > rules.max_file_bytes:
        raise InputTooLarge(f"{video.uri} has more than the {rules.max_file_bytes} bytes that are allowed")
    if video.etag is not None and info.etag != video.etag:
        raise InputUnavailable(f"{video.uri} is not what it was when the job was planned")
    store.download(key, path)


def _suffix(path: str) -> str:
    """The suffix of a name where it is a plain one: decoders choose between containers by it."""
    suffix = PurePosixPath(path).suffix
    return suffix if len(suffix) <= _MAX_SUFFIX and suffix[1:].isalnum() and suffix.isascii() else ""
