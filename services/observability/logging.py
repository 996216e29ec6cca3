"""One logging setup for every process of the service: JSON lines for machines, or plain lines for people.

`context(job=..., shard=..., video=...)` puts these names on every record that is logged inside of it, in this thread or
task. Secrets never reach a handler: what looks like a credential in a message is replaced before it is written.
"""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from datetime import UTC, datetime
from typing import Literal, TextIO

from services.domain.redaction import redact

LogFormat = Literal["json", "text"]

_context: ContextVar[tuple[tuple[str, str], ...]] = ContextVar("vipe_log_context", default=())

_STANDARD = frozenset(vars(logging.makeLogRecord({}))) | {"message", "asctime", "taskName", "color_message"}


@contextmanager
def context(**names: str | None) -> Iterator[None]:
    """Name the job, shard and video that the enclosed work belongs to; nested calls add and override."""
    merged = dict(_context.get())
    merged.update({name: value for name, value in names.items() if value is not None})
    token = _context.set(tuple(merged.items()))
    try:
        yield
    finally:
        _context.reset(token)


class _Formatter(logging.Formatter):
    """What both formats share: context, extras and redaction."""

    def fields(self, record: logging.LogRecord) -> dict[str, object]:
        # Ray's record factory adds fields of its own, with a leading underscore.
        extras = {k: v for k, v in vars(record).items() if k not in _STANDARD and not k.startswith("_")}
        return {**dict(_context.get()), **extras}


class JsonFormatter(_Formatter):
    """One JSON object per line: time, level, logger, message, then context, extras and a traceback if there is one."""

    def format(self, record: logging.LogRecord) -> str:
        line: dict[str, object] = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": redact(record.getMessage()),
        }
        for name, value in self.fields(record).items():
            line.setdefault(name, value if isinstance(value, int | float | bool | None) else redact(str(value)))
        if record.exc_info:
            line["traceback"] = redact(self.formatException(record.exc_info))
        return json.dumps(line, ensure_ascii=False)


class TextFormatter(_Formatter):
    """`12:00:00 INFO  services.agent.agent: message [job=... shard=...]`, the traceback below."""

    def format(self, record: logging.LogRecord) -> str:
        at = datetime.fromtimestamp(record.created).strftime("%H:%M:%S")
        fields = " ".join(f"{name}={value}" for name, value in self.fields(record).items())
        line = f"{at} {record.levelname:<7} {record.name}: {record.getMessage()}" + (f" [{fields}]" if fields else "")
        if record.exc_info:
            line += "\n" + self.formatException(record.exc_info)
        return redact(line)


def configure_logging(level: str = "INFO", fmt: LogFormat = "text", stream: TextIO | None = None) -> None:
    """Send every log record of this process to `stream` (standard error); safe to call again.

    Libraries that narrate every request are held at WARNING.

    Raises:
        ValueError: `level` is not the name of a log level.
    """
    handler = logging.StreamHandler(stream or sys.stderr)
    handler.setFormatter(JsonFormatter() if fmt == "json" else TextFormatter())
    root = logging.getLogger()
    for old in list(root.handlers):
        root.removeHandler(old)
    root.addHandler(handler)
    root.setLevel(level.upper())
    for noisy in ("botocore", "boto3", "s3transfer", "urllib3", "httpx", "httpcore", "alembic", "numba", "ray"):
        logging.getLogger(noisy).setLevel(max(logging.WARNING, root.level))
