"""Completion of the projected map by PriorDA (Wang et al., 2025), paper section 3.3."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from vipe_core.cameras import Camera
from vipe_core.errors import WeightsInvalid
from vipe_core.priors.nvidia_vipe.loading import part, picture, require_cuda, tensors

FROZEN, CONDITIONED = "depth_anything_v2_vitb.pth", "prior_depth_anything_vitb.pth"
"""Names that the package looks for in a folder."""

_SEED = 17


class PriorDa:
    """`DepthCompletion` by PriorDA.

    Args:
        model: The package's `PriorDepthAnything`.
    """

    def __init__(self, model: Any, device: torch.device) -> None:
        self._model = model
        self._device = device

    @classmethod
    def load(cls, folder: Path, device: torch.device) -> PriorDa:
        """The network in a folder with the files `FROZEN` and `CONDITIONED`.

        Raises:
            ConfigError: The device is not CUDA, for which its search for neighbours is written.
            LibraryMissing, WeightsMissing, WeightsInvalid: See `loading`.
        """
        require_cuda("PriorDA", device)
        (kind,) = part("depth.priorda.priorda", "PriorDepthAnything")
        # The package reads the files itself, by torch's own reader, which does not unpickle unless it is told to.
        tensors(folder / FROZEN)
        tensors(folder / CONDITIONED, "model")
        place = str(folder)
        try:
            model = kind(device=str(device), fmde_dir=place, cmde_dir=place, ckpt_dir=place)
        except RuntimeError as error:
            raise WeightsInvalid(f"{folder.name} does not hold the weights of PriorDA") from error
        return cls(model.to(device).eval().requires_grad_(False), device)

    def complete(self, rgb: NDArray[np.uint8], depth: NDArray[np.float32], camera: Camera) -> NDArray[np.float32]:
        """See `DepthCompletion.complete`."""
        known = depth > 0
        # The network tells depths apart as shares of a range, and shifts values by a little chance.
        low, high = float(depth[known].min()), float(depth[known].max())
        devices = [self._device] if self._device.type == "cuda" else []
        with torch.inference_mode(), torch.random.fork_rng(devices):
            torch.manual_seed(_SEED)
            found = self._model.infer_one_sample(
                image=picture(rgb, self._device).permute(1, 2, 0).float(),
                prior=torch.from_numpy(np.ascontiguousarray(depth, np.float32)).to(self._device),
            )
        out = np.asarray(found.float().cpu().numpy(), np.float32)
        # Between samples it may pass below zero, which is no depth, or give none.
        out[~np.isfinite(out) | (out <= 0)] = high
        return np.asarray(np.maximum(out, np.float32(1e-3 * low)), np.float32)
