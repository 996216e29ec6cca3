"""Pulling a file of weights: resumed where it broke off, in its place only with the right checksum."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import logging
import os
import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

import httpx

from services.domain.errors import HttpFailed, StorageError, StorageRefused
from services.network.addresses import shown_url
from services.storage import open_store
from services.weights.mirroring import read_mirrored
from vipe_core.errors import WeightsInvalid
from vipe_core.priors.weights import (
    Record,
    checksum,
    expected_sha256,
    known,
    path_of,
    record_of,
    verified,
    write_record,
)

_log = logging.getLogger(__name__)

ProgressCallback = Callable[[int, int | None], None]
"""(bytes here, bytes in all if known)"""

_CHUNK_BYTES = 1 << 18
_CONNECT_S, _READ_S = 15.0, 60.0
_RANGE = re.compile(r"bytes (\d+)-\d+/(\d+|\*)")


@dataclass(frozen=True, slots=True)
class Pulled:
    """What a pull came to.

    Attributes:
        path: The file.
        record: What is written down about it.
        fetched: False where it was here already.
        first_use: Whether nobody had published a checksum and none was known: this one counts from now on.
    """

    path: Path
    record: Record
    fetched: bool
    first_use: bool


def pull(
    name: str,
    *,
    origin: str | None = None,
    sha256: str | None = None,
    force: bool = False,
    progress: ProgressCallback | None = None,
) -> Pulled:
    """Put the weights `name` where the engine looks for them.

    A download that breaks off stays beside its place and goes on with the next pull, if the server knows how to and
    the file is still the same. A file whose checksum is wrong is deleted. Of several pulls of one file at a time, in
    any processes of this machine, one fetches it and the others wait for it.

    Args:
        origin: Instead of the public addresses: an `http(s)` address of the file, the path of the file itself, or a
            mirror that `mirror` filled (a folder or `s3://bucket/prefix`).
        sha256: What the checksum must be, where none is published; with `force` also instead of that of the first pull.
        force: Fetch it although it is here.

    Raises:
        WeightsMissing: There are no weights of that name.
        WeightsInvalid: What arrived, or is here, has another checksum than it must have.
        HttpFailed: No address gave the whole file; trying again may help, and goes on where it stopped.
        StorageError: The mirror does not answer or does not hold it, or there is no room for it here.
        StorageRefused: Nothing may be written where weights lie.
    """
    path = path_of(name)
    if path.is_file() and not force:
        return _here(name, sha256)
    partial = path.with_name(f".{path.name}.partial")
    with _writable(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with _alone(partial, name):
            if path.is_file() and not force:
                return _here(name, sha256)
            return _fetch(name, partial, origin, sha256, progress)


def _here(name: str, sha256: str | None) -> Pulled:
    """A file that is in its place, verified."""
    path = path_of(name)
    found = verified(name, path)
    if sha256 is not None and found != sha256.lower():
        raise WeightsInvalid(f"{path} has the SHA-256 {found} instead of {sha256}; fetch it again with --force")
    record = record_of(name)
    if record is None:
        record = Record(found, path.stat().st_size, "found in place")
        with _writable(path):
            write_record(name, record)
    return Pulled(path, record, fetched=False, first_use=False)


def _fetch(
    name: str, partial: Path, origin: str | None, sha256: str | None, progress: ProgressCallback | None
) -> Pulled:
    """A file from where it is kept into its place."""
    weights, path = known(name), path_of(name)
    asked = None if sha256 is None else sha256.lower()
    if None not in (weights.sha256, asked) and weights.sha256 != asked:
        raise WeightsInvalid(f"the published SHA-256 of {name} is {weights.sha256}, not {asked}")
    # That of the first pull counts until the user names another.
    expected = asked or expected_sha256(name)
    if origin is None or urlsplit(origin).scheme in ("http", "https"):
        shown = _download((origin,) if origin else weights.urls, partial, progress)
    elif Path(origin).is_file():
        shown = str(Path(origin).absolute())
        shutil.copyfile(origin, partial)
    else:
        store = open_store(str(Path(origin).absolute()) if Path(origin).is_dir() else origin)
        mirrored = read_mirrored(store, weights.file)
        expected = expected or mirrored.sha256
        store.download(weights.file, partial)
        shown = f"{store.uri}/{weights.file}"
    found = checksum(partial)
    if expected is not None and found != expected:
        _forget(partial)
        raise WeightsInvalid(
            f"what {shown} gave for {weights.file} has the SHA-256 {found} instead of {expected}; it was deleted and"
            " nothing was changed"
        )
    record = Record(found, partial.stat().st_size, shown)
    # The record first: a file without one would be trusted whatever it is.
    write_record(name, record)
    partial.replace(path)
    _forget(partial)
    return Pulled(path, record, fetched=True, first_use=expected is None)


@contextlib.contextmanager
def _writable(path: Path) -> Iterator[None]:
    """What a disk says, as a sentence.

    Raises:
        StorageError: It is full.
        StorageRefused: It may not be written.
    """
    try:
        yield
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise StorageError(
                f"there is no room for {path.name} in {path.parent}; make some, or name another folder by VIPE_WEIGHTS,"
                " and pull again to go on"
            ) from error
        raise StorageRefused(
            f"{error.filename or path.parent} cannot be used ({error.strerror or error}); weights lie in {path.parent}:"
            " name another folder by VIPE_WEIGHTS"
        ) from error


@contextlib.contextmanager
def _alone(partial: Path, name: str) -> Iterator[None]:
    """The only pull of a file on this machine, after any that is under way. A process that dies makes way."""
    path = _note_path(partial)
    while True:
        with path.open("a") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                _log.warning("another pull of %s is under way; waiting for it", name)
                fcntl.flock(lock, fcntl.LOCK_EX)
            except OSError as error:  # a file system without locks
                _log.info("pulls of %s cannot be kept apart: %s", name, error)
            if not path.exists() or not os.path.samestat(path.stat(), os.fstat(lock.fileno())):
                continue  # the other one has finished and taken its note away
            try:
                yield
            finally:
                if not partial.exists():
                    path.unlink(missing_ok=True)
            return


def _download(urls: tuple[str, ...], partial: Path, progress: ProgressCallback | None) -> str:
    """Fetch from the first address that gives the whole file; returns it as it may be shown."""
    failures = []
    for url in urls:
        try:
            _go_on(url, partial, progress)
            return shown_url(url)
        except HttpFailed as error:
            _log.info("%s", error)
            failures.append(str(error))
    raise HttpFailed("; ".join(failures))


def _go_on(url: str, partial: Path, progress: ProgressCallback | None) -> None:
    """Ask for what is missing of a file and append it."""
    have, tag = _begun(url, partial)
    headers = {"Accept-Encoding": "identity"}
    if have:
        headers |= {"Range": f"bytes={have}-", "If-Range": tag}
    timeout = httpx.Timeout(_READ_S, connect=_CONNECT_S)
    try:
        with httpx.stream("GET", url, headers=headers, timeout=timeout, follow_redirects=True) as answer:
            if answer.status_code == 416:
                partial.unlink(missing_ok=True)
                raise HttpFailed(f"{shown_url(url)} has changed since the download began; pull again")
            if answer.status_code not in (200, 206):
                raise HttpFailed(f"{shown_url(url)} answers with status {answer.status_code}")
            if answer.headers.get("content-type", "").startswith("text/html"):
                raise HttpFailed(f"{shown_url(url)} answers with a web page instead of a file")
            match = _RANGE.fullmatch(answer.headers.get("content-range", ""))
            begin = int(match[1]) if answer.status_code == 206 and match else 0
            if begin not in (0, have):
                raise HttpFailed(f"{shown_url(url)} answers with another part than was asked for")
            length = answer.headers.get("content-length", "")
            total = begin + int(length) if length.isdigit() else None
            _require_room(partial, 0 if total is None else total - begin)
            _note(url, partial, answer.headers.get("etag"))
            with partial.open("ab" if begin else "wb") as file:
                file.truncate(begin)
                here = begin
                for piece in answer.iter_bytes(_CHUNK_BYTES):
                    file.write(piece)
                    here += len(piece)
                    if progress is not None:
                        progress(here, total)
            if total is not None and here != total:
                raise HttpFailed(f"{shown_url(url)} broke off after {here} of {total} bytes; pull again to go on")
    except (httpx.ConnectError, httpx.ConnectTimeout) as error:
        raise HttpFailed(
            f"{shown_url(url)} cannot be reached ({error}); where there is no internet, take the file from a mirror or"
            " from where it was copied to with --from"
        ) from error
    except (httpx.HTTPError, httpx.InvalidURL) as error:
        raise HttpFailed(
            f"{shown_url(url)} broke off or did not answer ({type(error).__name__}); pull again"
        ) from error


def _require_room(partial: Path, bytes_to_come: int) -> None:
    """Rather nothing than the most of a file.

    Raises:
        OSError: There is no room for what is to come.
    """
    if bytes_to_come > shutil.disk_usage(partial.parent).free:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def _begun(url: str, partial: Path) -> tuple[int, str]:
    """How many bytes are here of what the address gave, and its tag; 0 where they may not be gone on with."""
    try:
        note = json.loads(_note_path(partial).read_text())
        if note["url"] == url and note["etag"]:
            return partial.stat().st_size, str(note["etag"])
    except (OSError, ValueError, KeyError, TypeError):
        pass
    return 0, ""


def _note(url: str, partial: Path, etag: str | None) -> None:
    """Remember whose bytes lie in the partial file. A weak tag does not promise equal bytes."""
    strong = etag if etag is not None and etag.startswith('"') else None
    _note_path(partial).write_text(json.dumps({"url": url, "etag": strong}))


def _note_path(partial: Path) -> Path:
    return partial.with_name(f"{partial.name}.json")


def _forget(partial: Path) -> None:
    partial.unlink(missing_ok=True)
    _note_path(partial).unlink(missing_ok=True)
