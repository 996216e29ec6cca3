"""An object store in a directory: a local disk, or a file system that several machines share."""

from __future__ import annotations

import contextlib
import errno
import os
import secrets
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO, cast

from services.domain.errors import ConditionUnsupported, ObjectMissing, StorageError, StorageRefused
from services.storage.base import ObjectInfo
from services.storage.keys import TEMPORARY_PREFIX, check_key
from services.storage.observer import SilentObserver, StorageObserver

_COPY_CHUNK_BYTES = 4 << 20

# How file systems answer that have no hard links: FAT, and most that stand for something else.
_NO_LINKS = {errno.EPERM, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.EMLINK}

# What no waiting changes.
_REFUSALS = {errno.EACCES, errno.EPERM, errno.EROFS, errno.ENAMETOOLONG, errno.ENOTDIR, errno.ELOOP, errno.EINVAL}


class DirectoryStore:
    """Objects are files below `root`. Implements `ObjectStore`.

    Writes go to a hidden temporary name in the target's own folder, are flushed to the disk, and then take their name
    in one step: a rename for `put_*`, a hard link for `create` (a link fails if the name is taken, so it decides
    between two writers as S3's `If-None-Match: *` does). A crash leaves a hidden file, never half an object.

    Unlike S3, a file system cannot hold both an object `a` and an object `a/b`; the second raises `StorageRefused`.
    """

    def __init__(self, root: str | Path, *, observer: StorageObserver | None = None) -> None:
        self._root = Path(root)
        if not self._root.is_absolute():
            raise StorageRefused(f"the directory {str(root)!r} must be an absolute path")
        self._real_root = Path(os.path.realpath(self._root))
        self._observer: StorageObserver = observer or SilentObserver()

    @property
    def uri(self) -> str:
        return str(self._root)

    def put_file(self, key: str, path: Path) -> ObjectInfo:
        with path.open("rb") as source:
            return self._put(key, lambda target: shutil.copyfileobj(source, target, _COPY_CHUNK_BYTES))

    def put_bytes(self, key: str, data: bytes) -> ObjectInfo:
        return self._put(key, lambda target: target.write(data))

    def create(self, key: str, data: bytes) -> bool:
        with self._mapped("create", key):
            target = self._path(key)
            if os.path.lexists(target):  # spares the temporary file; the link below is what decides
                self._observer.request("create", "412")
                return False
            temporary = self._write_temporary(target, lambda file: file.write(data))
            try:
                os.link(temporary, target)
            except FileExistsError:
                self._observer.request("create", "412")
                return False
            except OSError as error:
                if error.errno in _NO_LINKS:
                    raise ConditionUnsupported(f"the file system of {self._root} does not know hard links") from error
                raise
            finally:
                temporary.unlink(missing_ok=True)
            _flush_folder(target.parent)
            self._observer.request("create", "200")
            self._observer.transferred("create", len(data))
            return True

    def get_bytes(self, key: str, start: int = 0, length: int | None = None) -> bytes:
        if start < 0 or (length is not None and length < 0):
            raise ValueError(f"a range starts at 0 or later and is not negative, got {start}, {length}")
        with self._mapped("get", key):
            with self._path(key).open("rb") as file:
                file.seek(start)
                data = file.read(-1 if length is None else length)
            self._observer.request("get", "200")
            self._observer.transferred("get", len(data))
            return data

    def download(self, key: str, path: Path) -> None:
        with self._mapped("get", key):
            with self._path(key).open("rb") as source:
                path.parent.mkdir(parents=True, exist_ok=True)
                temporary = self._write_temporary(
                    path, lambda target: shutil.copyfileobj(source, target, _COPY_CHUNK_BYTES)
                )
            size_bytes = temporary.stat().st_size
            temporary.replace(path)
            self._observer.request("get", "200")
            self._observer.transferred("get", size_bytes)

    def head(self, key: str) -> ObjectInfo | None:
        with self._mapped("head", key):
            info = self._info(key, self._path(key))
            self._observer.request("head", "200" if info else "404")
            return info

    def list(self, prefix: str = "") -> Iterator[ObjectInfo]:
        with self._mapped("list", prefix):
            self._observer.request("list", "200")
            yield from self._walk(self._root, "", prefix)

    def delete(self, key: str) -> None:
        with self._mapped("delete", key):
            target = self._path(key)
            # A key below another object (`a/b` where `a` is a file) or a folder is no object, so it is absent already.
            with contextlib.suppress(FileNotFoundError, NotADirectoryError, IsADirectoryError):
                if not target.is_dir() or target.is_symlink():
                    target.unlink()
                    _flush_folder(target.parent)
            self._observer.request("delete", "200")

    def delete_stale_temporaries(self, older_than_s: float) -> int:
        """Remove what writers that died left behind; returns how many files.

        Args:
            older_than_s: What was written to more recently may have a live writer.
        """
        removed = 0
        before_s = time.time() - older_than_s
        with self._mapped("delete", ""):
            for folder, _, names in os.walk(self._root):
                for name in names:
                    path = Path(folder, name)
                    if name.startswith(TEMPORARY_PREFIX) and path.lstat().st_mtime < before_s:
                        path.unlink(missing_ok=True)
                        removed += 1
        return removed

    def _put(self, key: str, write: Callable[[BinaryIO], object]) -> ObjectInfo:
        with self._mapped("put", key):
            target = self._path(key)
            temporary = self._write_temporary(target, write)
            try:
                temporary.replace(target)
            except BaseException:
                temporary.unlink(missing_ok=True)
                raise
            _flush_folder(target.parent)
            info = self._info(key, target)
            if info is None:
                raise StorageError(f"{self._root}/{key} vanished while it was being written")
            self._observer.request("put", "200")
            self._observer.transferred("put", info.size_bytes)
            return info

    def _write_temporary(self, target: Path, write: Callable[[BinaryIO], object]) -> Path:
        """A complete, flushed file beside `target`; nothing is left behind on failure."""
        _make_folder(target.parent)
        temporary = target.parent / f"{TEMPORARY_PREFIX}{os.getpid()}-{secrets.token_hex(8)}"
        try:
            with temporary.open("xb") as file:
                write(cast(BinaryIO, file))
                file.flush()
                os.fsync(file.fileno())
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
        return temporary

    def _path(self, key: str) -> Path:
        """The file of a key; a symbolic link on the way must not lead out of the root."""
        path = self._root / check_key(key)
        if not Path(os.path.realpath(path)).is_relative_to(self._real_root):
            raise StorageRefused(f"{self._root}/{key} leads out of the store through a symbolic link")
        return path

    def _info(self, key: str, path: Path) -> ObjectInfo | None:
        try:
            status = path.stat()
        except (FileNotFoundError, NotADirectoryError):
            return None
        if not path.is_file():
            return None
        return ObjectInfo(key, status.st_size, f"{status.st_mtime_ns:x}-{status.st_size:x}")

    def _walk(self, folder: Path, folder_key: str, prefix: str) -> Iterator[ObjectInfo]:
        """Files below `folder` in key order. Holds one folder per level in memory.

        A folder sorts as its name with a slash, since that is how the keys below it compare with its neighbours.
        """
        try:
            with os.scandir(folder) as entries:
                children = sorted(
                    (f"{e.name}/" if e.is_dir(follow_symlinks=False) else e.name)
                    for e in entries
                    if not e.name.startswith(TEMPORARY_PREFIX)
                )
        except (FileNotFoundError, NotADirectoryError):
            return
        for child in children:
            key = folder_key + child
            if child.endswith("/"):
                if key.startswith(prefix) or prefix.startswith(key):
                    yield from self._walk(folder / child[:-1], key, prefix)
            elif key.startswith(prefix) and (info := self._listed(key)) is not None:
                yield info

    def _listed(self, key: str) -> ObjectInfo | None:
        try:
            return self._info(key, self._path(key))
        except StorageError:
            return None  # a name that no key can have, or a link that leads out: not an object of this store

    @contextlib.contextmanager
    def _mapped(self, op: str, key: str) -> Iterator[None]:
        try:
            yield
        except FileNotFoundError as error:
            self._observer.request(op, "404")
            raise ObjectMissing(f"{self._root}/{key} does not exist") from error
        except (NotADirectoryError, IsADirectoryError, FileExistsError) as error:
            self._observer.request(op, "404" if op == "get" else "error")
            if op == "get":
                raise ObjectMissing(f"{self._root}/{key} does not exist") from error
            raise StorageRefused(
                f"{self._root}/{key} collides with another object that is a folder or a file"
            ) from error
        except OSError as error:
            self._observer.request(op, "error")
            reason = errno.errorcode.get(error.errno or 0, "unknown error")
            kind = StorageRefused if error.errno in _REFUSALS else StorageError
            raise kind(f"{op} of {self._root}/{key} failed: {os.strerror(error.errno or 0)} ({reason})") from error


def _make_folder(folder: Path) -> None:
    """`mkdir -p` whose new names survive a power cut."""
    missing: list[Path] = []
    while not folder.is_dir():
        missing.append(folder)
        folder = folder.parent
    for new in reversed(missing):
        new.mkdir(exist_ok=True)
        _flush_folder(new.parent)


def _flush_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
