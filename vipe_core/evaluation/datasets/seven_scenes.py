"""7-Scenes: `SCENE/seq-NN/frame-000000.{color.png,depth.png,pose.txt}`.

Poses are 4x4 world_from_cam in metres; depth is in millimetres, 65535 where there is none. The dataset publishes a
nominal camera for depth only, so the field of view of the colour pictures is not judged, and its depth is not
registered to colour: errors of about a per cent are the sensor's.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vipe_core.errors import FormatError
from vipe_core.evaluation.datasets.sequence import (
    GroundTruthSequence,
    LazyDepth,
    Pictures,
    label,
    picture_size,
    read_depth_png,
    read_table,
)
from vipe_core.evaluation.truth import GroundTruth

Array = NDArray[Any]

_FPS = 30.0
_COLOUR = ".color.png"
_NO_DEPTH = 65535


def is_seven_scenes_folder(folder: Path) -> bool:
    return any(folder.glob(f"frame-*{_COLOUR}"))


def read_seven_scenes(folder: Path, name: str) -> GroundTruthSequence:
    """Raises:
    FormatError: A file is missing or not in the layout; names it.
    """
    files = tuple(sorted(file.name for file in folder.glob(f"frame-*{_COLOUR}")))
    stems = [file.removesuffix(_COLOUR) for file in files]
    poses = np.stack([_read_pose(folder / f"{stem}.pose.txt") for stem in stems])
    # Frames that the tracker of the dataset lost are marked by numbers that are none.
    known = np.flatnonzero(np.isfinite(poses).all(axis=(1, 2)))
    if len(known) < 2:
        raise FormatError(f"{label(folder)}: fewer than two frames have a pose")

    def read(row: int) -> Array:
        return read_depth_png(folder / f"{stems[known[row]]}.depth.png", 1000.0, _NO_DEPTH)

    depth = None
    first = folder / f"{stems[known[0]]}.depth.png"
    if first.is_file():
        width, height = picture_size(first)
        depth = LazyDepth((len(known), height, width), read)
    return GroundTruthSequence(
        "7scenes",
        name,
        Pictures(folder, files, tuple(k / _FPS for k in range(len(files)))),
        GroundTruth(poses[known], known.astype(np.int64), None, depth, "z", None),
        notes=("depth is not registered to colour", "the colour camera is not calibrated"),
    )


def _read_pose(path: Path) -> Array:
    pose = read_table(path, 4)
    if pose.shape != (4, 4):
        raise FormatError(f"{label(path)}: four lines of four numbers are needed")
    return pose
