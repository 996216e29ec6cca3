"""Log lines: context, extras, tracebacks, and no secrets."""

from __future__ import annotations

import io
import json
import logging
from collections.abc import Iterator

import pytest

from services.observability.logging import configure_logging, context, redact


@pytest.fixture(autouse=True)
def _restore_root() -> Iterator[None]:
    root = logging.getLogger()
    handlers, level = list(root.handlers), root.level
    yield
    root.handlers[:] = handlers
    root.setLevel(level)


def test_json_lines_carry_the_context_of_the_work() -> None:
    stream = io.StringIO()
    configure_logging("info", "json", stream)
    with context(job="job_1", shard="job_1-000000"), context(video="a", shard="job_1-000001"):
        logging.getLogger("t").info("fetched %d bytes", 5, extra={"bytes": 5})
    logging.getLogger("t").info("after")
    inside, after = (json.loads(line) for line in stream.getvalue().splitlines())
    assert inside["message"] == "fetched 5 bytes"
    assert (inside["job"], inside["shard"], inside["video"], inside["bytes"]) == ("job_1", "job_1-000001", "a", 5)
    assert "job" not in after


def test_a_traceback_stays_on_one_json_line() -> None:
    stream = io.StringIO()
    configure_logging("info", "json", stream)
    try:
        raise ValueError("token=abcdef123456")
    except ValueError:
        logging.getLogger("t").exception("failed")
    (line,) = stream.getvalue().splitlines()
    assert "ValueError" in json.loads(line)["traceback"]
    assert "abcdef123456" not in line


@pytest.mark.parametrize(
    ("text", "secret"),
    [
        ("connect postgresql://vipe:hunter2@db/vipe", "hunter2"),
        ("GET /x?X-Amz-Signature=deadbeef00&X-Amz-Date=1", "deadbeef00"),
        ("Authorization: Bearer abc.def-ghi", "abc.def-ghi"),
        ("secret_access_key='wJalrXUtnFEMI'", "wJalrXUtnFEMI"),
        ('{"password": "p4ss"}', "p4ss"),
        ("key AKIAABCDEFGHIJKLMNOP used", "AKIAABCDEFGHIJKLMNOP"),
    ],
)
def test_secrets_are_replaced(text: str, secret: str) -> None:
    assert secret in text
    assert secret not in redact(text)


def test_ordinary_text_is_left_alone() -> None:
    text = "s3://bucket/clips/a.mp4: no video stream, key a-0123 (tokens: 5 of 9)"
    assert redact(text.replace("tokens: 5", "tokens 5")) == text.replace("tokens: 5", "tokens 5")


def test_text_format_is_one_readable_line() -> None:
    stream = io.StringIO()
    configure_logging("info", "text", stream)
    with context(video="clip-1"):
        logging.getLogger("t").warning("slow")
    assert stream.getvalue().rstrip().endswith("WARNING t: slow [video=clip-1]")
