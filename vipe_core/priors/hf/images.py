"""Pictures as networks want them: resized on the device, normalised with the statistics of ImageNet."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from vipe_core.transfer import uploaded

IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


def normalised(
    rgb: NDArray[np.uint8],
    size: tuple[int, int],
    device: torch.device,
    mean: tuple[float, float, float] = IMAGENET_MEAN,
    std: tuple[float, float, float] = IMAGENET_STD,
) -> Tensor:
    """(1, 3, h, w) float32 of a picture (H, W, 3).

    Args:
        size: (width, height) to resize to, with smoothing where it is smaller.
    """
    whole = uploaded(np.ascontiguousarray(rgb), device).permute(2, 0, 1)[None].float() / 255
    if (whole.shape[3], whole.shape[2]) != size:
        whole = torch.nn.functional.interpolate(whole, size=(size[1], size[0]), mode="bilinear", antialias=True)
    shift, scale = (uploaded(torch.tensor(values), device).view(1, 3, 1, 1) for values in (mean, std))
    return (whole - shift) / scale


def fitted(width: int, height: int, shortest: int, longest: int) -> tuple[int, int]:
    """(width, height) with the aspect of a picture, the shorter side `shortest` unless the longer were too long."""
    scale = min(shortest / min(width, height), longest / max(width, height))
    return max(1, round(width * scale)), max(1, round(height * scale))


def resized(values: Tensor, height: int, width: int) -> NDArray[Any]:
    """(height, width) float32 of a map (h, w) on any device."""
    large = torch.nn.functional.interpolate(values.float()[None, None], size=(height, width), mode="bilinear")
    return np.ascontiguousarray(large[0, 0].cpu().numpy(), dtype=np.float32)
