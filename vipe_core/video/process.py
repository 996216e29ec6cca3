"""The parent's side of a decoder process: start it, read its messages with a stall limit, always kill and reap it."""

from __future__ import annotations

import contextlib
import fcntl
import json
import logging
import os
import selectors
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

import numpy as np

from vipe_core.errors import DecodeCrashed, DecodeError, DecodeTimeout
from vipe_core.video.limits import Limits
from vipe_core.video.sandbox import PROTECTIONS
from vipe_core.video.source import Frame
from vipe_core.video.wire import (
    DOCUMENT,
    HEADER_BYTES,
    HEARTBEAT,
    MAX_DOCUMENT_BYTES,
    Header,
    Request,
    raise_error_document,
)

_PACKAGE_ROOT = Path(__file__).resolve().parents[2]
_PIPE_BYTES = 1 << 20
# A busy machine takes its time to start an interpreter; that says nothing about the video.
_START_S = 60.0
# What a child may know of this process's environment: how to start, and nothing that could be a secret.
_ENVIRONMENT = ("PATH", "HOME", "LANG", "TZ", "TMPDIR", "VIRTUAL_ENV", "LD_LIBRARY_PATH", "LD_PRELOAD", "SYSTEMROOT")
_ENVIRONMENT_PREFIXES = ("PYTHON", "LC_", "DYLD_", "COVERAGE")

_log = logging.getLogger(__name__)
_reported: set[tuple[str, ...]] = set()


class DecoderProcess:
    """One decoder child, as a context manager; leaving it kills the child's process group and reaps it.

    Args:
        request: What to do.
        label: Name of the input for messages.
        stall_s: Seconds to wait for the next message. Time that the caller spends between reads does not count.
        wall_s: Total seconds allowed from start to end, or None.
    """

    def __init__(self, request: Request, label: str, stall_s: float, wall_s: float | None = None) -> None:
        self._label = label
        self._limits = request.limits
        self._stall_s = stall_s
        self._wait_s = max(stall_s, _START_S)
        self._deadline_s = None if wall_s is None else time.monotonic() + wall_s
        with contextlib.ExitStack() as resources:
            self._errors: IO[bytes] = resources.enter_context(tempfile.TemporaryFile())
            self._fd, write_fd = os.pipe()
            resources.callback(os.close, self._fd)
            try:
                self._process = subprocess.Popen(
                    # -P: the working directory is no place to import from.
                    [sys.executable, "-P", "-m", "vipe_core.video.decoder_child", request.to_json(), str(write_fd)],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.DEVNULL,
                    stderr=self._errors,
                    pass_fds=(write_fd,),
                    start_new_session=True,
                    env=_child_environment(request.limits),
                )
            except OSError as error:
                raise DecodeError(
                    f"{label}: the decoder process cannot be started ({error.strerror}); try again"
                ) from error
            finally:
                os.close(write_fd)
            resources.callback(self._kill)
            with contextlib.suppress(OSError, AttributeError):
                # A larger pipe means fewer switches; only Linux knows it, and the user's allowance may be used up.
                fcntl.fcntl(self._fd, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)
            os.set_blocking(self._fd, False)
            self._selector = resources.enter_context(selectors.DefaultSelector())
            self._selector.register(self._fd, selectors.EVENT_READ)
            self._resources = resources.pop_all()

    @property
    def pid(self) -> int:
        return self._process.pid

    def __enter__(self) -> DecoderProcess:
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.close()

    def close(self) -> None:
        """Kill the child and everything it started, wait for it, release the pipe. Safe to call twice."""
        self._resources.close()

    def _kill(self) -> None:
        # Until it is reaped the child's id cannot belong to somebody else, nor can its process group's.
        if self._process.returncode is None:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()
        if self._process.stdin is not None:
            self._process.stdin.close()

    def document(self) -> dict[str, Any]:
        """The one JSON document of a `probe`.

        Raises:
            InputError, DecodeError: As the child reports, or because it hangs or died.
        """
        while True:
            header = self._header()
            if header.kind == DOCUMENT:
                return self._read_document(header)
            if header.kind != HEARTBEAT:
                raise DecodeError(f"{self._label}: the decoder process sent an unexpected message; try again")

    def frames(self) -> Iterator[Frame | dict[str, Any]]:
        """Frames as they arrive, and last the closing document.

        Raises:
            InputError, DecodeError: As the child reports, or because it hangs or died.
        """
        while True:
            header = self._header()
            if header.kind == DOCUMENT:
                yield self._read_document(header)
                return
            if header.kind == HEARTBEAT:
                continue
            self._limits.check_picture(self._label, header.width, header.height)
            if header.payload_bytes != 3 * header.width * header.height:
                raise DecodeError(f"{self._label}: the decoder process sent a picture of the wrong size; try again")
            rgb = np.empty((header.height, header.width, 3), dtype=np.uint8)
            self._fill(rgb.data.cast("B"))
            yield Frame(header.index, header.timestamp_s, rgb)

    def _header(self) -> Header:
        raw = bytearray(HEADER_BYTES)
        self._fill(memoryview(raw))
        self._wait_s = self._stall_s
        return Header.unpack(raw)

    def _read_document(self, header: Header) -> dict[str, Any]:
        if header.payload_bytes > MAX_DOCUMENT_BYTES:
            raise DecodeError(f"{self._label}: the decoder process sent an oversized document; try again")
        raw = bytearray(header.payload_bytes)
        self._fill(memoryview(raw))
        try:
            document: dict[str, Any] = json.loads(raw)
        except ValueError as error:
            raise DecodeError(f"{self._label}: the decoder process sent a damaged document; try again") from error
        raise_error_document(document)
        return document

    def _fill(self, view: memoryview) -> None:
        while view:
            try:
                count = os.readv(self._fd, [view])
            except BlockingIOError:
                self._wait()
                continue
            if count == 0:
                raise self._crash()
            view = view[count:]

    def _wait(self) -> None:
        timeout_s = self._wait_s
        if self._deadline_s is not None:
            timeout_s = min(timeout_s, self._deadline_s - time.monotonic())
        if timeout_s <= 0 or not self._selector.select(timeout_s):
            self.close()
            raise DecodeTimeout(
                f"{self._label}: the decoder made no progress in time and was killed; try again or re-encode the video"
            )

    def _crash(self) -> DecodeCrashed:
        try:
            code = self._process.wait(timeout=5)
        except subprocess.TimeoutExpired:
            code = None
        self._errors.seek(0, os.SEEK_END)
        self._errors.seek(max(0, self._errors.tell() - 4096))
        lines = self._errors.read().decode(errors="replace").strip().splitlines()
        reason = f" ({lines[-1].strip()[:200]})" if lines else ""
        if code is not None and code < 0:
            how = f"was killed by signal {signal.Signals(-code).name}"
        else:
            how = f"ended with status {code}"
        return DecodeCrashed(f"{self._label}: the decoder process {how}{reason}; try again or re-encode the video")


def report_protections(document: dict[str, Any]) -> None:
    """Log, once, which protections of `vipe_core.video.sandbox` are active in the children."""
    active = tuple(document["protections"])
    if active not in _reported:
        _reported.add(active)
        missing = [name for name in PROTECTIONS if name not in active]
        absent = f"; not available here: {', '.join(missing)}" if missing else ""
        _log.info("decoder processes are protected by: %s%s", ", ".join(active), absent)


def _child_environment(limits: Limits) -> dict[str, str]:
    environment = {
        name: value
        for name, value in os.environ.items()
        if name in _ENVIRONMENT or name.startswith(_ENVIRONMENT_PREFIXES)
    }
    inherited = environment.get("PYTHONPATH")
    environment["PYTHONPATH"] = f"{_PACKAGE_ROOT}{os.pathsep}{inherited}" if inherited else str(_PACKAGE_ROOT)
    # The child does no linear algebra: thread pools would only slow its start.
    environment.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")
    # OpenCV judges an image by its header with this, before it makes room for what a few bytes can claim to hold.
    environment["OPENCV_IO_MAX_IMAGE_PIXELS"] = str(limits.max_pixels)
    return environment
