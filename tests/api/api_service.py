"""The API as a real uvicorn process over a database."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO

ROOT = Path(__file__).resolve().parents[2]


@dataclass
class Service:
    url: str
    process: subprocess.Popen[str]
    database_url: str


@contextlib.contextmanager
def running(database_url: str, *settings: str, stderr: IO[str] | None = None, **environment: str) -> Iterator[Service]:
    process = subprocess.Popen(
        [sys.executable, str(Path(__file__).with_name("api_process.py")), database_url, *settings],
        stdout=subprocess.PIPE,
        stderr=stderr,
        text=True,
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT), **environment},
    )
    try:
        assert process.stdout is not None
        url = process.stdout.readline().strip()
        assert url, f"the API did not start: {process.wait()}"
        yield Service(url, process, database_url)
    finally:
        process.terminate()
        process.wait(timeout=60)
        assert process.stdout is not None
        process.stdout.close()
