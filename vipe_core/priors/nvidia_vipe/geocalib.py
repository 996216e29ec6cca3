"""The initial camera by GeoCalib (Veicht et al., 2024), paper section 3.1: from four pictures with one focal length."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from vipe_core.ba.problem import Grid
from vipe_core.cameras import Camera
from vipe_core.priors.nvidia_vipe.loading import part, picture, tensors
from vipe_core.priors.protocols import IntrinsicsEstimate, WorkingFrame

_PICTURES = 4
# Published errors of the vertical field of view are some 3 to 5 degrees for half of the pictures. Pictures in which it
# sees little to go by are worse; it says how much, by the curvature of what it minimises.
_LOG_FOCAL_SIGMA = 0.1
_NARROWEST_RAD, _WIDEST_RAD = math.radians(6), math.radians(170)
_USUAL_RAD, _UNSURE_SIGMA = math.radians(45), 0.3


class GeoCalibInit:
    """`IntrinsicsInit` by GeoCalib.

    Args:
        model: The package's `GeoCalib`, with the weights for `camera`.
        camera: `pinhole`, or `mei` with the weights for bent lenses.
    """

    def __init__(self, model: Any, camera: str, device: torch.device) -> None:
        self._model = model
        self._camera = camera
        self._device = device

    @classmethod
    def load(cls, path: Path, camera: str, device: torch.device) -> GeoCalibInit:
        """The network in a file.

        Raises:
            LibraryMissing, WeightsMissing, WeightsInvalid: See `loading`.
        """
        (kind,) = part("geocalib.extractor", "GeoCalib")
        tensors(path, "model")
        # The package reads the file itself, by torch's own reader, which does not unpickle unless it is told to.
        return cls(kind(weights=str(path)).to(device), camera, device)

    def estimate(self, frames: Sequence[WorkingFrame], grid: Grid) -> IntrinsicsEstimate:
        """See `IntrinsicsInit.estimate`. A bent lens is estimated from one picture, as the network can.

        Where the network gives a field of view that no camera has, a usual one is the start.
        """
        wanted = _PICTURES if self._camera == "pinhole" else 1
        chosen = np.unique(np.linspace(0, len(frames) - 1, min(wanted, len(frames))).round().astype(int))
        pictures = torch.stack([picture(frames[index].rgb, self._device) for index in chosen]).float() / 255
        height, width = pictures.shape[-2:]
        if self._camera == "pinhole":
            answer = self._model.calibrate(pictures, shared_intrinsics=True)
        else:
            answer = self._model.calibrate(pictures, camera_model="simple_mei")
        found = answer["camera"]
        angle = float(found.vfov[0])
        sure = _NARROWEST_RAD < angle < _WIDEST_RAD
        angle = angle if sure else _USUAL_RAD
        focal_px = height / (2 * math.tan(angle / 2))
        shape = () if self._camera == "pinhole" else (float(found.dist[0, 0]),)
        model: Any = self._camera
        camera = Camera(model, (focal_px, focal_px, width / 2, height / 2, *shape), width, height)
        if not sure:
            return IntrinsicsEstimate(camera, _UNSURE_SIGMA, 0)
        return IntrinsicsEstimate(camera, _sigma(answer["focal_uncertainty"] / found.f[:, 1]), len(chosen))


def _sigma(own: Tensor) -> float:
    """Standard deviation of log f, from that published and those, as shares of the focal length, that the network gives
    for each picture: the pictures err together, so they count as one of their mean; never worse than a default."""
    mean = float(own.mean())
    return min(math.hypot(_LOG_FOCAL_SIGMA, mean), _UNSURE_SIGMA) if math.isfinite(mean) else _UNSURE_SIGMA
