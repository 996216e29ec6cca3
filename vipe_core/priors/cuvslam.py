"""Points followed by PyCuVSLAM, the tracks of the paper (section 3.2.2).

Its odometry of one camera runs for its tracks alone. Its licence and its code ask for an NVIDIA GPU. The package is
in no index.
"""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
import torch

from vipe_core.cameras import Camera
from vipe_core.errors import ConfigError, LibraryMissing
from vipe_core.priors.points import bounded_size, visible
from vipe_core.priors.protocols import TrackedPoints
from vipe_core.video.source import Frame

INSTALL = (
    "take the wheel for this Python and this CUDA from github.com/nvidia-isaac/cuVSLAM/releases (Python 3.10, or 3.12"
    " and later) and install it with pip"
)

# Frames of slow videos are far apart in time; that is no reason to give up.
_MAX_STEP_S = 3600.0


class CuvslamFollower:
    """`PointFollower` of PyCuVSLAM.

    Args:
        library: The package `cuvslam`.
    """

    def __init__(self, library: Any, device: torch.device) -> None:
        self._library = library
        # Up to version 17, odometry is in the module of the bindings.
        self._odometry = getattr(library, "Odometry", None) or library.core.Odometry
        self._device = device

    @classmethod
    def load(cls, device: torch.device) -> CuvslamFollower:
        """The package as it is installed.

        Raises:
            ConfigError: The device is no CUDA device.
            LibraryMissing: The package is not installed, or cannot be loaded.
        """
        if device.type != "cuda":
            raise ConfigError(f"cuVSLAM runs on CUDA only, not on {device}; choose --device cuda, or other tracks")
        try:
            library = importlib.import_module("cuvslam")
        except Exception as error:  # Libraries of CUDA that it needs may be missing in every way there is.
            first_line = (str(error) or type(error).__name__).splitlines()[0][:200]
            raise LibraryMissing(f"cuvslam cannot be used ({first_line}); {INSTALL}") from error
        return cls(library, device)

    def input_size(self, width: int, height: int) -> tuple[int, int]:
        return bounded_size(width, height)

    def follow(self, frames: Iterable[Frame], camera: Camera) -> Iterator[TrackedPoints]:
        """See `PointFollower`. A bent lens is given as the pinhole of its focal length: only its tracks are used."""
        odometry = self._odometry(self._rig(camera), self._config())
        last: TrackedPoints | None = None
        for frame in frames:
            masks = None if frame.masked is None else [np.where(frame.masked, 255, 0).astype(np.uint8)]
            with self._on_device():
                odometry.track(round(frame.timestamp_s * 1e9), [np.ascontiguousarray(frame.rgb)], masks)
                observed = odometry.get_last_observations(0)
            points = TrackedPoints(
                np.array([one.id for one in observed], np.int64),
                np.array([(one.u, one.v) for one in observed], np.float32).reshape(-1, 2),
            )
            # Where it is lost, what it saw before is still there.
            stale = last is not None and np.array_equal(points.ids, last.ids) and np.array_equal(points.px, last.px)
            last = points
            seen = visible(points.px, frame.rgb.shape[:2], frame.masked) & (not stale)
            yield TrackedPoints(points.ids[seen], points.px[seen])

    def _rig(self, camera: Camera) -> Any:
        fx, fy, cx, cy = camera.index_params()[:4]
        eye = self._library.Camera(
            size=[camera.width, camera.height], principal=[float(cx), float(cy)], focal=[float(fx), float(fy)]
        )
        return self._library.Rig([eye])

    def _config(self) -> Any:
        # Adjusted in the same thread, so that the same video gives the same tracks.
        return self._odometry.Config(
            odometry_mode=self._odometry.OdometryMode.Mono,
            async_sba=False,
            enable_observations_export=True,
            enable_landmarks_export=False,
            max_frame_delta_s=_MAX_STEP_S,
        )

    def _on_device(self) -> contextlib.AbstractContextManager[Any]:
        return torch.cuda.device(self._device) if self._device.type == "cuda" else contextlib.nullcontext()
