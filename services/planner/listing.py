"""Expand inputs into videos: directories, files, S3 objects and prefixes. One video at a time, in a fixed order."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from services.domain.errors import InputUnavailable, ObjectMissing
from services.storage.open import open_store
from services.storage.roots import lies_within

VIDEO_EXTENSIONS = frozenset(
    {".mp4", ".mov", ".mkv", ".webm", ".avi", ".m4v", ".mpg", ".mpeg", ".ts", ".gif"},
)
IMAGE_EXTENSIONS = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp"})


@dataclass(frozen=True, slots=True)
class Found:
    """A video as listed."""

    uri: str
    size_bytes: int
    etag: str | None = None


def expand(uri: str, *, input_roots: Sequence[Path] = (), s3_endpoint_url: str | None = None) -> Iterator[Found]:
    """The videos of one input.

    A directory is walked recursively in name order; names that start with a dot are left out, and so are links that
    leave the directory and links to directories. A directory without videos but with images is one video. A file is
    one video whatever its name.

    Args:
        uri: An absolute path, `s3://bucket/key`, or `s3://bucket/prefix/`.
        input_roots: Where local inputs must lie, links resolved; empty: anywhere.
        s3_endpoint_url: S3 service other than AWS.

    Raises:
        InputUnavailable: It does not exist, is not readable, lies outside of the roots, or holds no video.
        StorageError: S3 does not answer.
    """
    videos = _expand_s3(uri, s3_endpoint_url) if uri.startswith("s3://") else _expand_local(uri, input_roots)
    for video in videos:
        try:
            video.uri.encode()
        except UnicodeEncodeError:
            raise InputUnavailable(f"the name of {video.uri!a} is not valid UTF-8; rename the file") from None
        yield video


def _expand_s3(uri: str, endpoint_url: str | None) -> Iterator[Found]:
    bucket, _, key = uri.removeprefix("s3://").partition("/")
    try:
        if key and not key.endswith("/"):
            info = open_store(f"s3://{bucket}", endpoint_url=endpoint_url).head(key)
            if info is None:
                raise InputUnavailable(f"there is no object {uri}; a prefix must end in '/'")
            yield Found(uri, info.size_bytes, info.etag)
            return
        empty = True
        for info in open_store(f"s3://{bucket}/{key}".rstrip("/"), endpoint_url=endpoint_url).list():
            if _is_video(info.key.rsplit("/", 1)[-1]):
                empty = False
                yield Found(f"s3://{bucket}/{key}{info.key}", info.size_bytes, info.etag)
    except ObjectMissing as error:
        raise InputUnavailable(f"cannot read {uri}: {error}") from error
    if empty:
        raise InputUnavailable(f"no videos found under {uri}")


def _expand_local(uri: str, input_roots: Sequence[Path]) -> Iterator[Found]:
    path = Path(os.path.normpath(uri))
    try:
        resolved = path.resolve(strict=True)
        status = resolved.stat()
    except (OSError, RuntimeError) as error:
        reason = "it does not exist" if isinstance(error, FileNotFoundError) else str(error)
        raise InputUnavailable(f"cannot read input {uri}: {reason}") from error
    if not lies_within(resolved, input_roots):
        raise InputUnavailable(f"input {uri} lies outside of the directories that this service may read")
    if stat.S_ISREG(status.st_mode):
        yield Found(str(path), status.st_size)
        return
    if not stat.S_ISDIR(status.st_mode):
        raise InputUnavailable(f"input {uri} is neither a file nor a directory")

    walk = _Walk(resolved)
    empty = True
    for video in walk.videos(path):
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

    def videos(self, folder: Path) -> Iterator[Found]:
        for entry in self._entries(folder):
            if entry.is_dir(follow_symlinks=False):
                yield from self.videos(folder / entry.name)
            elif _is_video(entry.name) and self._stays_inside(entry) and entry.is_file():
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
