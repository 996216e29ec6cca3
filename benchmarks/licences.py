"""Licences of everything that is installed at runtime: `python -m benchmarks.licences` writes docs/licences.md."""

from __future__ import annotations

import argparse
import importlib.metadata as metadata
import re
import sys
import tomllib
from dataclasses import dataclass
from pathlib import Path

from packaging.requirements import Requirement

_ROOT = Path(__file__).resolve().parents[1]
PAGE = _ROOT / "docs" / "licences.md"
_EXTRAS = ("postgres",)

# Where a package does not say it in its metadata, from the licence file that it ships.
_FROM_ITS_FILES = {"openexr": "BSD-3-Clause"}
# One word of each licence that may come in: those without conditions on our own code.
_WELCOME = re.compile(
    r"MIT|BSD|Apache|PSF|Python Software Foundation|MPL-2\.0|Mozilla Public License 2\.0|ISC|Zlib|CC0|0BSD|BSL-1\.0|"
    r"CNRI-Python|HPND|LGPL",
    re.IGNORECASE,
)
_UNWELCOME = re.compile(
    r"\bA?GPL|(?<!Lesser )General Public|SSPL|Commons Clause|Proprietary|Non-?Commercial", re.IGNORECASE
)

# What the CUDA build of torch brings along, on machines with GPUs only: the page is the same for both builds.
_CUDA = ("nvidia-", "cuda-", "triton")

# Native libraries under the GPL that a wheel brings along, and what that means.
GPL_LIBRARIES = {
    "libx264": "encodes H.264; written by `vipe_core.video.encode`",
    "libx265": "encodes H.265; never called by this project",
}


@dataclass(frozen=True, slots=True)
class Package:
    name: str
    licence: str
    gpl_libraries: tuple[str, ...]

    @property
    def welcome(self) -> bool:
        return _WELCOME.search(self.licence) is not None and _UNWELCOME.search(self.licence) is None


def runtime_packages() -> list[Package]:
    """What the project and its extras for operation install, with all that these need, by name."""
    project = tomllib.loads((_ROOT / "pyproject.toml").read_text())["project"]
    waiting = [Requirement(text) for text in project["dependencies"]]
    waiting += [Requirement(text) for extra in _EXTRAS for text in project["optional-dependencies"][extra]]
    found: dict[str, Package] = {}
    done: set[tuple[str, frozenset[str]]] = set()
    while waiting:
        requirement = waiting.pop()
        name = re.sub(r"[-_.]+", "-", requirement.name).lower()
        extras = frozenset(requirement.extras)
        if (name, extras) in done or name.startswith(_CUDA):
            continue
        done.add((name, extras))
        try:
            distribution = metadata.distribution(name)
        except metadata.PackageNotFoundError:
            continue  # For another platform or Python.
        found[name] = Package(name, _licence(name, distribution), _gpl_libraries(distribution))
        for text in distribution.requires or ():
            needed = Requirement(text)
            if needed.marker is None or any(needed.marker.evaluate({"extra": extra}) for extra in ("", *extras)):
                waiting.append(needed)
    return [found[name] for name in sorted(found)]


def _licence(name: str, distribution: metadata.Distribution) -> str:
    fields = distribution.metadata
    if name in _FROM_ITS_FILES:
        return _FROM_ITS_FILES[name]
    if expression := fields.get_all("License-Expression"):
        return str(expression[0])
    kinds = [c.rpartition("::")[2].strip() for c in fields.get_all("Classifier") or () if c.startswith("License ::")]
    if kinds:
        return "; ".join(kinds)
    stated = "\n".join(fields.get_all("License") or ()).strip()
    return next(iter(stated.splitlines()), "unknown")


def _gpl_libraries(distribution: metadata.Distribution) -> tuple[str, ...]:
    names = {Path(str(file)).name.partition("-")[0].partition(".")[0] for file in distribution.files or ()}
    return tuple(sorted(names & GPL_LIBRARIES.keys()))


def page(packages: list[Package]) -> str:
    lines = [
        "# Licences of what is installed at runtime",
        "",
        "Written by `python -m benchmarks.licences` from the metadata of the installed packages; a test keeps it",
        "current and refuses licences that would put conditions on this project's own code.",
        "",
        "| package | licence |",
        "|---|---|",
        *(f"| {package.name} | {package.licence} |" for package in packages),
        "",
        "Native libraries: the FFmpeg inside of `av` states LGPL 3 or later and the one inside of",
        "`opencv-python-headless` LGPL 2.1 or later; both are loaded dynamically and can be replaced. The CUDA build",
        "of `torch` brings NVIDIA's libraries along (`nvidia-*`, `cuda-*`), which are under NVIDIA's own terms, and",
        "`triton` (MIT).",
    ]
    for package in packages:
        for library in package.gpl_libraries:
            lines += [
                "",
                f"The wheel of `{package.name}` also holds **{library}**, which is under the GPL 2 or later "
                f"({GPL_LIBRARIES[library]}).",
            ]
    lines += [
        "",
        "Installing such a wheel from its publisher leaves this project's licence as it is. Whoever redistributes it,",
        "in a container image for instance, redistributes GPL code and must keep to the GPL for it, or build `av`",
        "without these libraries (`pip install --no-binary av av` against an FFmpeg without them).",
    ]
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, default=PAGE)
    args = parser.parse_args()
    packages = runtime_packages()
    args.output.parent.mkdir(parents=True, exist_ok=True)
    args.output.write_text(page(packages))
    unwelcome = [package for package in packages if not package.welcome]
    for package in unwelcome:
        print(f"{package.name}: {package.licence}")
    print(f"{len(packages)} packages, {len(unwelcome)} with a licence that must not come in; see {args.output}")
    sys.exit(1 if unwelcome else 0)


if __name__ == "__main__":
    main()
