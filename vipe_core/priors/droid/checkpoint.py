"""Reading the network's weights: the public checkpoint (`droid.pth`), or the same tensors as safetensors.

The public file is a flat dictionary of 102 tensors with the prefix `module.` that parallel training leaves. The last
layers of two heads have more outputs there than the network uses: the first two are taken. Nothing is unpickled.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file
from torch import Tensor

from vipe_core.errors import WeightsInvalid
from vipe_core.priors.droid.network import DroidNetwork

_PREFIX = "module."
_TRIMMED = ("update.weight.2.", "update.delta.2.")
_SHOWN = 5


def load_network(path: Path) -> DroidNetwork:
    """The network with the weights of a file, on the CPU.

    Raises:
        WeightsInvalid: It is no such file; the message names the tensors that are missing, not known, of another shape
            or not finite.
    """
    network = DroidNetwork()
    found = {name.removeprefix(_PREFIX): tensor for name, tensor in _read(path).items()}
    wanted = network.state_dict()
    for name, tensor in found.items():
        if name.startswith(_TRIMMED) and name in wanted and tensor.ndim and tensor.shape[0] > wanted[name].shape[0]:
            found[name] = tensor[: wanted[name].shape[0]]
    problems = {
        "missing": [name for name in wanted if name not in found],
        "not known": [name for name in found if name not in wanted],
        "of another shape": [
            f"{name} {tuple(tensor.shape)} instead of {tuple(wanted[name].shape)}"
            for name, tensor in found.items()
            if name in wanted and tensor.shape != wanted[name].shape
        ],
        "not finite": [name for name, tensor in found.items() if not bool(tensor.isfinite().all())],
    }
    told = [f"{_some(names)} {what}" for what, names in problems.items() if names]
    if told:
        raise WeightsInvalid(
            f"{path.name} does not hold the weights of the DROID network: {'; '.join(told)}; fetch it again with"
            " `vipectl models pull droid`"
        )
    network.load_state_dict({name: tensor.to(wanted[name].dtype) for name, tensor in found.items()})
    return network


def _read(path: Path) -> dict[str, Tensor]:
    try:
        if path.suffix == ".safetensors":
            return load_file(path)
        content: Any = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # What the readers meet in damaged bytes is theirs to name.
        raise WeightsInvalid(
            f"{path.name} cannot be read as weights; fetch it again with `vipectl models pull droid`"
        ) from error
    if not isinstance(content, dict) or not all(
        isinstance(name, str) and isinstance(tensor, Tensor) for name, tensor in content.items()
    ):
        raise WeightsInvalid(f"{path.name} does not hold named tensors and nothing else")
    return content


def _some(names: list[str]) -> str:
    rest = len(names) - _SHOWN
    return ", ".join(names[:_SHOWN]) + (f" and {rest} more" if rest > 0 else "")
