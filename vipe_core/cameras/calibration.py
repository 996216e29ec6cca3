"""A camera that the user knows, and our JSON of it (`docs/cameras.md`); `calibration_files` reads those of others.

    {"version": 1, "model": "opencv", "width": 1920, "height": 1080, "fx": 1402.1, "fy": 1401.7, "cx": 968.2,
     "cy": 532.9, "distortion": [-0.31, 0.11, 0.0002, -0.0001, -0.02], "pixel_centre": "integer", "use": "fixed"}

`model` is `pinhole`, `mei` (with `alpha`), `opencv` (`distortion` k1, k2, p1, p2[, k3[, k4, k5, k6]]) or
`opencv_fisheye` (k1, k2, k3, k4). `pixel_centre` says where the first pixel's middle is: `half`, the default, at
(0.5, 0.5) as in COLMAP and everything that we write, or `integer` at (0, 0) as in OpenCV. `use` is `fixed`, the
default, or `initial`.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeGuard

import numpy as np

from vipe_core.cameras import distortion
from vipe_core.cameras.camera import Camera, CameraModel
from vipe_core.errors import CalibrationMismatch, ConfigError

Use = Literal["fixed", "initial"]

VERSION = 1
_MODELS: tuple[CameraModel, ...] = ("pinhole", "mei", "opencv", "opencv_fisheye")
_KEYS = {"version", "model", "width", "height", "fx", "fy", "cx", "cy", "alpha", "distortion", "pixel_centre", "use"}
# Pictures of one aspect differ by the rounding of their sizes and no more.
_SAME_ASPECT = 0.005
_MAX_ALPHA = 4.0
_MAX_SIZE = 1 << 16
# Fields of view that no lens without a bend has: a focal length in millimetres, or in widths of the picture.
_WIDEST_PINHOLE_DEG = 170.0
# Half of the field of view of the narrowest lens whose image is a circle within the picture.
_NARROWEST_CIRCLE_DEG = 60.0


@dataclass(frozen=True, slots=True)
class Calibration:
    """A known camera.

    Attributes:
        camera: `pinhole`, `mei`, `opencv` or `opencv_fisheye`, for pictures of its own size.
        use: `fixed`: held from the first frame to the exports. `initial`: a starting point with a narrow prior.

    Raises:
        ConfigError: A camera of another model, or another use.
    """

    camera: Camera
    use: Use = "fixed"

    def __post_init__(self) -> None:
        if self.camera.model not in _MODELS:
            raise ConfigError(f"a calibration is of one of {', '.join(_MODELS)}, not of {self.camera.model!r}")
        if self.use not in ("fixed", "initial"):
            raise ConfigError(f"a calibration's use is fixed or initial, not {self.use!r}")

    @classmethod
    def from_json(cls, data: Mapping[str, Any], name: str = "calibration") -> Calibration:
        """From our JSON object; see the module.

        Args:
            name: For messages.

        Raises:
            ConfigError: It is not such an object; the message says what is wrong.
        """
        unknown = sorted(set(data) - _KEYS)
        if unknown:
            raise ConfigError(f"{name}: unknown keys {', '.join(unknown)}; known: {', '.join(sorted(_KEYS))}")
        if data.get("version") != VERSION:
            raise ConfigError(f"{name}: `version` is {data.get('version')!r}, {VERSION} is understood")
        model = data.get("model")
        if model not in _MODELS:
            raise ConfigError(f"{name}: `model` is {model!r}; known: {', '.join(_MODELS)}")
        numbers = [number_of(data, key, name) for key in ("fx", "fy", "cx", "cy")]
        centre = data.get("pixel_centre", "half")
        if centre not in ("half", "integer"):
            raise ConfigError(f"{name}: `pixel_centre` is half or integer, not {centre!r}")
        shift = 0.5 if centre == "integer" else 0.0
        numbers[2:4] = numbers[2] + shift, numbers[3] + shift
        if (model == "mei") != ("alpha" in data):
            raise ConfigError(f"{name}: `alpha` belongs to the model mei, and to no other")
        alpha = [number_of(data, "alpha", name)] if model == "mei" else []
        if "distortion" in data and model in ("pinhole", "mei"):
            raise ConfigError(f"{name}: the model {model} has no `distortion`; use opencv or opencv_fisheye")
        coefficients = coefficients_of(model, data.get("distortion", ()), name)
        size = [size_of(data, key, name) for key in ("width", "height")]
        camera = checked_camera(model, (*numbers, *alpha, *coefficients), size, name)
        return cls(camera, _use(data.get("use", "fixed"), name))

    def to_json(self) -> dict[str, Any]:
        """Our JSON object, half-pixel centres: `from_json` gives the same camera back, to the last bit."""
        camera = self.camera
        data: dict[str, Any] = {"version": VERSION, "model": camera.model, "width": camera.width}
        data |= {"height": camera.height, **dict(zip(("fx", "fy", "cx", "cy"), camera.params, strict=False))}
        if camera.model == "mei":
            data["alpha"] = camera.params[4]
        elif camera.distorted:
            data["distortion"] = list(camera.params[4:])
        return data | {"use": self.use}

    def for_size(self, width: int, height: int, name: str) -> Calibration:
        """The same lens for pictures of another size of the same aspect.

        Args:
            name: Of the video, for the message.

        Raises:
            CalibrationMismatch: The aspect is another one: the pictures are cropped, and nobody says where.
        """
        camera = self.camera
        if (camera.width, camera.height) == (width, height):
            return self
        ratio = (width / camera.width) / (height / camera.height)
        # A size is a whole number of pixels, which small pictures feel.
        slack = _SAME_ASPECT + 1 / min(width, height, camera.width, camera.height)
        if abs(math.log(ratio)) > slack:
            raise CalibrationMismatch(
                f"{name}: pictures of {width}x{height} are not of the aspect that the calibration is for, "
                f"{camera.width}x{camera.height}; calibrate at the video's own size"
            )
        return replace(self, camera=camera.resized(width, height))


def coefficients_of(model: CameraModel, values: Any, name: str) -> tuple[float, ...]:
    """As `Camera.params` has them."""
    if not isinstance(values, (list, tuple)) or not all(is_number(value) for value in values):
        raise ConfigError(f"{name}: `distortion` must be a list of numbers")
    allowed = {"opencv": (0, 4, 5, 8), "opencv_fisheye": (4,)}.get(model, (0,))
    # OpenCV itself writes twelve or fourteen: the last are of a thin prism and a tilt, which few lenses have.
    if len(values) > 8 and not any(values[8:]) and model == "opencv":
        values = values[:8]
    if len(values) not in allowed:
        wanted = ", ".join(map(str, allowed))
        raise ConfigError(f"{name}: `distortion` of {model} has {wanted} numbers, got {len(values)}")
    whole = {"opencv": 8, "opencv_fisheye": 4}.get(model, 0)
    return (*(float(value) for value in values), *([0.0] * (whole - len(values))))


def checked_camera(model: CameraModel, params: Sequence[float], size: Sequence[int], name: str) -> Camera:
    """Checked more than `Camera` does: a slip in a file must not pass for a lens."""
    width, height = size
    if not (0 < width <= _MAX_SIZE and 0 < height <= _MAX_SIZE):
        raise ConfigError(f"{name}: a picture of {width}x{height} pixels is none")
    try:
        camera = Camera(model, tuple(float(value) for value in params), int(width), int(height))
    except ConfigError as error:
        raise ConfigError(f"{name}: {error}") from error
    if not (0 < camera.params[2] < width and 0 < camera.params[3] < height):
        raise ConfigError(f"{name}: the principal point lies outside of the picture of {width}x{height} pixels")
    if model == "mei" and not 0 <= camera.params[4] <= _MAX_ALPHA:
        raise ConfigError(f"{name}: alpha must be in 0..{_MAX_ALPHA:g}, got {camera.params[4]:g}")
    corners = [(-0.5, -0.5), (width - 0.5, -0.5), (-0.5, height - 0.5), (width - 0.5, height - 0.5)]
    if camera.distorted and not camera.has_ray([((width - 1) / 2, (height - 1) / 2)]).all():
        raise ConfigError(f"{name}: the distortion leaves the middle of the picture without a ray")
    if camera.distorted and not camera.has_ray(corners).any() and _ends_early(camera):
        raise ConfigError(f"{name}: the distortion turns round inside of the picture; are its coefficients in order?")
    if model in ("pinhole", "opencv") and max(camera.fov_x_deg, camera.fov_y_deg) > _WIDEST_PINHOLE_DEG:
        raise ConfigError(
            f"{name}: a lens of this kind does not see {max(camera.fov_x_deg, camera.fov_y_deg):.0f} degrees; "
            "are the focal lengths in pixels?"
        )
    return camera


def _ends_early(lens: Camera) -> bool:
    """Whether the image ends where that of no such lens does. The circle of a fisheye may lie within the picture."""
    limit = distortion.limit(lens.model, np.array(lens.params[4:]))
    return lens.model == "opencv" or limit < math.radians(_NARROWEST_CIRCLE_DEG)


def _use(value: Any, name: str) -> Use:
    if value not in ("fixed", "initial"):
        raise ConfigError(f"{name}: `use` is fixed or initial, not {value!r}")
    return "initial" if value == "initial" else "fixed"


def is_number(value: Any) -> TypeGuard[float]:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return False
    return abs(value) <= sys.float_info.max  # JSON has whole numbers that no float holds


def number_of(data: Mapping[str, Any], key: str, name: str) -> float:
    if not is_number(data.get(key)):
        raise ConfigError(f"{name}: `{key}` must be a number, got {data.get(key)!r}")
    return float(data[key])


def size_of(data: Mapping[str, Any], key: str, name: str) -> int:
    """A number of pixels, which some write with a decimal point."""
    value = data.get(key)
    if not is_number(value) or not float(value).is_integer():
        raise ConfigError(f"{name}: `{key}` must be a whole number of pixels, got {value!r}")
    return int(value)
