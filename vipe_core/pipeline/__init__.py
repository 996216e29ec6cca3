"""Presets and the annotator."""

from vipe_core.pipeline.annotator import Annotator, annotate
from vipe_core.pipeline.presets import CAMERAS, PRESETS, Preset, resolve

__all__ = ["CAMERAS", "PRESETS", "Annotator", "Preset", "annotate", "resolve"]
