"""Expand inputs into videos: directories, files, tars, S3 objects and prefixes, web addresses, and lists of these.

One video at a time, in a fixed order, in bounded memory.
"""

from __future__ import annotations

import os
import stat
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import BinaryIO
from urllib.parse import urlsplit

from services.domain.errors import (
    InputTooLarge,
    InputUnavailable,
    InvalidManifest,
    ObjectMissing,
    ServiceError,
)
from services.inputs.download import download, look
from services.inputs.rules import WEB_SCHEMES, InputRules
from services.inputs.tars import HEADER_BUFFER_BYTES, as_member, is_tar, list_members
from services.network.http import GuardedHttp
from services.planner.manifest import Row, is_manifest, read_manifest
from services.storage.object_file import open_object
from services.storage.open import open_store
from services.storage.roots import lies_within

VIDEO_EXTENSIONS = frozenset(
    {".mp4", ".mov", ".mkv", ".webm", ".avi", ".m4v", ".mpg", ".mpeg", ".ts", ".gif"},
)
_MAX_MANIFEST_BYTES = 8 << 30
IMAGE_EXTENSIONS = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp"})


@dataclass(frozen=True, slots=True)
class Found:
    """A video as listed.

    Attributes:
        size_bytes: 0 where nobody says.
        etag: What tells whether it changes until it is fetched, where there is one.
        key: The key that its list gives it.
    """

    uri: str
    size_bytes: int
    etag: str | None = None
    key: str | None = None


def expand(uri: str, rules: InputRules | None = None, *, s3_endpoint_url: str | None = None) -> Iterator[Found]:
    """The videos of one input.

    A directory is walked recursively in name order; names that start with a dot are left out, and so are links that
    leave the directory and links to directories. A directory without videos but with images is one video. A file is
    one video whatever its name, unless it is a list (`.csv`, `.jsonl`, `.parquet`; see `planner.manifest`) or a tar
    (`.tar`, also below a directory or a prefix): of that, every member whose name is a video's (see `inputs.tars`).

    Args:
        uri: An absolute path, `s3://bucket/key`, `s3://bucket/prefix/`, or `http(s)://host/path`.
        rules: What may be named; by default what `InputRules()` says.
        s3_endpoint_url: S3 service other than AWS.

    Raises:
        InputUnavailable: It does not exist, is not readable, lies outside of the roots, or holds no video.
        InvalidManifest, InputTooLarge: A list that is not understood, or an input above the limits.
        AddressRefused, InvalidRequest: An address that must not be named.
        HttpFailed, StorageError: Whoever has it does not answer.
    """
    rules = rules or InputRules()
    rules.check(uri)
    for video in _expand(uri, rules, s3_endpoint_url):
        try:
            video.uri.encode()
        except UnicodeEncodeError:
            raise InputUnavailable(f"the name of {video.uri!a} is not valid UTF-8; rename the file") from None
        yield video


def _expand(uri: str, rules: InputRules, s3_endpoint_url: str | None) -> Iterator[Found]:
    if as_member(uri) is not None:
        yield Found(uri, 0)
    elif is_manifest(urlsplit(uri).path if uri.startswith(WEB_SCHEMES) else uri) and not Path(uri).is_dir():
        yield from _expand_manifest(uri, rules, s3_endpoint_url)
    elif uri.startswith("s3://"):
        yield from _expand_s3(uri, s3_endpoint_url)
    elif uri.startswith(WEB_SCHEMES):
        uri = uri.partition("#")[0]
        with GuardedHttp(rules.network) as http:
            found = look(http, uri)
        if found.size_bytes > rules.max_file_bytes:
            raise InputTooLarge(f"{uri} has more than the {rules.max_file_bytes} bytes that are allowed")
        yield Found(uri, found.size_bytes, found.etag)
    else:
        yield from _expand_local(uri, rules)


def _expand_manifest(uri: str, rules: InputRules, s3_endpoint_url: str | None) -> Iterator[Found]:
    name = urlsplit(uri).path if uri.startswith(WEB_SCHEMES) else uri
    name = name.rstrip("/").rsplit("/", 1)[-1]
    with _local_copy(uri, rules, s3_endpoint_url) as file:
        for row in read_manifest(file, name, max_rows=rules.max_rows):
            yield _listed(row, name, rules)


def _listed(row: Row, name: str, rules: InputRules) -> Found:
    """The video of a row. Whether it exists is not asked: one that does not becomes a failed video."""
    try:
        rules.check(row.uri)
    except ServiceError as error:
        raise InvalidManifest(f"{name}, row {row.number}: {error}") from error
    if as_member(row.uri) is not None:
        return Found(row.uri, row.size_bytes, row.etag, row.key)
    if row.uri.startswith(WEB_SCHEMES):
        return Found(row.uri.partition("#")[0], row.size_bytes, row.etag, row.key)
    if row.uri.startswith("s3://"):
        if row.uri.endswith("/"):
            raise InvalidManifest(f"{name}, row {row.number}: {row.uri} is a prefix; a row names one video")
        return Found(row.uri, row.size_bytes, row.etag, row.key)
    path = os.path.normpath(row.uri)
    try:
        size_bytes = row.size_bytes or Path(path).stat().st_size
    except OSError:
        size_bytes = 0
    return Found(path, size_bytes, None, row.key)


@contextmanager
def _local_copy(uri: str, rules: InputRules, s3_endpoint_url: str | None) -> Iterator[BinaryIO]:
    """A list as a file that can be read in any order."""
    with tempfile.TemporaryDirectory(prefix="manifest-") as folder:
        copy = Path(folder, "manifest")
        if uri.startswith("s3://"):
            bucket, _, key = uri.removeprefix("s3://").partition("/")
            store = open_store(f"s3://{bucket}", endpoint_url=s3_endpoint_url)
            info = store.head(key)
            if info is None:
                raise InputUnavailable(f"there is no object {uri}")
            _check_manifest_size(uri, info.size_bytes, rules)
            store.download(key, copy)
        elif uri.startswith(WEB_SCHEMES):
            with GuardedHttp(rules.network) as http:
                download(http, uri, copy, max_bytes=min(rules.max_file_bytes, _MAX_MANIFEST_BYTES))
        else:
            descriptor = rules.open_local(uri)
            with os.fdopen(descriptor, "rb") as local:
                _check_manifest_size(uri, os.fstat(descriptor).st_size, rules)
                yield local
            return
        with copy.open("rb") as file:
            yield file


def _check_manifest_size(uri: str, size_bytes: int, rules: InputRules) -> None:
    if size_bytes > min(rules.max_file_bytes, _MAX_MANIFEST_BYTES):
        raise InputTooLarge(f"the list {uri} has {size_bytes} bytes; split it into several jobs")


def _expand_s3(uri: str, endpoint_url: str | None) -> Iterator[Found]:
    bucket, _, key = uri.removeprefix("s3://").partition("/")
    try:
        if key and not key.endswith("/"):
            info = open_store(f"s3://{bucket}", endpoint_url=endpoint_url).head(key)
            if info is None:
                raise InputUnavailable(f"there is no object {uri}; a prefix must end in '/'")
            named = Found(uri, info.size_bytes, info.etag)
            yield from _named(named, partial(_open_s3, named, endpoint_url))
            return
        empty = True
        for info in open_store(f"s3://{bucket}/{key}".rstrip("/"), endpoint_url=endpoint_url).list():
            below = Found(f"s3://{bucket}/{key}{info.key}", info.size_bytes, info.etag)
            for video in _met(below, partial(_open_s3, below, endpoint_url)):
                empty = False
                yield video
    except ObjectMissing as error:
        raise InputUnavailable(f"cannot read {uri}: {error}") from error
    if empty:
        raise InputUnavailable(f"no videos found under {uri}")


def _open_s3(tar: Found, endpoint_url: str | None) -> BinaryIO:
    bucket, _, key = tar.uri.removeprefix("s3://").partition("/")
    store = open_store(f"s3://{bucket}", endpoint_url=endpoint_url)
    return open_object(store, key, 0, tar.size_bytes, buffer_bytes=HEADER_BUFFER_BYTES)


def _open_local(path: Path, rules: InputRules) -> BinaryIO:
    return os.fdopen(rules.open_local(str(path)), "rb")


def _named(file: Found, opened: Callable[[], BinaryIO]) -> Iterator[Found]:
    """A file that the user named: it is a video unless it is a tar."""
    if not is_tar(file.uri):
        yield file
        return
    empty = True
    for video in _members(file, opened):
        empty = False
        yield video
    if empty:
        raise InputUnavailable(f"no videos found in {file.uri}")


def _met(file: Found, opened: Callable[[], BinaryIO]) -> Iterator[Found]:
    """A file below a directory or a prefix: a video, a tar, or nothing of ours.

    A tar that cannot be read fails later as one video, for the sake of all the others.
    """
    name = file.uri.rsplit("/", 1)[-1]
    if _is_video(name):
        yield file
    elif is_tar(name) and not name.startswith("."):
        try:
            yield from _members(file, opened)
        except InputUnavailable:
            yield file


def _members(tar: Found, opened: Callable[[], BinaryIO]) -> Iterator[Found]:
    with opened() as file:
        for member, size_bytes in list_members(file, tar.uri):
            if _is_video(member.name.rsplit("/", 1)[-1]):
                yield Found(member.uri, size_bytes, tar.etag)


def _expand_local(uri: str, rules: InputRules) -> Iterator[Found]:
    path = Path(os.path.normpath(uri))
    try:
        resolved = path.resolve(strict=True)
        status = resolved.stat()
    except (OSError, RuntimeError) as error:
        reason = "it does not exist" if isinstance(error, FileNotFoundError) else str(error)
        raise InputUnavailable(f"cannot read input {uri}: {reason}") from error
    if not lies_within(resolved, rules.roots):
        raise InputUnavailable(f"input {uri} lies outside of the directories that this service may read")
    if stat.S_ISREG(status.st_mode):
        yield from _named(Found(str(path), status.st_size), partial(_open_local, path, rules))
        return
    if not stat.S_ISDIR(status.st_mode):
        raise InputUnavailable(f"input {uri} is neither a file nor a directory")

    walk = _Walk(resolved)
    empty = True
    for file in walk.files(path):
        for video in _met(file, partial(_open_local, Path(file.uri), rules)):
            empty = False
            yield video
    if not empty:
        return
    images = walk.images(path)
    if images:
        yield Found(str(path), sum(images))
        return
    hint = f" ({walk.links_ignored} links that leave it were ignored)" if walk.links_ignored else ""
    raise InputUnavailable(f"no videos found under {uri}{hint}")


class _Walk:
    """The files below a directory, in name order."""

    def __init__(self, root: Path) -> None:
        self._root = root
        self.links_ignored = 0

    def files(self, folder: Path) -> Iterator[Found]:
        """Those that are videos or may hold some."""
        for entry in self._entries(folder):
            if entry.is_dir(follow_symlinks=False):
                yield from self.files(folder / entry.name)
            elif (_is_video(entry.name) or is_tar(entry.name)) and self._stays_inside(entry) and entry.is_file():
                yield Found(str(folder / entry.name), entry.stat().st_size)

    def images(self, folder: Path) -> list[int]:
        """Sizes of the images directly in a folder."""
        return [
            entry.stat().st_size
            for entry in self._entries(folder)
            if Path(entry.name).suffix.lower() in IMAGE_EXTENSIONS and self._stays_inside(entry) and entry.is_file()
        ]

    def _entries(self, folder: Path) -> list[os.DirEntry[str]]:
        try:
            with os.scandir(folder) as found:
                return sorted((e for e in found if not e.name.startswith(".")), key=lambda e: e.name)
        except OSError as error:
            raise InputUnavailable(f"cannot list {folder}: {error.strerror}") from error

    def _stays_inside(self, entry: os.DirEntry[str]) -> bool:
        if not entry.is_symlink():
            return True
        inside = Path(os.path.realpath(entry.path)).is_relative_to(self._root)
        self.links_ignored += not inside
        return inside


def _is_video(name: str) -> bool:
    return not name.startswith(".") and Path(name).suffix.lower() in VIDEO_EXTENSIONS
