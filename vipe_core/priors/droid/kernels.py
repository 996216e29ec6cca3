"""The CUDA kernels of `lookup.cu`, compiled for the GPU at hand and launched on torch's current stream."""

from __future__ import annotations

import ctypes
import logging
from collections.abc import Sequence
from functools import cache
from importlib import resources
from typing import Any

import torch
from torch import Tensor

from vipe_core.ba.cuda.compiler import cache_folder, compile_kernels

logger = logging.getLogger(__name__)

NAMES = ("lookup_volume", "lookup_features")
VALUE_MACROS = {torch.float16: "VALUE_F16", torch.float32: "VALUE_F32"}

# As in `lookup.cu`.
_CHANNELS = 196
_VOLUME_CELLS, _LEVELS = 32, 4
_FEATURE_CELLS = 8


def source(dtype: torch.dtype) -> str:
    """The kernels for one type of value."""
    text = (resources.files("vipe_core.priors.droid") / "lookup.cu").read_text()
    return f"#define {VALUE_MACROS[dtype]}\n{text}"


class LookupKernels:
    """The kernels on a GPU.

    Raises:
        ImportError: cuda-core or cuda-bindings is not installed.
        Exception: Whatever cuda-core raises where the driver, NVRTC or the kernels fail.
    """

    def __init__(self, device_index: int, dtype: torch.dtype) -> None:
        from cuda.bindings import driver

        self._driver: Any = driver
        self._index = device_index
        with torch.cuda.device(device_index):
            torch.cuda.current_stream().synchronize()  # makes the device's context current in this thread
            major, minor = torch.cuda.get_device_capability(device_index)
            self._code = compile_kernels(source(dtype), f"sm_{major}{minor}", cache=cache_folder())
            self._kernels = {name: driver.CUfunction(int(self._code.get_kernel(name).handle)) for name in NAMES}

    def of_volume(self, levels: Sequence[Tensor], at: Tensor) -> Tensor:
        """(E, P, 196) values around positions (E, P, 2) in a pyramid of volumes (E, P, h >> L, w >> L)."""
        edges, cells, height, width = levels[0].shape
        out = at.new_empty(edges, cells, _CHANNELS, dtype=levels[0].dtype)
        total = edges * cells
        numbers = (ctypes.c_longlong(total), ctypes.c_int(height), ctypes.c_int(width))
        blocks = -(-total // _VOLUME_CELLS)
        self._launch("lookup_volume", blocks, _VOLUME_CELLS * _LEVELS, (*levels, at, out), numbers)
        return out

    def of_features(self, levels: Sequence[Tensor], source: Tensor, target: Tensor, at: Tensor) -> Tensor:
        """(E, P, 196) products around positions (E, P, 2), of features in a pyramid (F, h >> L, w >> L, 128).

        Args:
            source: (E,) int64 frame of the queries.
            target: (E,) int64 frame that is looked into.
        """
        _, height, width, _ = levels[0].shape
        edges, cells, _ = at.shape
        out = at.new_empty(edges, cells, _CHANNELS, dtype=levels[0].dtype)
        blocks = edges * -(-cells // _FEATURE_CELLS)
        numbers = (ctypes.c_int(height), ctypes.c_int(width))
        self._launch("lookup_features", blocks, 32 * _FEATURE_CELLS, (*levels, source, target, at, out), numbers)
        return out

    def _launch(
        self, kernel: str, blocks: int, threads: int, tensors: Sequence[Tensor], numbers: Sequence[Any]
    ) -> None:
        if blocks == 0:
            return
        assert all(tensor.is_contiguous() for tensor in tensors)
        values = [*(ctypes.c_void_p(tensor.data_ptr()) for tensor in tensors), *numbers]
        parameters = (ctypes.c_void_p * len(values))(*(ctypes.addressof(value) for value in values))
        stream = self._driver.CUstream(torch.cuda.current_stream(self._index).cuda_stream)
        (answer,) = self._driver.cuLaunchKernel(
            self._kernels[kernel], blocks, 1, 1, threads, 1, 1, 0, stream, ctypes.addressof(parameters), 0
        )
        if answer != self._driver.CUresult.CUDA_SUCCESS:
            raise RuntimeError(f"CUDA driver: {answer.name}")


def lookup_kernels(device: torch.device, dtype: torch.dtype) -> LookupKernels | None:
    """The kernels for a device and a type of value; None on a CPU, and where they cannot be had: torch does it then."""
    if device.type != "cuda":
        return None
    return _opened(torch.cuda.current_device() if device.index is None else device.index, dtype)


@cache
def _opened(device_index: int, dtype: torch.dtype) -> LookupKernels | None:
    try:
        return LookupKernels(device_index, dtype)
    except Exception:
        # cuda-core has no common base of errors; without the kernels there is another way for everything.
        logger.warning("CUDA kernels for looking up correlations cannot be used; torch does it", exc_info=True)
        return None
