"""Versions of the engine and of the libraries that a result depends on."""

from __future__ import annotations

import importlib.metadata
import platform
from collections.abc import Iterable

_LIBRARIES = ("torch", "numpy", "opencv-python-headless", "av", "poselib", "scipy", "numba")
_OF_PROVIDERS = {"hf": "transformers", "nvidia_vipe": "nvidia-vipe", "cuvslam": "cuvslam"}


def engine_version() -> str:
    """The installed version; `unknown` where the code is imported without being installed."""
    try:
        return importlib.metadata.version("vipe-cluster")
    except importlib.metadata.PackageNotFoundError:
        return "unknown"


def library_versions(providers: Iterable[str] = ()) -> dict[str, str]:
    """Library -> version, of those whose code touches the numbers with these providers."""
    versions = {"python": platform.python_version()}
    families = {provider.partition(".")[0] for provider in providers}
    used = (library for family, library in _OF_PROVIDERS.items() if family in families)
    for library in (*_LIBRARIES, *used):
        try:
            versions[library] = importlib.metadata.version(library)
        except importlib.metadata.PackageNotFoundError:
            continue
    return versions
