"""The messages that a decoder child sends to its parent over one pipe: a fixed header, then a payload.

One direction only, so there is no handshake to get stuck in: the request travels as the child's argument, back-pressure
is the pipe filling up. Three kinds of message: a picture (raw RGB), a heartbeat while frames are skipped, and JSON (the
description of the media, an error, or the end of the stream).
"""

from __future__ import annotations

import json
import os
import struct
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from vipe_core import errors
from vipe_core.errors import DecodeError, VipeError
from vipe_core.video.limits import Limits

_HEADER = struct.Struct("<4scxxxIIQdQ")
_MAGIC = b"VPF1"
HEADER_BYTES = _HEADER.size

PICTURE = b"P"
HEARTBEAT = b"H"
DOCUMENT = b"J"
# A JSON document is a handful of fields; anything longer means that the stream is out of step.
MAX_DOCUMENT_BYTES = 1 << 20


@dataclass(frozen=True, slots=True)
class Header:
    """Head of one message. `width`, `height`, `index` and `timestamp_s` have a meaning for pictures only."""

    kind: bytes
    payload_bytes: int
    width: int = 0
    height: int = 0
    index: int = 0
    timestamp_s: float = 0.0

    def pack(self) -> bytes:
        return _HEADER.pack(
            _MAGIC, self.kind, self.width, self.height, self.index, self.timestamp_s, self.payload_bytes
        )

    @classmethod
    def unpack(cls, raw: bytes | bytearray) -> Header:
        """Raises:
        DecodeError: The bytes are not a header (the child wrote something else into the pipe).
        """
        magic, kind, width, height, index, timestamp_s, payload_bytes = _HEADER.unpack(raw)
        if magic != _MAGIC:
            raise DecodeError("the decoder process sent bytes that are not a message; try again")
        return cls(kind, payload_bytes, width, height, index, timestamp_s)


@dataclass(frozen=True, slots=True)
class Request:
    """What a child is asked to do.

    Attributes:
        task: `probe` describes the media; `decode` sends pictures [start, stop).
        root: Directory of the files, absolute.
        files: Name of one video file, or the names of the images in order.
        images: Whether `files` are images.
        size: (width, height) of the upright picture to send, or None for its own size.
        fps: Frame rate that images are given.
        threads: Decoder threads.
        stall_s: Seconds without progress after which the child ends itself (the parent's limit is shorter).
    """

    task: str
    root: str
    files: tuple[str, ...]
    images: bool
    limits: Limits
    size: tuple[int, int] | None
    start: int
    stop: int | None
    fps: float
    threads: int
    stall_s: float

    @property
    def paths(self) -> tuple[str, ...]:
        return tuple(str(Path(self.root, file)) for file in self.files)

    def to_json(self) -> str:
        # As an argument of a process, names that are not UTF-8 survive only unescaped.
        return json.dumps(asdict(self), ensure_ascii=False)

    @classmethod
    def from_json(cls, text: str) -> Request:
        fields: dict[str, Any] = json.loads(text)
        fields["limits"] = Limits(**fields["limits"])
        fields["files"] = tuple(fields["files"])
        fields["size"] = tuple(fields["size"]) if fields["size"] else None
        return cls(**fields)


_ERROR_TYPES: dict[str, type[VipeError]] = {
    kind.code: kind for kind in vars(errors).values() if isinstance(kind, type) and issubclass(kind, VipeError)
}


def error_document(error: VipeError) -> bytes:
    return json.dumps({"error": error.code, "message": str(error)}).encode()


def raise_error_document(document: dict[str, Any]) -> None:
    """Raise the typed error that `document` carries, if it carries one."""
    code = document.get("error")
    if code is not None:
        raise _ERROR_TYPES.get(code, DecodeError)(document.get("message", code))


def write_all(fd: int, data: memoryview | bytes) -> None:
    """Write everything; a pipe takes what fits and `os.write` says how much that was."""
    view = memoryview(data).cast("B")
    while view:
        view = view[os.write(fd, view) :]
