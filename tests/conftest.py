"""Fixtures that every test may use."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

# Two cores: a busy-waiting OpenMP pool beside another process is an order of magnitude slower than one thread.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
os.environ.setdefault("OMP_NUM_THREADS", "1")

# The same examples every time, and none fails because the machine was busy.
settings.register_profile("steady", deadline=None, derandomize=True)
settings.load_profile("steady")


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of public and synthetic sequences beside the checkout; skips where it is missing."""
    folder = Path(__file__).resolve().parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("the sequences of ../shared/data are not on this machine")
    return folder


@pytest.fixture(scope="session")
def s3_endpoint(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Address of a real S3 server process (moto over HTTP). It forgets everything at the end of the test session."""
    log = tmp_path_factory.mktemp("s3") / "server.log"
    with log.open("wb") as output:  # a file: nobody reads a pipe while the tests run, and a full pipe blocks the server
        server = subprocess.Popen(
            [sys.executable, "-u", "-m", "moto.server", "-H", "127.0.0.1", "-p", "0"], stdout=output, stderr=output
        )
    try:
        deadline = time.monotonic() + 60
        while not (found := re.search(r"Running on (http://127\.0\.0\.1:\d+)", log.read_text())):
            if server.poll() is not None or time.monotonic() > deadline:
                pytest.fail(f"the S3 server of the tests did not start: {log.read_text()[-500:]}")
            time.sleep(0.05)
        yield found[1]
    finally:
        server.kill()
        server.wait()
