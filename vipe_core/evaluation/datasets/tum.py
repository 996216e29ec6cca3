"""TUM RGB-D, and the ETH3D SLAM benchmark, which took over its layout.

A sequence is a folder with `rgb.txt` (time, rgb/FILE), `depth.txt` where depth was downloaded, `groundtruth.txt`
(time tx ty tz qx qy qz qw, world_from_cam) at the tracker's own rate, and for ETH3D `calibration.txt` (fx fy cx cy).
Depth is in 1/5000 m, registered to colour. Times are associated as the dataset's own tools do: nearest within 20 ms.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vipe_core.cameras import Camera
from vipe_core.errors import FormatError
from vipe_core.evaluation.datasets.sequence import (
    GroundTruthSequence,
    LazyDepth,
    Pictures,
    label,
    nearest_rows,
    picture_size,
    read_depth_png,
    read_fields,
    read_table,
)
from vipe_core.evaluation.truth import GroundTruth
from vipe_core.geometry.arrays import matrix_from_quaternion

Array = NDArray[Any]

_MAX_APART_S = 0.02
_PER_METRE = 5000.0
# The factory calibrations that the dataset publishes, for 640x480. Freiburg3 is undistorted already.
_TUM_CAMERAS: dict[str, tuple[float, float, float, float]] = {
    "1": (517.3, 516.5, 318.6, 255.3),
    "2": (520.9, 521.0, 325.1, 249.7),
    "3": (535.4, 539.2, 320.1, 247.6),
}


def is_rgbd_folder(folder: Path) -> bool:
    return (folder / "rgb.txt").is_file()


def read_tum(folder: Path, name: str) -> GroundTruthSequence:
    """Raises:
    FormatError: A file is missing or not in the layout; names it.
    """
    return _read("tum", folder, name, _tum_camera)


def read_eth3d(folder: Path, name: str) -> GroundTruthSequence:
    """Raises:
    FormatError: A file is missing or not in the layout; names it. Test sequences have no groundtruth.txt.
    """
    return _read("eth3d", folder, name, _eth3d_camera)


def poses_from_rows(rows: Array, path: Path) -> NDArray[np.float64]:
    """(N, 7) tx ty tz qx qy qz qw -> (N, 4, 4).

    Raises:
        FormatError: A quaternion has no length; names `path`.
    """
    length = np.linalg.norm(rows[:, 3:], axis=1)
    if not (np.isfinite(rows).all() and (length > 0.5).all()):
        raise FormatError(f"{label(path)}: a pose whose quaternion is none")
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3] = matrix_from_quaternion(rows[:, 3:])
    poses[:, :3, 3] = rows[:, :3]
    return poses


def times_from_zero(times_s: Array, path: Path) -> tuple[float, ...]:
    """Times relative to the first.

    Raises:
        FormatError: They do not increase; names `path`.
    """
    if not (np.diff(times_s) > 0).all():
        raise FormatError(f"{label(path)}: times must increase")
    return tuple((times_s - times_s[0]).tolist())


def _read(
    dataset: str, folder: Path, name: str, camera: Callable[[Path, tuple[int, int]], Camera | None]
) -> GroundTruthSequence:
    times_s, files = _listed(folder / "rgb.txt", "rgb")
    truth_path = folder / "groundtruth.txt"
    table = read_table(truth_path, 8)
    table = table[np.argsort(table[:, 0], kind="stable")]
    rows = nearest_rows(times_s, table[:, 0], _MAX_APART_S)
    frames = np.flatnonzero(rows >= 0)
    if len(frames) < 2:
        raise FormatError(f"{label(truth_path)}: fewer than two pictures of rgb.txt lie within its times")
    return GroundTruthSequence(
        dataset,
        name,
        Pictures(folder / "rgb", files, times_from_zero(times_s, folder / "rgb.txt")),
        GroundTruth(
            world_from_cam=poses_from_rows(table[rows[frames], 1:], truth_path),
            frame_index=frames.astype(np.int64),
            camera=camera(folder, picture_size(folder / "rgb" / files[0])),
            depth=_depth(folder, times_s[frames]),
            depth_kind="z",
            dynamic=None,
        ),
    )


def _listed(path: Path, inside: str) -> tuple[Array, tuple[str, ...]]:
    """Times and names of the pictures of a list."""
    fields = read_fields(path, 2)
    try:
        times_s = np.array([float(line[0]) for line in fields])
    except ValueError as error:
        raise FormatError(f"{label(path)}: lines must read like `1305031102.175304 {inside}/FILE.png`") from error
    paths = [Path(line[1]) for line in fields]
    if any(picture.parent != Path(inside) for picture in paths):
        raise FormatError(f"{label(path)}: pictures are expected in the folder {inside}")
    return times_s, tuple(picture.name for picture in paths)


def _depth(folder: Path, times_s: Array) -> LazyDepth | None:
    """Depth of the frames at `times_s`; zeros where none was taken within 20 ms. None without depth.txt."""
    path = folder / "depth.txt"
    if not path.is_file():
        return None
    depth_times_s, files = _listed(path, "depth")
    rows = nearest_rows(times_s, depth_times_s, _MAX_APART_S)
    width, height = picture_size(folder / "depth" / files[0])

    def read(row: int) -> Array:
        if rows[row] < 0:
            return np.zeros((height, width), np.float32)
        return read_depth_png(folder / "depth" / files[rows[row]], _PER_METRE)

    return LazyDepth((len(times_s), height, width), read)


def _tum_camera(folder: Path, size: tuple[int, int]) -> Camera | None:
    found = re.search(r"freiburg([123])", folder.name)
    if found is None:
        return None
    return Camera("pinhole", _TUM_CAMERAS[found[1]], 640, 480).resized(*size)


def _eth3d_camera(folder: Path, size: tuple[int, int]) -> Camera:
    fx, fy, cx, cy = (float(x) for x in read_table(folder / "calibration.txt", 4)[0])
    return Camera("pinhole", (fx, fy, cx, cy), *size)
