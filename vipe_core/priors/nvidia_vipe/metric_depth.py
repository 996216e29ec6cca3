"""Metric depth, paper section 3.2.3: Metric3Dv2 (Hu et al., 2024), UniDepthV2, UniK3D (Piccinelli et al., 2025)."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from vipe_core.annotation import DepthKind
from vipe_core.cameras import Camera
from vipe_core.errors import ConfigError
from vipe_core.priors.hf.images import normalised, resized
from vipe_core.priors.nvidia_vipe.loading import filled, from_folder, part, picture, require_cuda, tensors
from vipe_core.priors.protocols import MetricEstimate

# Published relative errors on scenes that were not trained on are some 5 to 15 %, most of them of the scale.
_SIGMA = 0.1
# What is farther is sky, or might as well be.
_FARTHEST_M = 1000.0
# Metric3D: size of its pictures, and the focal length that it sees all of them with.
_SIZE, _CANONICAL_FOCAL_PX = (1064, 616), 1000.0
# UniDepth and UniK3D choose a size between bounds; pictures beyond this are only shrunk.
_LONGEST = 1280
# Of UniK3D, 0 to 9: the reference takes the finest.
_RESOLUTION_LEVEL = 9

Metric3dSize = Literal["small", "large", "giant2"]


class Metric3d:
    """`MetricDepth` by Metric3Dv2, for pinhole cameras. It scales with the focal length exactly.

    Args:
        model: The package's network.
        size: (width, height) of its pictures.
    """

    def __init__(self, model: Any, device: torch.device, size: tuple[int, int] = _SIZE) -> None:
        self._model = model
        self._device = device
        self._size = size

    @classmethod
    def load(cls, path: Path, which: Metric3dSize, device: torch.device) -> Metric3d:
        """The network in a file.

        Raises:
            ConfigError: The device is not CUDA, which its decoder names itself.
            LibraryMissing, WeightsMissing, WeightsInvalid: See `loading`.
        """
        require_cuda("Metric3D", device)
        (build,) = part("depth.metric3d.model_fn", f"metric3d_vit_{which}")
        return cls(filled(build(pretrain=False), tensors(path, "model_state_dict"), path.name, device), device)

    @property
    def depth_kind(self) -> DepthKind:
        return "z"

    @property
    def shared_sigma_ratio(self) -> float:
        return _SIGMA

    def input_size(self, width: int, height: int) -> tuple[int, int]:
        """As large as fits into its pictures; never enlarged."""
        scale = min(1.0, self._size[0] / width, self._size[1] / height)
        return max(1, int(width * scale)), max(1, int(height * scale))

    def estimate(self, rgb: NDArray[np.uint8], camera: Camera) -> MetricEstimate:
        """See `MetricDepth.estimate`."""
        _require_pinhole(camera)
        height, width = rgb.shape[:2]
        scale = min(self._size[0] / width, self._size[1] / height)
        across, down = max(1, int(width * scale)), max(1, int(height * scale))
        left, top = (self._size[0] - across) // 2, (self._size[1] - down) // 2
        padding = (left, self._size[0] - across - left, top, self._size[1] - down - top)
        padded = torch.nn.functional.pad(normalised(rgb, (across, down), self._device), padding)
        with torch.inference_mode():
            found = self._model.inference({"input": padded})[0][0, 0, top : top + down, left : left + across]
        return _estimate(resized(found, height, width) * (camera.focal_px * scale / _CANONICAL_FOCAL_PX))


class UniDepth:
    """`MetricDepth` by UniDepthV2, for pinhole cameras.

    Args:
        model: The package's `UniDepthV2`.
        pinhole: Its `Pinhole`.
    """

    def __init__(self, model: Any, pinhole: Any, device: torch.device) -> None:
        self._model = model
        self._pinhole = pinhole
        self._device = device

    @classmethod
    def load(cls, folder: Path, device: torch.device) -> UniDepth:
        """The network in a folder.

        Raises:
            LibraryMissing, WeightsMissing, WeightsInvalid: See `loading`.
        """
        kind, pinhole = part("depth.unidepth.models.unidepthv2.unidepthv2", "UniDepthV2", "Pinhole")
        return cls(from_folder(kind, folder, device), pinhole, device)

    @property
    def depth_kind(self) -> DepthKind:
        return "z"

    @property
    def shared_sigma_ratio(self) -> float:
        return _SIGMA

    def input_size(self, width: int, height: int) -> tuple[int, int]:
        """See `MetricDepth.input_size`."""
        return _bounded(width, height)

    def estimate(self, rgb: NDArray[np.uint8], camera: Camera) -> MetricEstimate:
        """See `MetricDepth.estimate`."""
        _require_pinhole(camera)
        fx, fy, cx, cy = camera.params
        matrix = torch.tensor([[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]], dtype=torch.float32, device=self._device)
        with torch.inference_mode():
            found = self._model.infer(picture(rgb, self._device)[None], self._pinhole(K=matrix))["depth"]
        return _estimate(found[0, 0].float().cpu().numpy())


class UniK3d:
    """`MetricDepth` by UniK3D, for every camera: it is told the ray of each pixel, and answers with distance.

    Args:
        model: The package's `UniK3D`.
    """

    def __init__(self, model: Any, device: torch.device) -> None:
        self._model = model
        self._device = device

    @classmethod
    def load(cls, folder: Path, device: torch.device) -> UniK3d:
        """The network in a folder.

        Raises:
            LibraryMissing, WeightsMissing, WeightsInvalid: See `loading`.
        """
        (kind,) = part("depth.unik3d.unik3d", "UniK3D")
        model = from_folder(kind, folder, device)
        model.resolution_level = _RESOLUTION_LEVEL
        return cls(model, device)

    @property
    def depth_kind(self) -> DepthKind:
        return "ray"

    @property
    def shared_sigma_ratio(self) -> float:
        return _SIGMA

    def input_size(self, width: int, height: int) -> tuple[int, int]:
        """See `MetricDepth.input_size`."""
        return _bounded(width, height)

    def estimate(self, rgb: NDArray[np.uint8], camera: Camera) -> MetricEstimate:
        """See `MetricDepth.estimate`."""
        rays = camera.rays()
        unit = rays / np.maximum(np.linalg.norm(rays, axis=-1, keepdims=True), 1e-9)
        directions = torch.from_numpy(np.nan_to_num(unit).astype(np.float32)).to(self._device).permute(2, 0, 1)
        with torch.inference_mode():
            found = self._model.infer(picture(rgb, self._device)[None], rays=directions[None])["distance"]
        return _estimate(found[0, 0].float().cpu().numpy())


def _bounded(width: int, height: int) -> tuple[int, int]:
    scale = min(1.0, _LONGEST / max(width, height))
    return max(1, round(width * scale)), max(1, round(height * scale))


def _estimate(depth_m: NDArray[Any]) -> MetricEstimate:
    known = np.isfinite(depth_m) & (depth_m > 0) & (depth_m < _FARTHEST_M)
    return MetricEstimate(np.where(known, depth_m, 0).astype(np.float32), known.astype(np.float32))


def _require_pinhole(camera: Camera) -> None:
    if camera.model != "pinhole":
        raise ConfigError(f"the network knows pinhole cameras, not {camera.model}")
