"""Downloading a video from a web server: in pieces, resumed where it broke off, never more than is allowed."""

from __future__ import annotations

import logging
import re
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from services.domain.errors import HttpFailed, InputTooLarge, InputUnavailable
from services.network.addresses import shown_url
from services.network.http import Answer, GuardedHttp

_log = logging.getLogger(__name__)

_TRIES = 5
_FIRST_WAIT_S = 0.5
_MAX_WAIT_S = 30.0
# A server that sends less, over the whole download, holds a worker for nothing.
_SLOWEST_BYTES_PER_S = 16_384
_PATIENCE_S = 60.0
_RANGE = re.compile(r"bytes (\d+)-\d+/(\d+|\*)")


@dataclass(frozen=True, slots=True)
class WebObject:
    """What a web server says about a file. Without a strong tag nothing tells whether it changes."""

    size_bytes: int
    etag: str | None


def look(http: GuardedHttp, url: str) -> WebObject:
    """Size and tag of a file, without its contents.

    Raises:
        InputUnavailable: The server refuses, or has no such file.
        HttpFailed: It does not answer; trying again may help.
        AddressRefused: The address, or one that it redirects to, must not be contacted.
    """
    with http.open("HEAD", url, follow_redirects=True) as answer:
        if answer.status not in (405, 501):
            _check_status(url, answer)
            return WebObject(_length(answer) or 0, _etag(answer))
    with http.open("GET", url, headers={"Range": "bytes=0-0"}, follow_redirects=True) as answer:
        _check_status(url, answer)
        match = _RANGE.fullmatch(answer.headers.get("content-range", ""))
        size = int(match[2]) if match and match[2] != "*" else _length(answer) or 0
        return WebObject(size, _etag(answer))


def download(
    http: GuardedHttp,
    url: str,
    path: Path,
    *,
    max_bytes: int,
    etag: str | None = None,
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
) -> int:
    """Fetch to a local file, which appears complete or not at all; returns its size.

    Args:
        max_bytes: More is refused, at the latest where it begins.
        etag: The tag that the file had when the job was planned; another one is refused.

    Raises:
        InputUnavailable: The server refuses, has no such file, or the file has changed since the job was planned.
        InputTooLarge: More than `max_bytes`.
        HttpFailed: The server does not answer, breaks off again and again, or sends too slowly.
        AddressRefused: The address, or one that it redirects to, must not be contacted.
    """
    partial = path.with_name(f"{path.name}.partial")
    started = clock()
    transfer = _Transfer(http, url, partial, max_bytes, etag, lambda: clock() - started)
    try:
        for attempt in range(_TRIES):
            try:
                transfer.go_on()
                break
            except HttpFailed as error:
                if attempt == _TRIES - 1:
                    raise
                wait_s = transfer.wait_s or min(_MAX_WAIT_S, _FIRST_WAIT_S * 2**attempt)
                _log.info("%s; it goes on behind byte %d in %.1f s", error, transfer.size_bytes, wait_s)
                sleep(wait_s)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
    return transfer.size_bytes


class _Transfer:
    """One file on its way, over as many requests as it takes.

    Attributes:
        size_bytes: What has arrived.
        wait_s: How long the server wants us to wait, if it says so.
    """

    def __init__(
        self,
        http: GuardedHttp,
        url: str,
        path: Path,
        max_bytes: int,
        etag: str | None,
        elapsed_s: Callable[[], float],
    ) -> None:
        self._http, self._url, self._path = http, url, path
        self._max_bytes, self._planned_etag, self._elapsed_s = max_bytes, etag, elapsed_s
        self._etag: str | None = None
        self.size_bytes = 0
        self.wait_s: float | None = None

    def go_on(self) -> None:
        """Ask for what is missing and write it."""
        self.wait_s = None
        resuming = self.size_bytes > 0 and self._etag is not None
        headers = {"Range": f"bytes={self.size_bytes}-", "If-Range": self._etag or ""} if resuming else {}
        with self._http.open("GET", self._url, headers=headers, follow_redirects=True) as answer:
            if answer.status == 416 and resuming:
                self.size_bytes = 0
                raise HttpFailed(f"{shown_url(self._url)} has become shorter")
            if answer.status in (429, 503):
                self.wait_s = _retry_after_s(answer)
            _check_status(self._url, answer)
            self._etag = _etag(answer)
            if self._planned_etag is not None and self._etag != self._planned_etag:
                raise InputUnavailable(f"{shown_url(self._url)} is not what it was when the job was planned")
            if answer.headers.get("content-encoding", "identity") not in ("", "identity"):
                raise InputUnavailable(f"{shown_url(self._url)} is sent compressed, although that was not asked for")
            match = _RANGE.fullmatch(answer.headers.get("content-range", ""))
            begin = int(match[1]) if answer.status == 206 and match else 0
            if begin not in (0, self.size_bytes):
                raise InputUnavailable(f"{shown_url(self._url)} answers with another part than was asked for")
            self.size_bytes = begin
            if (length := _length(answer)) is not None and begin + length > self._max_bytes:
                raise self._too_large()
            with self._path.open("ab" if begin else "wb") as file:
                file.truncate(begin)
                for piece in answer.body:
                    if self.size_bytes + len(piece) > self._max_bytes:
                        raise self._too_large()
                    file.write(piece)
                    self.size_bytes += len(piece)
                    self._check_pace()

    def _check_pace(self) -> None:
        elapsed_s = self._elapsed_s()
        if elapsed_s > _PATIENCE_S and self.size_bytes < _SLOWEST_BYTES_PER_S * elapsed_s:
            raise HttpFailed(f"{shown_url(self._url)} sends too slowly: {self.size_bytes} bytes in {elapsed_s:.0f} s")

    def _too_large(self) -> InputTooLarge:
        return InputTooLarge(f"{shown_url(self._url)} has more than the {self._max_bytes} bytes that are allowed")


def _check_status(url: str, answer: Answer) -> None:
    if answer.status in (200, 206):
        return
    shown = f"{shown_url(url)} answers with status {answer.status}"
    if answer.status >= 500 or answer.status in (408, 425, 429):
        raise HttpFailed(shown)
    raise InputUnavailable(f"{shown}; check the address and whether it may be read without credentials")


def _length(answer: Answer) -> int | None:
    text = answer.headers.get("content-length", "")
    return int(text) if text.isascii() and text.isdigit() else None


def _etag(answer: Answer) -> str | None:
    """A strong tag; a weak one does not promise equal bytes."""
    tag = answer.headers.get("etag")
    return tag if tag is not None and tag.startswith('"') and len(tag) <= 256 and tag.isprintable() else None


def _retry_after_s(answer: Answer) -> float | None:
    text = answer.headers.get("retry-after", "")
    return min(_MAX_WAIT_S, float(text)) if text.isascii() and text.isdigit() else None
