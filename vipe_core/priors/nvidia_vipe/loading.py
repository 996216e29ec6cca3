"""Getting at the networks of the package `nvidia-vipe`, and their weights from files."""

from __future__ import annotations

import contextlib
import importlib
import io
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from vipe_core.errors import ConfigError, LibraryMissing, WeightsInvalid, WeightsMissing
from vipe_core.transfer import uploaded

INSTALL = (
    "pip install 'vipe-cluster[nvidia-vipe]' && pip install --no-deps --no-build-isolation nvidia-vipe==1.2.0 (its"
    " CUDA code is compiled then, which takes nvcc)"
)


def part(module: str, *names: str) -> tuple[Any, ...]:
    """What a module of the package has under these names.

    Raises:
        LibraryMissing: The package, or something that it needs, is not installed; the message says what installs it.
    """
    try:
        found = importlib.import_module(f"vipe.priors.{module}")
        return tuple(getattr(found, name) for name in names)
    except Exception as error:
        # Its extension is compiled as it is imported where it was not before, and that fails in every way there is.
        first_line = (str(error) or type(error).__name__).splitlines()[0][:200]
        raise LibraryMissing(f"{module} of nvidia-vipe cannot be used ({first_line}); install it: {INSTALL}") from error


def require_cuda(network: str, device: torch.device) -> None:
    """Refuse a device on which the package's code of a network cannot run.

    Raises:
        ConfigError: It is no CUDA device.
    """
    if device.type != "cuda":
        raise ConfigError(f"{network} of nvidia-vipe runs on CUDA only, not on {device}; choose --device cuda")


def tensors(path: Path, key: str | None = None) -> dict[str, Tensor]:
    """The named tensors of a file, or of one of its entries; nothing is unpickled.

    Raises:
        WeightsMissing: No such file.
        WeightsInvalid: It holds something else.
    """
    if not path.is_file():
        raise WeightsMissing(f"{path} does not exist; get it with `vipectl models pull`")
    try:
        content: Any = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # What the readers meet in damaged bytes is theirs to name.
        raise WeightsInvalid(
            f"{path.name} cannot be read as weights; get it again with `vipectl models pull`"
        ) from error
    if key is not None and isinstance(content, dict):
        content = content.get(key)
    if not isinstance(content, dict) or not all(isinstance(value, Tensor) for value in content.values()):
        raise WeightsInvalid(f"{path.name} does not hold named tensors and nothing else")
    return content


def filled(network: nn.Module, found: dict[str, Tensor], name: str, device: torch.device) -> Any:
    """A network with weights, ready for inference.

    Raises:
        WeightsInvalid: Tensors are missing, or of another shape. More than it has does no harm.
    """
    try:
        missing = list(network.load_state_dict(found, strict=False).missing_keys)
    except RuntimeError as error:
        raise WeightsInvalid(f"{name} holds tensors of other shapes than the network has") from error
    if missing:
        raise WeightsInvalid(f"{name} lacks {len(missing)} tensors of the network, such as {missing[0]}")
    return network.to(device).eval().requires_grad_(False)


def from_folder(kind: Any, folder: Path, device: torch.device) -> Any:
    """A network that the hub keeps as `config.json` and `model.safetensors`.

    Raises:
        WeightsMissing: They are not there.
        WeightsInvalid: They are not of this network.
    """
    if not all((folder / name).is_file() for name in ("config.json", "model.safetensors")):
        raise WeightsMissing(f"{folder} holds no config.json with safetensors; get them with `vipectl models pull`")
    try:
        # The library prints.
        with contextlib.redirect_stdout(io.StringIO()):
            network = kind.from_pretrained(str(folder), local_files_only=True, strict=True)
    except Exception as error:
        first_line = (str(error) or type(error).__name__).splitlines()[0][:200]
        raise WeightsInvalid(f"{folder.name} cannot be read as weights of {kind.__name__}: {first_line}") from error
    network.interpolation_mode = "bilinear"
    return network.to(device).eval().requires_grad_(False)


def picture(rgb: NDArray[np.uint8], device: torch.device) -> Tensor:
    """(3, h, w) uint8 of a picture (h, w, 3)."""
    return uploaded(np.ascontiguousarray(rgb), device).permute(2, 0, 1)
