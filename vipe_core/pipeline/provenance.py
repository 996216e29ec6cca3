"""Versions of the engine and of the libraries that a result depends on."""

from __future__ import annotations

import importlib.metadata
import platform

_LIBRARIES = ("torch", "numpy", "opencv-python-headless", "av", "poselib", "scipy", "numba")


def engine_version() -> str:
    """The installed version; `unknown` where the code is imported without being installed."""
    try:
        return importlib.metadata.version("vipe-cluster")
    except importlib.metadata.PackageNotFoundError:
        return "unknown"


def library_versions() -> dict[str, str]:
    """Library -> version, of those whose code touches the numbers."""
    versions = {"python": platform.python_version()}
    for library in _LIBRARIES:
        try:
            versions[library] = importlib.metadata.version(library)
        except importlib.metadata.PackageNotFoundError:
            continue
    return versions
