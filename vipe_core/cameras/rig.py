"""A rig that the user knows: several cameras on one body, and the JSON of it.

    {"version": 1, "metric": true, "extrinsics": "fixed", "intrinsics": "per_view", "views": [
        {"name": "left", "video": "left.mp4", "rig_from_cam": [[1, 0, 0, 0], ..., [0, 0, 0, 1]],
         "camera": {"version": 1, "model": "pinhole", "width": 1280, "height": 720, ...}},
        {"name": "right", "rig_from_cam": ...}]}

`rig_from_cam` is 4x4, row by row, OpenCV axes. `extrinsics` is `fixed`, the default, or `refined`: all but the first
view's are adjusted, around what is given; `sigma` of a view, `{"rotation_deg": 2, "place": 0.01}`, says how far off
that may be. `camera` is a calibration (`calibration.py`); a view without one is
estimated. `intrinsics` is `per_view`, the default, or `shared`: all views have one camera, which is estimated or
adjusted as one. `metric` says that lengths are metres. `video` names a file beside the rig file.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vipe_core.cameras.calibration import Calibration, number_of
from vipe_core.errors import ConfigError

VERSION = 1
_KEYS = {"version", "metric", "extrinsics", "intrinsics", "views"}
_VIEW_KEYS = {"name", "video", "rig_from_cam", "sigma", "camera"}
_MAX_VIEWS = 64
_MAX_BYTES = 1 << 20
# No body that carries cameras is larger than this; millimetres that are taken for metres are.
_MAX_EXTENT_M = 100.0
# Numbers that were written with few digits make a rotation that is one to about this.
_RIGID = 1e-3


@dataclass(frozen=True, slots=True)
class ExtrinsicSigma:
    """How sure the pose of a camera in its rig is, 1-sigma in the worst direction.

    Attributes:
        rotation_deg: Of its rotation.
        place: Of its place, in the units of the rig.
    """

    rotation_deg: float
    place: float


@dataclass(frozen=True, slots=True)
class RigView:
    """One camera of a rig.

    Attributes:
        name: Different for each.
        rig_from_cam: (4, 4) float64.
        calibration: Where the camera is known.
        video: File that it recorded, relative to the rig file; None where it is given otherwise.
        sigma: How sure `rig_from_cam` is. Where extrinsics are refined it says how far they may move, None what is
            usual; what comes out of refining says how well they were found.

    Raises:
        ConfigError: `rig_from_cam` is not a rotation and a translation.
    """

    name: str
    rig_from_cam: NDArray[np.float64]
    calibration: Calibration | None = None
    video: str | None = None
    sigma: ExtrinsicSigma | None = None

    def __post_init__(self) -> None:
        _rigid(self.rig_from_cam, f"view {self.name}")


@dataclass(frozen=True, slots=True)
class Rig:
    """Cameras that move as one.

    Attributes:
        views: At least two. The first holds the gauge where extrinsics are refined.
        metric: Lengths are metres; else the rig's size is known up to a factor.
        refine: Adjust the extrinsics.
        shared: All views have one camera.

    Raises:
        ConfigError: Names or videos repeat, there is only one view, cameras that are said to be one differ, or the
            rig is larger than any body.
    """

    views: tuple[RigView, ...]
    metric: bool = False
    refine: bool = False
    shared: bool = False

    def __post_init__(self) -> None:
        if not 2 <= len(self.views) <= _MAX_VIEWS:
            raise ConfigError(f"a rig has 2 to {_MAX_VIEWS} views, got {len(self.views)}")
        names = [view.name for view in self.views]
        if len(set(names)) < len(names):
            raise ConfigError(f"views of a rig need different names, got {', '.join(names)}")
        videos = [view.video for view in self.views if view.video is not None]
        if len(set(videos)) < len(videos):
            raise ConfigError(f"every view of a rig has a video of its own, got {', '.join(videos)}")
        if self.metric and self.extent > _MAX_EXTENT_M:
            raise ConfigError(
                f"the cameras of the rig are up to {self.extent:g} m apart; give `rig_from_cam` in metres, or leave "
                "`metric` out"
            )
        known = [view.calibration for view in self.views if view.calibration is not None]
        if self.shared and any(one != known[0] for one in known):
            raise ConfigError("the views of the rig are said to share one camera, but their calibrations differ")

    @property
    def cam_from_rig(self) -> NDArray[np.float64]:
        """(V, 4, 4)."""
        return np.stack([np.linalg.inv(view.rig_from_cam) for view in self.views])

    @property
    def extent(self) -> float:
        """Largest distance between two cameras."""
        centres = np.stack([view.rig_from_cam[:3, 3] for view in self.views])
        return float(np.linalg.norm(centres[:, None] - centres[None], axis=-1).max())

    def with_views(self, views: Sequence[RigView]) -> Rig:
        return replace(self, views=tuple(views))

    @classmethod
    def from_json(cls, data: Mapping[str, Any], name: str = "rig") -> Rig:
        """From our JSON object; see the module.

        Args:
            name: For messages.

        Raises:
            ConfigError: It is not such an object; the message says what is wrong.
        """
        _known_keys(data, _KEYS, name)
        if data.get("version") != VERSION:
            raise ConfigError(f"{name}: `version` is {data.get('version')!r}, {VERSION} is understood")
        metric = data.get("metric", False)
        if not isinstance(metric, bool):
            raise ConfigError(f"{name}: `metric` is true or false, not {metric!r}")
        refine = _choice(data, "extrinsics", ("fixed", "refined"), name) == "refined"
        shared = _choice(data, "intrinsics", ("per_view", "shared"), name) == "shared"
        views = data.get("views")
        if not isinstance(views, list):
            raise ConfigError(f"{name}: `views` must be a list")
        return cls(
            tuple(_view(view, f"{name}: view {number}") for number, view in enumerate(views)), metric, refine, shared
        )

    def to_json(self) -> dict[str, Any]:
        """Our JSON object; `from_json` gives the same rig back."""
        views = []
        for view in self.views:
            row: dict[str, Any] = {"name": view.name}
            if view.video is not None:
                row["video"] = view.video
            row["rig_from_cam"] = view.rig_from_cam.tolist()
            if view.sigma is not None:
                row["sigma"] = {"rotation_deg": view.sigma.rotation_deg, "place": view.sigma.place}
            if view.calibration is not None:
                row["camera"] = view.calibration.to_json()
            views.append(row)
        return {
            "version": VERSION,
            "metric": self.metric,
            "extrinsics": "refined" if self.refine else "fixed",
            "intrinsics": "shared" if self.shared else "per_view",
            "views": views,
        }


def read_rig(path: str | Path, name: str | None = None) -> Rig:
    """The rig of a file.

    Args:
        name: For messages; that of the file if None.

    Raises:
        ConfigError: There is no such file, or it does not hold a rig.
    """
    path = Path(path)
    name = name or path.name
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise ConfigError(f"{name}: a rig file of more than {_MAX_BYTES} bytes is none")
        data = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{name}: the rig file cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise ConfigError(f"{name}: the rig file is not JSON") from error
    if not isinstance(data, dict):
        raise ConfigError(f"{name}: the rig file must hold a JSON object")
    return Rig.from_json(data, name)


def _view(data: Any, name: str) -> RigView:
    if not isinstance(data, dict):
        raise ConfigError(f"{name}: must be an object")
    _known_keys(data, _VIEW_KEYS, name)
    title, video, camera = data.get("name"), data.get("video"), data.get("camera")
    if not isinstance(title, str) or not title or title != Path(title).name or title.startswith("."):
        raise ConfigError(f"{name}: `name` must be a plain name, got {title!r}")
    if video is not None and not isinstance(video, str):
        raise ConfigError(f"{name}: `video` must be the name of a file, got {video!r}")
    if camera is not None and not isinstance(camera, dict):
        raise ConfigError(f"{name}: `camera` must be a calibration, got {camera!r}")
    calibration = None if camera is None else Calibration.from_json(camera, f"{name}: camera")
    return RigView(title, _rigid(data.get("rig_from_cam"), name), calibration, video, _sigma(data.get("sigma"), name))


def _sigma(value: Any, name: str) -> ExtrinsicSigma | None:
    if value is None:
        return None
    if not isinstance(value, dict):
        raise ConfigError(f"{name}: `sigma` must be an object with `rotation_deg` and `place`, got {value!r}")
    _known_keys(value, {"rotation_deg", "place"}, f"{name}: sigma")
    rotation_deg, place = (number_of(value, key, f"{name}: sigma") for key in ("rotation_deg", "place"))
    if rotation_deg <= 0 or place < 0:
        raise ConfigError(f"{name}: `sigma` must be positive, got {rotation_deg:g} degrees and {place:g}")
    return ExtrinsicSigma(rotation_deg, place)


def _rigid(value: Any, name: str) -> NDArray[np.float64]:
    """A rigid transform, with the rotation nearest to the numbers."""
    try:
        matrix = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{name}: `rig_from_cam` must be 4x4 numbers") from error
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise ConfigError(f"{name}: `rig_from_cam` must be 4x4 finite numbers")
    u, _, vh = np.linalg.svd(matrix[:3, :3])
    rotation = u @ vh
    rigid = np.linalg.det(rotation) > 0 and np.abs(rotation - matrix[:3, :3]).max() <= _RIGID
    if not rigid or not np.allclose(matrix[3], (0, 0, 0, 1), atol=_RIGID):
        raise ConfigError(f"{name}: `rig_from_cam` is not a rotation and a translation")
    exact = np.eye(4)
    # A rotation that is one already keeps its digits.
    exact[:3, :3] = matrix[:3, :3] if np.abs(rotation - matrix[:3, :3]).max() < 1e-12 else rotation
    exact[:3, 3] = matrix[:3, 3]
    return exact


def _known_keys(data: Mapping[str, Any], known: set[str], name: str) -> None:
    unknown = sorted(set(data) - known)
    if unknown:
        raise ConfigError(f"{name}: unknown keys {', '.join(unknown)}; known: {', '.join(sorted(known))}")


def _choice(data: Mapping[str, Any], key: str, allowed: tuple[str, str], name: str) -> str:
    value = data.get(key, allowed[0])
    if value not in allowed:
        raise ConfigError(f"{name}: `{key}` is {' or '.join(allowed)}, not {value!r}")
    return str(value)


def angle_between_deg(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
    """Angle of the rotation between two transforms."""
    trace = float(np.trace(first[:3, :3].T @ second[:3, :3]))
    return math.degrees(math.acos(min(1.0, max(-1.0, (trace - 1) / 2))))
