"""Metric depth of single pictures by the networks that `transformers` has.

Depth Pro (Bochkovskii et al., 2024) finds inverse depth as a share of the focal length, and is told the true one here
instead of the one that it would guess. Depth Anything V2 (Yang et al., 2024) has been tuned to metres indoors and
outdoors, for cameras as they usually are. Neither says how sure it is.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from vipe_core.annotation import DepthKind
from vipe_core.cameras import Camera
from vipe_core.errors import ConfigError, WeightsInvalid
from vipe_core.priors.hf.images import fitted, normalised, resized
from vipe_core.priors.hf.loading import network, transformers
from vipe_core.priors.protocols import MetricEstimate

# Published relative errors of depth on scenes that were not trained on are some 10 to 20 %, most of them of the scale.
_SIGMA = 0.15
# What is farther is sky, or might as well be.
_FARTHEST_M = 1000.0
# Of a unit of width, as inverse depth: below, the network has said nothing.
_LEAST_INVERSE = 1e-4


class DepthPro:
    """`MetricDepth` by Depth Pro, for pinhole cameras.

    Args:
        model: `DepthProForDepthEstimation`.
        side: Of its square pictures.
    """

    def __init__(self, model: Any, device: torch.device, dtype: torch.dtype = torch.float32, side: int = 1536) -> None:
        self._model = model
        self._device = device
        self._dtype = dtype
        self._side = side

    @classmethod
    def load(cls, folder: Path, device: torch.device) -> DepthPro:
        """The network in a folder; in float16 on a GPU, as its authors run it.

        Raises:
            LibraryMissing, WeightsMissing, WeightsInvalid: See `loading`.
        """
        (kind,) = transformers("DepthProForDepthEstimation")
        dtype = torch.float16 if device.type == "cuda" else torch.float32
        return cls(network(kind, folder, device, dtype), device, dtype)

    @property
    def depth_kind(self) -> DepthKind:
        return "z"

    @property
    def shared_sigma_ratio(self) -> float:
        return _SIGMA

    def input_size(self, width: int, height: int) -> tuple[int, int]:
        """At most the network's; never enlarged."""
        scale = min(1.0, self._side / max(width, height))
        return max(1, round(width * scale)), max(1, round(height * scale))

    def estimate(self, rgb: NDArray[np.uint8], camera: Camera) -> MetricEstimate:
        """See `MetricDepth.estimate`."""
        _require_pinhole(camera)
        height, width = rgb.shape[:2]
        half = (0.5, 0.5, 0.5)
        picture = normalised(rgb, (self._side, self._side), self._device, half, half).to(self._dtype)
        with torch.inference_mode():
            canonical = self._model(pixel_values=picture).predicted_depth[0]
        inverse = resized(canonical, height, width)
        depth_m = camera.focal_px / width / np.maximum(inverse, _LEAST_INVERSE)
        return _estimate(np.where(inverse > _LEAST_INVERSE, depth_m, 0))


class DepthAnything:
    """`MetricDepth` by a Depth Anything V2 that was tuned to metres.

    Args:
        model: `DepthAnythingForDepthEstimation`.
        shortest: Shorter side of its pictures.

    Raises:
        WeightsInvalid: The network knows only relative depth.
    """

    def __init__(self, model: Any, device: torch.device, shortest: int = 518) -> None:
        if model.config.depth_estimation_type != "metric":
            raise WeightsInvalid("these weights of Depth Anything give relative depth; metric ones are needed")
        self._model = model
        self._device = device
        self._shortest = shortest
        self._patch = int(model.config.patch_size)

    @classmethod
    def load(cls, folder: Path, device: torch.device) -> DepthAnything:
        """The network in a folder.

        Raises:
            LibraryMissing, WeightsMissing, WeightsInvalid: See `loading`.
        """
        (kind,) = transformers("DepthAnythingForDepthEstimation")
        return cls(network(kind, folder, device, torch.float32), device)

    @property
    def depth_kind(self) -> DepthKind:
        return "z"

    @property
    def shared_sigma_ratio(self) -> float:
        # It does not know the focal length, which adds to the error.
        return 2 * _SIGMA

    def input_size(self, width: int, height: int) -> tuple[int, int]:
        """Whole patches of the network with the aspect of the video, up to a patch."""
        across, down = fitted(width, height, self._shortest, 3 * self._shortest)
        return max(1, round(across / self._patch)) * self._patch, max(1, round(down / self._patch)) * self._patch

    def estimate(self, rgb: NDArray[np.uint8], camera: Camera) -> MetricEstimate:
        """See `MetricDepth.estimate`."""
        _require_pinhole(camera)
        height, width = rgb.shape[:2]
        picture = normalised(rgb, self.input_size(width, height), self._device)
        with torch.inference_mode():
            found = self._model(pixel_values=picture).predicted_depth[0]
        return _estimate(resized(found, height, width))


def _estimate(depth_m: NDArray[Any]) -> MetricEstimate:
    known = np.isfinite(depth_m) & (depth_m > 0) & (depth_m < _FARTHEST_M)
    return MetricEstimate(np.where(known, depth_m, 0).astype(np.float32), known.astype(np.float32))


def _require_pinhole(camera: Camera) -> None:
    if camera.model != "pinhole":
        raise ConfigError(f"the network knows pinhole cameras, not {camera.model}")
