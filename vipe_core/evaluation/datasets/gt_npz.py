"""The project's own layout: a folder with `gt.npz` beside `video.mp4` or a directory of images."""

from __future__ import annotations

from pathlib import Path

from vipe_core.errors import FormatError
from vipe_core.evaluation.datasets.sequence import GroundTruthSequence, Pictures, label
from vipe_core.evaluation.truth import read_truth

_FILE = "gt.npz"
_VIDEO = "video.mp4"
_IMAGES = ("images", "rgb", "image_l")


def is_gt_npz_folder(folder: Path) -> bool:
    return (folder / _FILE).is_file()


def read_gt_npz(folder: Path, name: str) -> GroundTruthSequence:
    """Raises:
    FormatError: gt.npz is damaged, or no pictures lie beside it.
    """
    videos = [folder / _VIDEO, *sorted(folder.glob("*.mp4"))]
    images = [folder / inside for inside in _IMAGES]
    path = next((path for path in (*videos, *images) if path.exists()), None)
    if path is None:
        raise FormatError(f"{label(folder / _FILE)}: neither {_VIDEO} nor {', '.join(_IMAGES)} lies beside it")
    return GroundTruthSequence("gt", name, Pictures(path), read_truth(folder / _FILE))
