"""Names of sequences: safe in paths and tar keys."""

from __future__ import annotations

import re

_UNSAFE = re.compile(r"[^A-Za-z0-9_-]+")
_MAX_LENGTH = 120


def sanitise_name(stem: str) -> str:
    """Keep [A-Za-z0-9_-]; a run of anything else becomes one `-`. Never empty, never starts with `-`.

    Dots go too: a webdataset key ends at the first dot.
    """
    name = _UNSAFE.sub("-", stem).strip("-")[:_MAX_LENGTH].rstrip("-")
    return name or "video"
