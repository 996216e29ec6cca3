"""The networks of nvidia-vipe from an unpacked source distribution of it, whose extension need not be built.

What is written for CUDA alone there is led to another device while a network runs: tensors that it makes on "cuda" are
made where they are wanted, and its search for nearest neighbours, which is compiled, is SciPy's. The networks
themselves are its own to the last layer.
"""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any
from unittest import mock

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

# What its modules look for in the extension as they are imported.
_EXTENSIONS = ("droid_net_ext", "grounding_dino_ext", "slam_ext", "scatter_ext", "lietorch_ext", "corr_ext")
_ADAPTERS = "vipe_core.priors.nvidia_vipe"


def load(folder: Path) -> None:
    """Make `import vipe.priors...` find the networks in an unpacked source distribution.

    Raises:
        ImportError: That is not its source.
    """
    if not (folder / "vipe" / "priors").is_dir():
        raise ImportError(f"{folder} is no unpacked source distribution of nvidia-vipe")
    sys.path.insert(0, str(folder))
    _bare_torchvision()
    if importlib.util.find_spec("vipe_ext") is None:
        extension: Any = ModuleType("vipe_ext")
        for name in _EXTENSIONS:
            setattr(extension, name, SimpleNamespace())
        extension.utils_ext = SimpleNamespace(nearest_neighbours=_nearest_neighbours)
        sys.modules["vipe_ext"] = extension


@contextlib.contextmanager
def led_to(device: torch.device) -> Iterator[None]:
    """Where what is written for CUDA runs on a device, and our adapters do not refuse it."""
    if device.type == "cuda":
        yield
        return
    with contextlib.ExitStack() as stack:
        for module in ("metric_depth", "completion"):
            stack.enter_context(mock.patch(f"{_ADAPTERS}.{module}.require_cuda"))
        stack.enter_context(_Led(device))
        yield


class _Led(TorchFunctionMode):
    """Every function of torch that is given a CUDA device gets this one instead."""

    def __init__(self, device: torch.device) -> None:
        super().__init__()
        self._device = device

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        named = dict(kwargs or {})
        if "device" in named and torch.device(named["device"] or "cpu").type == "cuda":
            named["device"] = self._device
        return func(*args, **named)


def _nearest_neighbours(query: Tensor, known: Tensor, count: int) -> tuple[Tensor, Tensor]:
    from scipy.spatial import cKDTree

    distance, index = cKDTree(known.cpu().numpy()).query(query.cpu().numpy(), k=count)
    return torch.from_numpy(distance).square().to(query.device), torch.from_numpy(index).to(query.device)


def _bare_torchvision() -> None:
    """Where torchvision was compiled for another torch, its operators cannot be loaded; no network here uses them, but
    it is not imported without two of them having a name."""
    found = importlib.util.find_spec("torchvision")
    operators: Any = torch.ops  # without types
    for folder in (found.submodule_search_locations or ()) if found else ():
        for library in Path(folder).glob("_C*.so"):
            try:
                operators.load_library(str(library))
            except OSError:
                for operator in ("nms", "qnms"):
                    name = f"torchvision::{operator}"
                    torch.library.define(name, "(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
