"""Between the host and a device, with as few waits of the one for the other as can be."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

# What is larger does not fit where the driver keeps pageable memory until it is sent, and is copied piece by piece
# behind all that the device has to do before; what is much larger would take pinned memory from the whole machine.
_PINNED_BYTES = range(64 << 10, 64 << 20)


def uploaded(values: Tensor | NDArray[Any], device: torch.device) -> Tensor:
    """Values of the host on a device, without waiting for what runs there; they may be overwritten at once, but for a
    device that is the host itself, which shares them."""
    tensor = torch.from_numpy(values) if isinstance(values, np.ndarray) else values
    if device.type == "cuda" and tensor.device.type == "cpu" and tensor.nbytes in _PINNED_BYTES:
        tensor = tensor.pin_memory()
    return tensor.to(device, non_blocking=True)


def downloaded(*tensors: Tensor) -> tuple[NDArray[Any], ...]:
    """Tensors of one device on the host, in one piece: the host waits once."""
    if all(tensor.device.type == "cpu" for tensor in tensors):
        return tuple(tensor.numpy() for tensor in tensors)
    # The widest values first, so that each begins at a multiple of its size.
    order = sorted(range(len(tensors)), key=lambda k: -tensors[k].element_size())
    packed = torch.cat([tensors[k].contiguous().view(-1).view(torch.uint8) for k in order]).cpu()
    found: dict[int, NDArray[Any]] = {}
    start = 0
    for k in order:
        end = start + tensors[k].nbytes
        found[k] = packed[start:end].view(tensors[k].dtype).view(tensors[k].shape).numpy()
        start = end
    return tuple(found[k] for k in range(len(tensors)))
