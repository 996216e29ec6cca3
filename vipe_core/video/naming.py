"""Names of sequences: safe in paths and tar keys, unique within a run, and the same every time."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

_UNSAFE = re.compile(r"[^A-Za-z0-9_-]+")
_MAX_LENGTH = 120


def sanitise_name(stem: str) -> str:
    """Keep [A-Za-z0-9_-]; a run of anything else becomes one `-`. Never empty, never starts with `-`.

    Dots go too: a webdataset key ends at the first dot.
    """
    name = _UNSAFE.sub("-", stem).strip("-")[:_MAX_LENGTH].rstrip("-")
    return name or "video"


def unique_names(paths: Iterable[str | Path]) -> dict[str, str]:
    """Path -> sequence name; where names collide, later paths get `-2`, `-3` ... in the given order.

    A suffixed name never takes a name that another path has by itself. Names that differ only in case collide, because
    file systems exist where they do.
    """
    ordered = list(dict.fromkeys(str(path) for path in paths))
    plain = {path: sanitise_name(_stem(path)) for path in ordered}
    reserved = {name.lower() for name in plain.values()}
    taken: set[str] = set()
    names: dict[str, str] = {}
    for path in ordered:
        name = plain[path]
        number = 1
        while name.lower() in taken or (number > 1 and name.lower() in reserved):
            number += 1
            name = f"{plain[path]}-{number}"
        taken.add(name.lower())
        names[path] = name
    return names


def _stem(path: str) -> str:
    as_path = Path(path)
    # A directory of images keeps what looks like a suffix: "run.01" and "run.02" are two names.
    return as_path.name if as_path.is_dir() else as_path.stem
