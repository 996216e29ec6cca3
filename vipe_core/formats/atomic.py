"""Files and folders that appear under their name only when they are complete."""

from __future__ import annotations

import json
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from vipe_core.errors import FormatError

EXPORT_FILE = "export.json"
"""What a folder that is an export holds: the format, the sequence, and what the numbers mean."""


@contextmanager
def complete_file(path: Path) -> Iterator[Path]:
    """A path beside `path` to write to; it becomes `path` on a normal exit and is removed on an exception."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{secrets.token_hex(8)}.partial")
    # Not by tempfile, which makes files private: results are as readable as anything else that this process writes.
    os.close(os.open(partial, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
    try:
        yield partial
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


@contextmanager
def complete_folder(path: Path) -> Iterator[Path]:
    """A new folder beside `path` to write to; it becomes `path` on a normal exit and is removed on an exception.

    What is at `path` is replaced if it is an earlier export (it holds `export.json`).

    Raises:
        FormatError: Something else is at `path`.
    """
    if path.exists() and not (path / EXPORT_FILE).is_file():
        raise FormatError(f"{path.name} exists and is not an earlier export; choose another destination")
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{secrets.token_hex(8)}.partial")
    partial.mkdir()
    try:
        yield partial
        if path.exists():
            shutil.rmtree(path)
        partial.replace(path)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def write_json(path: Path, content: Any) -> None:
    path.write_text(json.dumps(content, indent=1, sort_keys=True, allow_nan=False) + "\n", encoding="utf-8")
