"""Calibrations: our JSON, the files of others, and sizes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vipe_core.cameras import Camera, CameraModel
from vipe_core.cameras.calibration import Calibration
from vipe_core.cameras.calibration_files import read_calibration
from vipe_core.errors import CalibrationMismatch, ConfigError

PINHOLE: dict[str, Any] = {
    "version": 1,
    "model": "pinhole",
    "width": 640,
    "height": 480,
    "fx": 500,
    "fy": 510.5,
    "cx": 371.2,
    "cy": 240,
}

focal = st.floats(300, 2000)
_MATRIX = """camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 50., 0., 32., 0., 50., 24., 0., 0., 1. ]
"""


@given(
    fx=focal, fy=focal, cx=st.floats(1, 639), cy=st.floats(1, 479), model=st.sampled_from(["pinhole", "mei", "opencv"])
)
def test_our_json_gives_the_same_camera_back_to_the_last_bit(
    fx: float, fy: float, cx: float, cy: float, model: CameraModel
) -> None:
    shape = {"pinhole": (), "mei": (cx / 640,), "opencv": (-1e-4 / 3, 1e-5, 0, 0, 0, 0, 0, 0)}[model]
    known = Calibration(Camera(model, (fx, fy, cx, cy, *shape), 640, 480), "initial")
    assert Calibration.from_json(json.loads(json.dumps(known.to_json()))) == known


def test_integer_pixel_centres_are_half_a_pixel_off_ours() -> None:
    ours, opencv = (Calibration.from_json({**PINHOLE, "pixel_centre": name}) for name in ("half", "integer"))
    assert ours.camera.params == (500, 510.5, 371.2, 240)
    assert opencv.camera.params == (500, 510.5, 371.7, 240.5)
    assert ours.use == "fixed"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"version": 2}, "`version` is 2"),
        ({"model": "fisheye"}, "`model` is 'fisheye'"),
        ({"fx": "500"}, "`fx` must be a number"),
        ({"fx": -1}, "positive focal length"),
        ({"fx": float("nan")}, "`fx` must be a number"),
        ({"width": 640.5}, "`width` must be a whole number"),
        ({"width": 0}, "is none"),
        ({"fx": 10**400}, "`fx` must be a number"),
        ({"width": float("inf")}, "`width` must be a whole number"),
        ({"fx": 0.78, "fy": 0.8}, "are the focal lengths in pixels"),
        ({"cx": 700}, "principal point lies outside"),
        ({"alpha": 0.5}, "`alpha` belongs to the model mei"),
        ({"distortion": [0.1, 0, 0, 0]}, "has no `distortion`"),
        ({"model": "opencv", "distortion": [0.1]}, "0, 4, 5, 8 numbers, got 1"),
        ({"model": "opencv_fisheye"}, "has 4 numbers, got 0"),
        ({"model": "opencv", "distortion": [-0.9, 0, 0, 0]}, "turns round inside of the picture"),
        ({"model": "opencv_fisheye", "distortion": [-2, 0, 0, 0]}, "turns round inside of the picture"),
        ({"pixel_centre": "corner"}, "`pixel_centre` is half or integer"),
        ({"use": "maybe"}, "`use` is fixed or initial"),
        ({"focal": 3}, "unknown keys focal"),
    ],
)
def test_what_is_wrong_is_said(change: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words) as caught:
        Calibration.from_json({**PINHOLE, **change}, "camera.json")
    assert str(caught.value).startswith("camera.json: ")


def write(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


def test_files_of_others(tmp_path: Path) -> None:
    wanted = Camera("opencv", (500.0, 501.0, 320.5, 240.5, -0.1, 0.02, 0.001, -0.001, 0.0, 0, 0, 0), 640, 480)
    text = write(
        tmp_path / "cameras.txt",
        "# Camera list\n1 OPENCV 640 480 500 501 320.5 240.5 -0.1 0.02 0.001 -0.001\n",
    )
    assert read_calibration(text) == Calibration(wanted)
    assert read_calibration(text, "initial").use == "initial"
    storage = cv2.FileStorage(str(tmp_path / "lens.yml"), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.write("camera_matrix", np.array([[500.0, 0, 320], [0, 501, 240], [0, 0, 1]]))
    storage.write("distortion_coefficients", np.array([[-0.1, 0.02, 0.001, -0.001, 0.0]]))
    storage.release()
    assert read_calibration(tmp_path / "lens.yml") == Calibration(wanted)
    nerf: dict[str, Any] = {
        "fl_x": 500,
        "fl_y": 501,
        "cx": 320.5,
        "cy": 240.5,
        "w": 640,
        "h": 480,
        "k1": -0.1,
        "k2": 0.02,
    }
    nerf |= {"p1": 0.001, "p2": -0.001, "camera_model": "OPENCV", "frames": []}
    assert read_calibration(write(tmp_path / "transforms.json", json.dumps(nerf))) == Calibration(wanted)
    ours = write(tmp_path / "camera.json", json.dumps(Calibration(wanted, "initial").to_json()))
    assert read_calibration(ours) == Calibration(wanted, "initial")
    assert read_calibration(ours, "fixed").use == "fixed"


@pytest.mark.parametrize(
    ("line", "model", "params"),
    [
        ("7 SIMPLE_PINHOLE 640 480 500 320 240", "pinhole", (500, 500, 320, 240)),
        ("1 SIMPLE_RADIAL 640 480 500 320 240 0.05", "opencv", (500, 500, 320, 240, 0.05, 0, 0, 0, 0, 0, 0, 0)),
        ("1 OPENCV_FISHEYE 640 480 300 301 320 240 0.1 0 0 0", "opencv_fisheye", (300, 301, 320, 240, 0.1, 0, 0, 0)),
        ("1 EUCM 640 480 300 300 320 240 0.375 1", "mei", (480, 480, 320, 240, 0.6)),
    ],
)
def test_models_of_colmap(tmp_path: Path, line: str, model: str, params: tuple[float, ...]) -> None:
    camera = read_calibration(write(tmp_path / "cameras.txt", line + "\n")).camera
    assert camera.model == model
    np.testing.assert_allclose(camera.params, params)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "not a calibration"),
        ("hello\n", "not a calibration"),
        ("{", "not readable JSON"),
        ("{}", "`version` is None"),
        ("%YAML:1.0\n---\na: [", "OpenCV"),
        ("%YAML:1.0\n---\na: 1\n", "`camera_matrix`"),
        ("1 PINHOLE 640 480 500 500 320 240\n2 PINHOLE 640 480 500 500 320 240\n", "2 cameras"),
        ("1 THIN_PRISM_FISHEYE 640 480 1 2 3 4\n", "THIN_PRISM_FISHEYE is not understood"),
        ("1 PINHOLE 640 480 500\n", "takes 4 parameters, got 1"),
        ("1 PINHOLE 640 480 five 500 320 240\n", "the line of a camera reads"),
        ('{"a":' * 100_000, "not readable JSON"),
        ('{"fl_x": 500, "cx": 320, "cy": 240, "w": NaN, "h": 480}', "`w` must be a whole number"),
        ("%YAML:1.0\n---\nimage_width: .Nan\nimage_height: 48\n" + _MATRIX, "`image_width` must be a whole number"),
        ("%YAML:1.0\n---\nimage_width: 64\nimage_height: 48\n" + _MATRIX.replace("50.", ".Nan"), "must be finite"),
        ('{"frames": []}', "fl_x, cx, cy, w, h must stand beside the frames"),
    ],
)
def test_one_clear_error_for_the_unreadable(tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words) as caught:
        read_calibration(write(tmp_path / "lens.txt", text))
    assert str(caught.value).startswith("lens.txt: ")


def test_missing_and_binary_files_are_typed_errors_too(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"gone\.json: No such file"):
        read_calibration(tmp_path / "gone.json")
    (tmp_path / "cameras.bin").write_bytes(b"\x01\x00\xff\xfe\x00")
    with pytest.raises(ConfigError, match=r"cameras\.bin: not text"):
        read_calibration(tmp_path / "cameras.bin")


def test_a_size_of_the_same_aspect_scales_and_another_is_refused() -> None:
    known = Calibration.from_json(PINHOLE)
    assert known.for_size(640, 480, "clip") is known
    assert known.for_size(320, 240, "clip").camera.params == (250, 255.25, 185.6, 120)
    assert known.for_size(427, 320, "clip").camera.width == 427
    with pytest.raises(CalibrationMismatch, match="clip: pictures of 640x360"):
        known.for_size(640, 360, "clip")
