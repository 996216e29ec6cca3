"""A planned video as a local path, for as long as a worker needs it."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import BinaryIO
from urllib.parse import urlsplit

from services.domain.errors import InputTooLarge, InputUnavailable
from services.domain.models import VideoRef
from services.inputs.download import download
from services.inputs.rules import WEB_SCHEMES, InputRules
from services.inputs.tars import HEADER_BUFFER_BYTES, Member, as_member, find_member, is_tar
from services.network.http import GuardedHttp
from services.storage.base import ObjectStore
from services.storage.object_file import open_object
from services.storage.observer import StorageObserver
from services.storage.open import open_store

_MAX_SUFFIX = 10
_COPY_BYTES = 8 << 20


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
    if (member := as_member(video.uri)) is not None:
        path = place(_suffix(member.name))
        try:
            with _opened_tar(member, video, rules, s3_endpoint_url, observer) as tar:
                _extract(tar, member, video, rules, path)
            yield Fetched(path, round(time.perf_counter() - started, 4))
        finally:
            path.unlink(missing_ok=True)
        return
    if is_tar(video.uri):
        raise InputUnavailable(f"{video.uri} was not a readable tar of videos when the job was planned")
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
    size_bytes = _unchanged(video, store, key)
    if size_bytes > rules.max_file_bytes:
        raise InputTooLarge(f"{video.uri} has more than the {rules.max_file_bytes} bytes that are allowed")
    store.download(key, path)


def _unchanged(video: VideoRef, store: ObjectStore, key: str) -> int:
    """The bytes of an object that is still what it was."""
    info = store.head(key)
    if info is None:
        raise InputUnavailable(f"{video.uri} does not exist any more")
    if video.etag is not None and info.etag != video.etag:
        raise InputUnavailable(f"{video.uri} is not what it was when the job was planned")
    return info.size_bytes


@contextmanager
def _opened_tar(
    member: Member, video: VideoRef, rules: InputRules, s3_endpoint_url: str | None, observer: StorageObserver | None
) -> Iterator[BinaryIO]:
    """The tar of a member, seekable, once it is known to be allowed and unchanged."""
    rules.check(member.tar)
    if member.tar.startswith("s3://"):
        bucket, _, key = member.tar.removeprefix("s3://").partition("/")
        store = open_store(f"s3://{bucket}", endpoint_url=s3_endpoint_url, observer=observer)
        size_bytes = _unchanged(video, store, key)
        with open_object(store, key, 0, size_bytes, buffer_bytes=HEADER_BUFFER_BYTES) as remote:
            yield remote
    elif member.tar.startswith(WEB_SCHEMES):
        raise InputUnavailable(f"{member.tar} cannot be read in parts; copy it to S3 or to a disk")
    else:
        with os.fdopen(rules.open_local(member.tar), "rb") as local:
            yield local


def _extract(tar: BinaryIO, member: Member, video: VideoRef, rules: InputRules, path: Path) -> None:
    start, size_bytes = member.start, video.size_bytes
    if start is None or not size_bytes:
        start, size_bytes = find_member(tar, member)
    if size_bytes > rules.max_file_bytes:
        raise InputTooLarge(f"{video.uri} has more than the {rules.max_file_bytes} bytes that are allowed")
    tar.seek(start)
    left = size_bytes
    with path.open("wb") as file:
        while left and (data := tar.read(min(left, _COPY_BYTES))):
            file.write(data)
            left -= len(data)
    if left:
        raise InputUnavailable(f"{video.uri} is not what it was when the job was planned: the tar ends before it does")


def _suffix(path: str) -> str:
    """The suffix of a name where it is a plain one: decoders choose between containers by it."""
    suffix = PurePosixPath(path).suffix
    return suffix if len(suffix) <= _MAX_SUFFIX and suffix[1:].isalnum() and suffix.isascii() else ""
