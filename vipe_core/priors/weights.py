"""Network weights: which files there are, where they come from, and where they lie on this machine.

The engine never downloads anything. `vipectl models` fills the folder; a provider asks for what it needs when it is
opened, and a missing file names the command. What was pulled is written down beside it: its checksum is compared with
the published one, or, where none is published, with that of the first pull.
"""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import dataclass
from pathlib import Path

from vipe_core.errors import WeightsInvalid, WeightsMissing

_CHUNK_BYTES = 1 << 20


@dataclass(frozen=True, slots=True)
class WeightFile:
    """A file of weights that can be had from the public.

    Attributes:
        name: What commands and messages call it.
        file: Its name on disk.
        urls: Where it is, tried in order.
        sha256: Published checksum; None where nobody has published one: then that of the first pull counts.
        size_bytes: Its size, about; for people.
        licence: Under which it is given away.
        project: Whose it is.
    """

    name: str
    file: str
    urls: tuple[str, ...]
    sha256: str | None
    size_bytes: int
    licence: str
    project: str


WEIGHTS: dict[str, WeightFile] = {
    weights.name: weights
    for weights in (
        WeightFile(
            name="droid",
            file="droid.pth",
            urls=(
                "https://drive.usercontent.google.com/download?id=1PpqVt1H4maBa_GbPJp4NwxRsd9jk-elh&export=download"
                "&confirm=t",
            ),
            sha256=None,
            size_bytes=16_000_000,
            licence="BSD-3-Clause",
            project="https://github.com/princeton-vl/DROID-SLAM",
        ),
    )
}


@dataclass(frozen=True, slots=True)
class Record:
    """What was written down when a file was pulled.

    Attributes:
        sha256: Of the file, hexadecimal.
        size_bytes: Of the file.
        origin: Where it came from, without credentials.
    """

    sha256: str
    size_bytes: int
    origin: str


@dataclass(frozen=True, slots=True)
class Installed:
    """A file of weights on this machine.

    Attributes:
        path: The file.
        sha256: Its checksum, computed now.
    """

    path: Path
    sha256: str


def weights_folder() -> Path:
    """Where weights lie: `VIPE_WEIGHTS`, or a folder in the user's cache."""
    chosen = os.environ.get("VIPE_WEIGHTS")
    if chosen:
        return Path(chosen).expanduser()
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "vipe_core" / "weights"


def known(name: str) -> WeightFile:
    """The file of that name.

    Raises:
        WeightsMissing: There is none; the message lists what there is.
    """
    if name not in WEIGHTS:
        raise WeightsMissing(f"there are no weights called {name!r}; known: {', '.join(sorted(WEIGHTS))}")
    return WEIGHTS[name]


def path_of(name: str) -> Path:
    """Where the file of that name lies or would lie."""
    return weights_folder() / known(name).file


def require(name: str) -> Installed:
    """The file of that name, verified.

    Raises:
        WeightsMissing: It is not on this machine.
        WeightsInvalid: Its checksum is not the one that it should have.
    """
    path = path_of(name)
    if not path.is_file():
        raise WeightsMissing(
            f"the weights {name!r} are not on this machine ({path} does not exist); fetch them with"
            f" `vipectl models pull {name}`"
        )
    return Installed(path, verified(name, path))


def verified(name: str, path: Path) -> str:
    """The checksum of a file that is to be the weights `name`.

    Raises:
        WeightsInvalid: It is not the published one, or the one that was written down.
    """
    found, expected = checksum(path), expected_sha256(name)
    if expected is not None and found != expected:
        raise WeightsInvalid(
            f"{path.name} has the SHA-256 {found} instead of {expected}: it is damaged or another file; fetch it again"
            f" with `vipectl models pull {name} --force`"
        )
    return found


def expected_sha256(name: str) -> str | None:
    """The published checksum, or that of the pull; None where neither is known."""
    published = known(name).sha256
    if published is not None:
        return published
    record = record_of(name)
    return None if record is None else record.sha256


def record_of(name: str) -> Record | None:
    """What was written down about a pull; None where nothing readable was."""
    try:
        content = json.loads(_record_path(name).read_text())
        return Record(str(content["sha256"]), int(content["size_bytes"]), str(content["origin"]))
    except (OSError, ValueError, KeyError, TypeError):
        return None


def write_record(name: str, record: Record) -> None:
    """Write down a pull."""
    path = _record_path(name)
    temporary = path.with_name(f".{path.name}.partial")
    content = {"origin": record.origin, "sha256": record.sha256, "size_bytes": record.size_bytes}
    temporary.write_text(json.dumps(content, indent=1) + "\n")
    temporary.replace(path)


def checksum(path: Path) -> str:
    """SHA-256 of a file, hexadecimal."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while chunk := file.read(_CHUNK_BYTES):
            digest.update(chunk)
    return digest.hexdigest()


def _record_path(name: str) -> Path:
    path = path_of(name)
    return path.with_name(f"{path.name}.json")
