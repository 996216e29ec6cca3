"""MPI Sintel: `training/{final,clean}/NAME/frame_0001.png`, `training/camdata_left/NAME/frame_0001.cam`,
`training/depth/NAME/frame_0001.dpt`.

Both binary files start with the float 202021.25 and are little-endian. A camera holds the 3x3 intrinsics and the 3x4
cam_from_world in float64, a depth map its width and height in int32 and z in float32. Pictures are 24 per second.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vipe_core.cameras import Camera
from vipe_core.errors import ConfigError, FormatError
from vipe_core.evaluation.datasets.sequence import GroundTruthSequence, LazyDepth, Pictures, label, picture_size
from vipe_core.evaluation.truth import GroundTruth
from vipe_core.geometry.arrays import inverse

Array = NDArray[Any]

_TAG = 202021.25
_FPS = 24.0
_PASSES = ("final", "clean")


def find_sintel(root: Path) -> dict[str, Path]:
    """Sequences of the final pass, or of the clean one where there is no other, by name."""
    for base in (root / "training", root):
        for rendered in _PASSES:
            folders = sorted(folder for folder in (base / rendered).glob("*") if folder.is_dir())
            if folders:
                return {folder.name: folder for folder in folders}
    return {}


def read_sintel(folder: Path, name: str) -> GroundTruthSequence:
    """Raises:
    FormatError: A file is missing or not in the layout; names it.
    """
    training = folder.parent.parent
    files = tuple(sorted(file.name for file in folder.glob("frame_*.png")))
    if len(files) < 2:
        raise FormatError(f"{label(folder)}: fewer than two pictures frame_0001.png ...; was the download cut short?")
    stems = [Path(file).stem for file in files]
    cameras = [_read_camera(training / "camdata_left" / name / f"{stem}.cam") for stem in stems]
    # The focal length of some shots changes a little; the engine has one camera per video.
    matrix = np.median([intrinsics for intrinsics, _ in cameras], axis=0)
    size = picture_size(folder / files[0])
    try:
        camera = Camera("pinhole", (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]), *size)
    except ConfigError as error:
        raise FormatError(f"camdata_left/{name}: {error}") from error
    depth_folder = training / "depth" / name
    depth = None
    if depth_folder.is_dir():
        shape = _read_depth(depth_folder / f"{stems[0]}.dpt").shape
        depth = LazyDepth((len(files), *shape), lambda row: _read_depth(depth_folder / f"{stems[row]}.dpt"))
    return GroundTruthSequence(
        "sintel",
        name,
        Pictures(folder, files, tuple(k / _FPS for k in range(len(files)))),
        GroundTruth(
            world_from_cam=inverse(np.stack([cam_from_world for _, cam_from_world in cameras])),
            frame_index=np.arange(len(files), dtype=np.int64),
            camera=camera,
            depth=depth,
            depth_kind="z",
            dynamic=None,
        ),
        notes=(f"{folder.parent.name} pass",),
    )


def _read_camera(path: Path) -> tuple[Array, Array]:
    """(3, 3) intrinsics and (4, 4) cam_from_world."""
    values = np.frombuffer(_body(path, 21 * 8), dtype="<f8")
    cam_from_world = np.eye(4)
    cam_from_world[:3] = values[9:].reshape(3, 4)
    return values[:9].reshape(3, 3), cam_from_world


def _read_depth(path: Path) -> Array:
    """(h, w) float32 z in metres."""
    body = _body(path, None)
    width, height = struct.unpack("<ii", body[:8]) if len(body) >= 8 else (0, 0)
    if width < 1 or height < 1 or len(body) != 8 + 4 * width * height:
        raise FormatError(f"{label(path)}: its size does not fit its header; was the download cut short?")
    return np.frombuffer(body, dtype="<f4", offset=8).reshape(height, width)


def _body(path: Path, length: int | None) -> bytes:
    """What follows the tag of a Sintel file."""
    try:
        content = path.read_bytes()
    except FileNotFoundError as error:
        raise FormatError(f"{label(path)}: no such file; is this a folder of the dataset?") from error
    except OSError as error:
        raise FormatError(f"{label(path)}: not a readable file") from error
    if len(content) < 4 or struct.unpack("<f", content[:4])[0] != _TAG:
        raise FormatError(f"{label(path)}: does not start with the tag of a Sintel file")
    if length is not None and len(content) != 4 + length:
        raise FormatError(f"{label(path)}: {len(content)} bytes, {4 + length} are needed")
    return content[4:]
