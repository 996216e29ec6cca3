"""Entry point of the decoder process: `python -m vipe_core.video.decoder_child REQUEST FD`.

Untrusted bytes are decoded here and nowhere else, so that a crash or a hang in a codec costs one process that the
parent can kill. The process ends itself when its parent is gone (end of file on stdin) and when it makes no progress
(an alarm that the kernel delivers even while native code runs).
"""

from __future__ import annotations

import importlib
import json
import math
import os
import signal
import sys
import threading
import time
from dataclasses import asdict

import numpy as np
from numpy.typing import NDArray

from vipe_core.errors import DecodeError, VipeError
from vipe_core.video.opened import OpenedMedia, open_media
from vipe_core.video.sandbox import restrict
from vipe_core.video.wire import DOCUMENT, HEARTBEAT, PICTURE, Header, Request, error_document, write_all

_HEARTBEAT_S = 0.5


class _Link:
    """The pipe to the parent. Time spent waiting for the parent to read does not count as a stall."""

    def __init__(self, fd: int, stall_s: float) -> None:
        self._fd = fd
        self._alarm_s = max(1, math.ceil(2 * stall_s))
        self._last_s = time.monotonic()
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(self._alarm_s)

    def _send(self, header: Header, payload: memoryview | bytes) -> None:
        signal.alarm(0)
        write_all(self._fd, header.pack())
        if len(payload):
            write_all(self._fd, payload)
        self._last_s = time.monotonic()
        signal.alarm(self._alarm_s)

    def started(self) -> None:
        self._send(Header(HEARTBEAT, 0), b"")

    def progress(self) -> None:
        if time.monotonic() - self._last_s > _HEARTBEAT_S:
            self._send(Header(HEARTBEAT, 0), b"")

    def document(self, text: bytes) -> None:
        self._send(Header(DOCUMENT, len(text)), text)

    def picture(self, index: int, timestamp_s: float, rgb: NDArray[np.uint8]) -> None:
        height, width = rgb.shape[:2]
        self._send(Header(PICTURE, rgb.nbytes, width, height, index, timestamp_s), rgb.data)


def _probe_video(media: list[OpenedMedia], request: Request, link: _Link, protections: tuple[str, ...]) -> None:
    from vipe_core.video.av_decode import describe

    info = asdict(describe(media[0], request.limits))
    link.document(json.dumps({"info": info, "protections": protections}).encode())


def _probe_image(media: list[OpenedMedia], request: Request, link: _Link, protections: tuple[str, ...]) -> None:
    from vipe_core.video.image_decode import read_image

    height, width = read_image(media[0], request.limits).shape[:2]
    link.document(json.dumps({"info": {"width": width, "height": height}, "protections": protections}).encode())


def _decode_images(media: list[OpenedMedia], request: Request, link: _Link) -> None:
    from vipe_core.video.image_decode import read_images

    images = read_images(media, request.limits, request.size, request.start, request.stop, on_progress=link.progress)
    for index, rgb in images:
        link.picture(index, index / request.fps, rgb)
    link.document(b'{"end": true}')


def _decode_video(media: list[OpenedMedia], request: Request, link: _Link) -> None:
    from vipe_core.video.av_decode import Damage, PictureConverter, decode

    damage = Damage()
    converter = PictureConverter(media[0].label, request.size, request.limits)
    for index, timestamp_s, frame in decode(media[0], request.limits, request.threads, damage, link.progress):
        if index >= request.start:
            link.picture(index, timestamp_s, converter.convert(frame))
        if request.stop is not None and index + 1 >= request.stop:
            link.document(b'{"end": true}')
            return
    link.document(json.dumps({"end": True, "damage": damage.sentence()}).encode())


def _run(request: Request, link: _Link) -> None:
    """Import and open what is needed, give up the rest, then look at the bytes."""
    importlib.import_module("vipe_core.video.image_decode" if request.images else "vipe_core.video.av_decode")
    inside = request.root if request.images else None
    media = [open_media(path, request.limits, inside=inside) for path in request.paths]
    protections = restrict(request.limits.max_memory_bytes)
    threading.Thread(target=_exit_with_parent, daemon=True).start()
    try:
        if request.task == "probe":
            (_probe_image if request.images else _probe_video)(media, request, link, protections)
        else:
            (_decode_images if request.images else _decode_video)(media, request, link)
    except MemoryError:
        raise request.limits.out_of_memory(request.files[0]) from None


def _exit_with_parent() -> None:
    while os.read(0, 1):
        pass
    os.kill(os.getpid(), signal.SIGKILL)


def main() -> None:
    request = Request.from_json(sys.argv[1])
    link = _Link(int(sys.argv[2]), request.stall_s)
    link.started()
    try:
        _run(request, link)
    except BrokenPipeError:
        # The parent stopped reading: there is nobody left to tell.
        pass
    except VipeError as error:
        link.document(error_document(error))
    except OSError as error:
        link.document(error_document(DecodeError(f"{request.files[0]}: {error.strerror or error}; try again")))
    # Native threads of the codecs need no orderly end, and an orderly end is where they hang.
    os._exit(0)


if __name__ == "__main__":
    main()
