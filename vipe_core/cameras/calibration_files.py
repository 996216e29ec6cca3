"""Calibrations in the files that users have: ours, COLMAP's, OpenCV's and nerfstudio's.

One camera of COLMAP's `cameras.txt`; the YAML or XML that OpenCV's calibration programs write with `FileStorage`;
nerfstudio's `transforms.json` where all frames share a camera. COLMAP's and nerfstudio's pixels have half-pixel centres
like ours, OpenCV's integer ones.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from vipe_core.cameras.calibration import Calibration, Use, checked_camera, coefficients_of, number_of, size_of
from vipe_core.cameras.camera import CameraModel
from vipe_core.errors import ConfigError

_FORMATS = "our camera.json, COLMAP's cameras.txt, OpenCV's YAML or XML, or nerfstudio's transforms.json"
# nerfstudio's file lists every frame.
_MAX_BYTES = 64 << 20
# COLMAP's models by (number of focal lengths, their names), with where their other parameters go in ours.
_COLMAP: dict[str, tuple[int, CameraModel, tuple[int, ...]]] = {
    "SIMPLE_PINHOLE": (1, "pinhole", ()),
    "PINHOLE": (2, "pinhole", ()),
    "SIMPLE_RADIAL": (1, "opencv", (0,)),
    "RADIAL": (1, "opencv", (0, 1)),
    "OPENCV": (2, "opencv", (0, 1, 2, 3)),
    "FULL_OPENCV": (2, "opencv", (0, 1, 2, 3, 4, 5, 6, 7)),
    "SIMPLE_RADIAL_FISHEYE": (1, "opencv_fisheye", (0,)),
    "RADIAL_FISHEYE": (1, "opencv_fisheye", (0, 1)),
    "OPENCV_FISHEYE": (2, "opencv_fisheye", (0, 1, 2, 3)),
}
_NERFSTUDIO: dict[str, CameraModel] = {"OPENCV": "opencv", "PINHOLE": "opencv", "OPENCV_FISHEYE": "opencv_fisheye"}


def read_calibration(path: str | Path, use: Use | None = None) -> Calibration:
    """The camera in a file of any of the formats of the module.

    Args:
        use: In place of what the file says; files of others say nothing and are `fixed`.

    Raises:
        ConfigError: No such file, or not one of these formats; names the file and what is wrong.
    """
    path = Path(path)
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise ConfigError(f"{path.name}: more than {_MAX_BYTES >> 20} MiB is no calibration")
        text = path.read_text(encoding="utf-8")
    except (OSError, ValueError) as error:
        reason = (error.strerror if isinstance(error, OSError) else None) or "not text"
        raise ConfigError(f"{path.name}: {reason}; give {_FORMATS}") from error
    found = _parsed(text, path.name)
    return found if use is None else replace(found, use=use)


def _parsed(text: str, name: str) -> Calibration:
    head = text.lstrip("\ufeff \t\r\n")
    if head.startswith("{"):
        try:
            data = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise ConfigError(f"{name}: not readable JSON; give {_FORMATS}") from error
        return _from_nerfstudio(data, name) if "fl_x" in data or "frames" in data else Calibration.from_json(data, name)
    if head.startswith(("%YAML", "<?xml")):
        return _from_opencv(text, name)
    return _from_colmap(text, name)


def _from_colmap(text: str, name: str) -> Calibration:
    rows = [line.split() for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    if not rows or any(len(row) < 5 or not row[0].isdigit() for row in rows):
        raise ConfigError(f"{name}: not a calibration; give {_FORMATS}")
    if len(rows) > 1:
        raise ConfigError(f"{name}: {len(rows)} cameras; give a file with the line of the one that took the video")
    _, model, *fields = rows[0]
    try:
        width, height = int(fields[0]), int(fields[1])
        values = [float(field) for field in fields[2:]]
    except ValueError as error:
        raise ConfigError(f"{name}: the line of a camera reads `ID MODEL WIDTH HEIGHT PARAMS...`") from error
    if model == "EUCM" and len(values) == 6 and values[5] == 1.0 and 0 <= values[4] < 1:
        # fx' X / (a' |P| + (1 - a') Z) is the unified model with alpha = a' / (1 - a'), fx = fx' / (1 - a').
        fx, fy, cx, cy, share, _ = values
        unified = (fx / (1 - share), fy / (1 - share), cx, cy, share / (1 - share))
        return Calibration(checked_camera("mei", unified, (width, height), name))
    if model not in _COLMAP:
        known = ", ".join((*_COLMAP, "EUCM with beta 1"))
        raise ConfigError(f"{name}: the camera model {model} is not understood; known: {known}")
    focals, ours, places = _COLMAP[model]
    if len(values) != focals + 2 + len(places):
        raise ConfigError(f"{name}: {model} takes {focals + 2 + len(places)} parameters, got {len(values)}")
    coefficients = np.zeros({"pinhole": 0, "opencv": 8, "opencv_fisheye": 4}[ours])
    coefficients[list(places)] = values[focals + 2 :]
    params = (values[0], values[focals - 1], *values[focals : focals + 2], *coefficients.tolist())
    return Calibration(checked_camera(ours, params, (width, height), name))


def _from_opencv(text: str, name: str) -> Calibration:
    import cv2

    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        matrix = _first(storage, ("camera_matrix", "cameraMatrix", "Camera_Matrix", "K", "intrinsic_matrix"))
        lens = _first(
            storage,
            ("distortion_coefficients", "distCoeffs", "dist_coeffs", "Distortion_Coefficients", "D"),
        )
        size = [
            _first_number(storage, (f"image_{side}", f"image_{side.capitalize()}", side))
            for side in ("width", "height")
        ]
        kinds = [storage.getNode(key).string() for key in ("distortion_model", "camera_model", "model")]
    except (cv2.error, SystemError) as error:
        raise ConfigError(f"{name}: not readable as OpenCV's YAML or XML; give {_FORMATS}") from error
    if matrix is None or matrix.shape != (3, 3) or any(side is None for side in size):
        raise ConfigError(f"{name}: `camera_matrix`, `image_width` and `image_height` are needed")
    fisheye = any(word in kind.lower() for kind in kinds for word in ("fisheye", "equidistant", "kannala"))
    model: CameraModel = "opencv_fisheye" if fisheye else "opencv"
    coefficients = coefficients_of(model, [] if lens is None else lens.reshape(-1).tolist(), name)
    if not fisheye and not any(coefficients):
        model, coefficients = "pinhole", ()
    fx, fy, cx, cy = (float(matrix[place]) for place in ((0, 0), (1, 1), (0, 2), (1, 2)))
    sides = {f"image_{side}": value for side, value in zip(("width", "height"), size, strict=True)}
    width_height = [size_of(sides, key, name) for key in sides]
    return Calibration(checked_camera(model, (fx, fy, cx + 0.5, cy + 0.5, *coefficients), width_height, name))


def _first(storage: Any, keys: Sequence[str]) -> Any:
    for key in keys:
        node = storage.getNode(key)
        if not node.empty() and node.mat() is not None:
            return node.mat()
    return None


def _first_number(storage: Any, keys: Sequence[str]) -> float | None:
    for key in keys:
        node = storage.getNode(key)
        if not node.empty() and (node.isInt() or node.isReal()):
            return float(node.real())
    return None


def _from_nerfstudio(data: Mapping[str, Any], name: str) -> Calibration:
    missing = [key for key in ("fl_x", "cx", "cy", "w", "h") if not isinstance(data.get(key), (int, float))]
    if missing:
        raise ConfigError(f"{name}: {', '.join(missing)} must stand beside the frames; one camera for all is needed")
    kind = data.get("camera_model", "OPENCV")
    if kind not in _NERFSTUDIO:
        raise ConfigError(f"{name}: the camera model {kind} is not understood; known: {', '.join(_NERFSTUDIO)}")
    model = _NERFSTUDIO[kind]
    order = ("k1", "k2", "k3", "k4") if model == "opencv_fisheye" else ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    coefficients = tuple(number_of(data, key, name) if key in data else 0.0 for key in order)
    if model == "opencv" and not any(coefficients):
        model, coefficients = "pinhole", ()
    fx, cx, cy = (number_of(data, key, name) for key in ("fl_x", "cx", "cy"))
    fy = number_of(data, "fl_y", name) if "fl_y" in data else fx
    size = [size_of(data, key, name) for key in ("w", "h")]
    return Calibration(checked_camera(model, (fx, fy, cx, cy, *coefficients), size, name))
