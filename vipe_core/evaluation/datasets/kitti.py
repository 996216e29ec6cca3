"""KITTI odometry: `sequences/NN/{image_2,image_0}/*.png`, `calib.txt`, `times.txt`, and `poses/NN.txt`.

Poses are of the left grey camera (camera 0), 3x4 row-major, one line per picture; camera k stands beside it by what the
last column of its projection matrix P_k says. Colour (camera 2) is taken where it is there.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vipe_core.cameras import Camera
from vipe_core.errors import FormatError
from vipe_core.evaluation.datasets.sequence import (
    GroundTruthSequence,
    Pictures,
    label,
    picture_size,
    read_fields,
    read_table,
)
from vipe_core.evaluation.datasets.tum import times_from_zero
from vipe_core.evaluation.truth import GroundTruth

Array = NDArray[Any]

_CAMERAS = (2, 0)


def find_kitti(root: Path) -> dict[str, Path]:
    """Sequences that have poses (00 to 10 of the published ones), by number."""
    for base in (root, root / "dataset"):
        folders = sorted(folder for folder in (base / "sequences").glob("[0-9]*") if folder.is_dir())
        found = {folder.name: folder for folder in folders if (base / "poses" / f"{folder.name}.txt").is_file()}
        if found:
            return found
    return {}


def read_kitti(folder: Path, name: str) -> GroundTruthSequence:
    """Raises:
    FormatError: A file is missing or not in the layout; names it.
    """
    camera_number = next((k for k in _CAMERAS if (folder / f"image_{k}").is_dir()), None)
    if camera_number is None:
        raise FormatError(f"{label(folder)}: neither image_2 nor image_0 is there; is this a folder of the dataset?")
    pictures = folder / f"image_{camera_number}"
    files = tuple(sorted(file.name for file in pictures.glob("*.png")))
    if not files:
        raise FormatError(f"{label(pictures)}: holds no png; was the download cut short?")
    poses_path = folder.parent.parent / "poses" / f"{folder.name}.txt"
    times_s = read_table(folder / "times.txt", 1)[:, 0]
    table = read_table(poses_path, 12)
    if not len(files) == len(times_s) == len(table):
        raise FormatError(
            f"{label(poses_path)}: {len(table)} poses for the {len(files)} pictures and {len(times_s)} times of {name}"
        )
    world_from_first = np.tile(np.eye(4), (len(table), 1, 1))
    world_from_first[:, :3] = table.reshape(-1, 3, 4)
    projection = _projection(folder / "calib.txt", camera_number)
    first_from_camera = np.eye(4)
    first_from_camera[:3, 3] = -np.linalg.solve(projection[:, :3], projection[:, 3])
    fx, fy, cx, cy = (float(projection[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return GroundTruthSequence(
        "kitti",
        name,
        Pictures(pictures, files, times_from_zero(times_s, folder / "times.txt")),
        GroundTruth(
            world_from_cam=world_from_first @ first_from_camera,
            frame_index=np.arange(len(files), dtype=np.int64),
            camera=Camera("pinhole", (fx, fy, cx, cy), *picture_size(pictures / files[0])),
            depth=None,
            depth_kind="z",
            dynamic=None,
        ),
    )


def _projection(path: Path, camera_number: int) -> Array:
    """(3, 4) projection matrix of a rectified camera."""
    for fields in read_fields(path, 13):
        if fields[0] == f"P{camera_number}:":
            try:
                return np.array(fields[1:13], dtype=np.float64).reshape(3, 4)
            except ValueError as error:
                raise FormatError(f"{label(path)}: the line P{camera_number} must hold 12 numbers") from error
    raise FormatError(f"{label(path)}: the line P{camera_number} is missing")
