"""Camera poses, intrinsics and dense depth from raw video."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from vipe_core.annotation import Annotation, DenseFrame, Progress, Provenance, Quality
    from vipe_core.errors import VipeError
    from vipe_core.pipeline.annotator import Annotator, annotate

__all__ = ["Annotation", "Annotator", "DenseFrame", "Progress", "Provenance", "Quality", "VipeError", "annotate"]

# Resolved on first use: the decoder's child process imports `vipe_core.video` and must not wait for torch.
_HOMES = {
    "Annotation": "vipe_core.annotation",
    "DenseFrame": "vipe_core.annotation",
    "Progress": "vipe_core.annotation",
    "Provenance": "vipe_core.annotation",
    "Quality": "vipe_core.annotation",
    "VipeError": "vipe_core.errors",
    "Annotator": "vipe_core.pipeline.annotator",
    "annotate": "vipe_core.pipeline.annotator",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    import importlib

    return getattr(importlib.import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
