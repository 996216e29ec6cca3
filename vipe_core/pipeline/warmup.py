"""A tiny video that takes an annotator through all of its stages, so that the next one waits for nothing."""

from __future__ import annotations

from pathlib import Path

from vipe_core.annotation import Annotation
from vipe_core.cameras import CameraModel
from vipe_core.evaluation.synthetic import tiny_clip
from vipe_core.pipeline.annotator import Annotator

_FRAMES = 14
# Panoramas are twice as wide as high, and each face of their cube needs pixels enough to be matched.
_SIZES: dict[CameraModel, tuple[int, int]] = {"pinhole": (192, 144), "mei": (192, 144), "equirect": (512, 256)}
# What the annotator estimates -> what the clip is seen by.
_SEEN_BY: dict[str, CameraModel] = {"pinhole": "pinhole", "mei": "mei", "auto": "mei", "equirect": "equirect"}


def warm_up(annotator: Annotator, folder: Path) -> Annotation:
    """Annotates a clip that is written into `folder`: libraries are loaded, kernels are compiled, memory is there.

    Its dense stream reads the clip again, so the folder must stay until that was read.

    Raises:
        VipeError: As `Annotator.annotate`.
    """
    model = _SEEN_BY[annotator.preset.camera]
    clip = tiny_clip("dynamic", _FRAMES, *_SIZES[model], model=model, noise=1.0)
    return annotator.annotate(clip.write_video(folder / "clip.mp4"))
