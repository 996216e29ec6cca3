"""Network weights: which files there are, where they come from, and where they lie on this machine.

The engine never downloads anything. `vipectl models` fills the folder; a provider asks for what it needs when it is
opened, and a missing file names the command. What was pulled is written down beside it: its checksum is compared with
the published one, or, where none is published, with that of the first pull.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from vipe_core.errors import WeightsInvalid, WeightsMissing

_CHUNK_BYTES = 1 << 20


@dataclass(frozen=True, slots=True)
class WeightFile:
    """A file of weights that can be had from the public.

    Attributes:
        name: What commands and messages call it.
        file: Its name on disk, which may have a folder. Networks of several files have one of their own, and the name
            of each file begins with the name of the network.
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


def _hub(name: str, repository: str, size_bytes: int, licence: str, files: tuple[str, ...]) -> tuple[WeightFile, ...]:
    """The files of a network on the hub; the first is the large one."""
    project = f"https://huggingface.co/{repository}"
    return tuple(
        WeightFile(
            name=f"{name}/{file}",
            file=f"{name}/{file}",
            urls=(f"{project}/resolve/main/{file}",),
            sha256=None,
            size_bytes=10_000 if number else size_bytes,
            licence=licence,
            project=project,
        )
        for number, file in enumerate(files)
    )


def _single(name: str, url: str, size_bytes: int, licence: str, project: str) -> WeightFile:
    return WeightFile(name, url.rsplit("/", 1)[1], (url,), None, size_bytes, licence, project)


_NETWORK = ("model.safetensors", "config.json")
_FOREIGN = "CC-BY-NC-4.0"

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
        *_hub(
            "grounding_dino",
            "IDEA-Research/grounding-dino-tiny",
            690_000_000,
            "Apache-2.0",
            (*_NETWORK, "tokenizer.json", "tokenizer_config.json"),
        ),
        *_hub("sam2_video", "facebook/sam2.1-hiera-base-plus", 324_000_000, "Apache-2.0", _NETWORK),
        *_hub("depth_pro", "apple/DepthPro-hf", 1_904_000_000, "apple-amlr", _NETWORK),
        *(
            network
            for scene in ("Indoor", "Outdoor")
            for network in _hub(
                f"depth_anything_{scene.lower()}",
                f"depth-anything/Depth-Anything-V2-Metric-{scene}-Small-hf",
                99_000_000,
                "Apache-2.0",
                _NETWORK,
            )
        ),
        *_hub("unidepth", "lpiccinelli/unidepth-v2-vitl14", 1_400_000_000, _FOREIGN, _NETWORK),
        *_hub("unik3d", "lpiccinelli/unik3d-vitl", 1_400_000_000, _FOREIGN, _NETWORK),
        *(
            _single(
                f"metric3d_{size}",
                f"https://huggingface.co/JUGGHM/Metric3D/resolve/main/metric_depth_vit_{size}_800k.pth",
                size_bytes,
                "BSD-2-Clause",
                "https://github.com/YvanYin/Metric3D",
            )
            for size, size_bytes in (("small", 150_000_000), ("large", 1_650_000_000), ("giant2", 5_500_000_000))
        ),
        *(
            _single(
                f"geocalib_{kind}",
                f"https://github.com/cvg/GeoCalib/releases/download/v1.0/geocalib-{kind}.tar",
                110_000_000,
                "Apache-2.0",
                "https://github.com/cvg/GeoCalib",
            )
            for kind in ("pinhole", "distorted")
        ),
        _single(
            "video_depth_anything",
            "https://huggingface.co/depth-anything/Video-Depth-Anything-Small/resolve/main/video_depth_anything_vits.pth",
            116_000_000,
            "Apache-2.0",
            "https://github.com/DepthAnything/Video-Depth-Anything",
        ),
        *_hub(
            "priorda",
            "Rain729/Prior-Depth-Anything",
            390_000_000,
            "Apache-2.0, of which Depth Anything V2 Base is CC-BY-NC-4.0",
            ("prior_depth_anything_vitb.pth", "depth_anything_v2_vitb.pth"),
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
        families = sorted({file.partition("/")[0] for file in WEIGHTS})
        raise WeightsMissing(f"there are no weights called {name!r}; known: {', '.join(families)}")
    return WEIGHTS[name]


def selected(names: Iterable[str]) -> tuple[str, ...]:
    """Names of files, for names of files or of networks with several.

    Raises:
        WeightsMissing: There is none of that name; the message lists what there is.
    """
    found: list[str] = []
    for name in names:
        inside = [file for file in WEIGHTS if file.startswith(f"{name}/")]
        found += inside or [known(name).name]
    return tuple(dict.fromkeys(found))


def folder_of(name: str) -> Path:
    """Where the files of a network with several lie or would lie."""
    return weights_folder() / name


def require_all(names: Iterable[str]) -> dict[str, str]:
    """Checksums of files, or of networks with several, all of them verified.

    Raises:
        WeightsMissing: Some are not on this machine; the message names the one command that fetches them all.
        WeightsInvalid: A checksum is not the one that it should have.
    """
    names = list(names)
    absent = [name for name in names if not all(path_of(file).is_file() for file in selected([name]))]
    if absent:
        raise WeightsMissing(
            f"weights are not on this machine ({', '.join(absent)} in {weights_folder()}); fetch them with"
            f" `vipectl models pull {' '.join(absent)}`"
        )
    return {file: require(file).sha256 for file in selected(names)}


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
