"""Rows of a parquet file, read by a child process that has nothing to lose."""

from __future__ import annotations

import json
import os
import select
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, BinaryIO

from services.domain.errors import InputTooLarge, InvalidManifest

_STALL_S = 60.0
_MAX_LINE_BYTES = 1 << 20
_KEPT_ENVIRONMENT = ("PATH", "HOME", "LANG", "TMPDIR", "VIRTUAL_ENV", "LD_LIBRARY_PATH", "PYTHONPATH", "PYTHONHOME")


def parquet_rows(file: BinaryIO, name: str, columns: Sequence[str]) -> Iterator[list[str] | Mapping[str, Any]]:
    """First the names of all columns, then the rows, with those of `columns` that there are.

    Args:
        file: An open file of the operating system.
        name: Of the file, for messages.

    Raises:
        InvalidManifest: Not a readable parquet file; also where it makes its reader crash or hang.
        InputTooLarge: A value, or what must be held at once, is larger than any list of videos needs.
    """
    file.seek(0)
    environment = {key: value for key, value in os.environ.items() if key in _KEPT_ENVIRONMENT}
    path = os.pathsep.join(entry for entry in sys.path if entry)
    child = subprocess.Popen(
        [sys.executable, "-P", "-m", "services.inputs.parquet_child", *columns],
        stdin=file.fileno(),
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        env={**environment, "PYTHONPATH": path, "OMP_NUM_THREADS": "1"},
        start_new_session=True,
    )
    try:
        for line in _lines(child, name):
            document = json.loads(line)
            if isinstance(document, dict):
                if document == {"end": True}:
                    return
                if document.keys() == {"error"}:
                    if document["error"] == "too large":
                        raise InputTooLarge(f"{name} needs too much memory; write it with smaller row groups")
                    raise _unreadable(name)
            yield document
        raise _unreadable(name)
    finally:
        child.kill()
        child.wait()
        if child.stdout is not None:
            child.stdout.close()


def _lines(child: subprocess.Popen[bytes], name: str) -> Iterator[bytes]:
    assert child.stdout is not None
    descriptor = child.stdout.fileno()
    rest = b""
    while True:
        if not select.select([descriptor], [], [], _STALL_S)[0]:
            raise _unreadable(name)
        data = os.read(descriptor, 1 << 16)
        if not data:
            return
        *lines, rest = (rest + data).split(b"\n")
        if len(rest) > _MAX_LINE_BYTES:
            raise InputTooLarge(f"{name} holds a value of more than {_MAX_LINE_BYTES} bytes")
        yield from lines


def _unreadable(name: str) -> InvalidManifest:
    return InvalidManifest(f"{name} is not a readable parquet file")
