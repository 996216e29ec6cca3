"""EuRoC MAV in the ASL layout: `SEQUENCE/mav0/cam0/{data.csv,sensor.yaml,data/*.png}` and
`mav0/state_groundtruth_estimate0/data.csv`.

Times are integer nanoseconds. The truth is world_from_body with the quaternion in the order w, x, y, z; the camera's
place on the body is `T_BS` of its sensor.yaml. The pictures are strongly distorted; the view takes the distortion out
with the published coefficients and keeps the camera matrix.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vipe_core.cameras import Camera
from vipe_core.cameras.calibration import coefficients_of
from vipe_core.cameras.pixel_map import PixelMap
from vipe_core.errors import ConfigError, FormatError
from vipe_core.evaluation.datasets.sequence import (
    GroundTruthSequence,
    Pictures,
    label,
    nearest_rows,
    read_fields,
    read_table,
)
from vipe_core.evaluation.datasets.tum import poses_from_rows, times_from_zero
from vipe_core.evaluation.truth import GroundTruth

Array = NDArray[Any]

_MAX_APART_S = 0.01


def is_euroc_folder(folder: Path) -> bool:
    return (folder / "mav0" / "cam0").is_dir()


def read_euroc(folder: Path, name: str) -> GroundTruthSequence:
    """Raises:
    FormatError: A file is missing or not in the layout; names it.
    ConfigError: PyYAML is not installed.
    """
    cam = folder / "mav0" / "cam0"
    listed = cam / "data.csv"
    fields = [[cell.strip() for cell in line] for line in read_fields(listed, 2, ",")]
    truth_path = folder / "mav0" / "state_groundtruth_estimate0" / "data.csv"
    table = read_table(truth_path, 8, ",")
    try:
        # Integers until they are relative to the first: nanoseconds since 1970 have more digits than a double.
        stamps_ns = np.array([int(line[0]) for line in fields])
        truth_ns = np.array([int(line[0]) for line in read_fields(truth_path, 8, ",")])
    except ValueError as error:
        raise FormatError(f"{label(listed)}, {label(truth_path)}: times must be integer nanoseconds") from error
    times_s = (stamps_ns - stamps_ns[0]) * 1e-9
    rows = nearest_rows(times_s, (truth_ns - stamps_ns[0]) * 1e-9, _MAX_APART_S)
    frames = np.flatnonzero(rows >= 0)
    if len(frames) < 2:
        raise FormatError(f"{label(truth_path)}: fewer than two pictures of cam0 lie within its times")
    lens, camera, body_from_cam = _read_sensor(cam / "sensor.yaml")
    xyzw = table[rows[frames]][:, [1, 2, 3, 5, 6, 7, 4]]
    return GroundTruthSequence(
        "euroc",
        name,
        Pictures(
            cam / "data",
            tuple(line[1] for line in fields),
            times_from_zero(times_s, listed),
            seen_by=PixelMap(lens, camera),
        ),
        GroundTruth(
            world_from_cam=poses_from_rows(xyzw, truth_path) @ body_from_cam,
            frame_index=frames.astype(np.int64),
            camera=camera,
            depth=None,
            depth_kind="z",
            dynamic=None,
        ),
        notes=("undistorted with the published coefficients",),
    )


def _read_sensor(path: Path) -> tuple[Camera, Camera, Array]:
    """The lens, the pinhole that is its undistorted camera, and body_from_cam."""
    try:
        import yaml
    except ImportError as error:
        raise ConfigError("reading EuRoC needs PyYAML; install vipe-cluster[eval]") from error
    try:
        sensor = yaml.safe_load(path.read_text(encoding="utf-8"))
        fx, fy, cx, cy = (float(x) for x in sensor["intrinsics"])
        width, height = (int(x) for x in sensor["resolution"])
        coefficients = coefficients_of("opencv", sensor["distortion_coefficients"], label(path))
        body_from_cam = np.array(sensor["T_BS"]["data"], dtype=np.float64).reshape(4, 4)
        kinds = sensor["camera_model"], sensor["distortion_model"]
        camera = Camera.from_index_params("pinhole", (fx, fy, cx, cy), width, height)
        lens = Camera.from_index_params("opencv", (fx, fy, cx, cy, *coefficients), width, height)
    except FileNotFoundError as error:
        raise FormatError(f"{label(path)}: no such file; is this a folder of the dataset?") from error
    except (OSError, KeyError, TypeError, ValueError, ConfigError, yaml.YAMLError) as error:
        first_line = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise FormatError(f"{label(path)}: not the description of a camera ({first_line})") from error
    if kinds != ("pinhole", "radial-tangential"):
        raise FormatError(f"{label(path)}: a pinhole with radial-tangential distortion is needed, got {kinds}")
    return lens, camera, body_from_cam
