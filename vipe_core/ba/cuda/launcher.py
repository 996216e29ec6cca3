"""Launching compiled kernels on torch's current stream."""

from __future__ import annotations

import logging
from functools import cache
from typing import Any, Protocol

import torch

from vipe_core.ba.cuda.compiler import (
    SYSTEM_KERNELS,
    TILE_KERNELS,
    Specialisation,
    cache_folder,
    compile_kernels,
    system_source,
    tile_source,
)

logger = logging.getLogger(__name__)


class Launch(Protocol):
    """Launches kernels one after the other on one stream."""

    def __call__(self, kernel: str, blocks: int, threads: int, shared_bytes: int, parameters: int) -> None:
        """Launch a kernel.

        Args:
            kernel: One of `SYSTEM_KERNELS` and `TILE_KERNELS`.
            blocks: At least one.
            threads: Per block.
            shared_bytes: Dynamic shared memory.
            parameters: Address of an array of addresses of the parameters; both are read before this returns.
        """


class Launcher(Protocol):
    """Has kernels. Holds nothing of what is launched, so threads may share it."""

    def on_current_stream(self) -> Launch:
        """Launches on the stream that is current now, whatever is later; its device must be current then, too."""


class DeviceLauncher:
    """The kernels of a specialisation on a GPU.

    Raises:
        ImportError: cuda-core or cuda-bindings is not installed.
        Exception: Whatever cuda-core raises where the driver, NVRTC or the kernels fail.
    """

    def __init__(self, device_index: int, kind: Specialisation) -> None:
        from cuda.bindings import driver

        self._driver: Any = driver
        self._index = device_index
        with torch.cuda.device(device_index):
            torch.cuda.current_stream().synchronize()  # makes the device's context current in this thread
            self._objects = (_system(device_index), _compiled(device_index, tile_source([kind])))
            names = (SYSTEM_KERNELS, TILE_KERNELS)
            self._kernels = {
                name: driver.CUfunction(int(code.get_kernel(name).handle))
                for code, some in zip(self._objects, names, strict=True)
                for name in some
            }
            # More than 48 KiB of shared memory has to be asked for.
            device = driver.CUdevice(device_index)
            optin = driver.CUdevice_attribute.CU_DEVICE_ATTRIBUTE_MAX_SHARED_MEMORY_PER_BLOCK_OPTIN
            most = self._check(driver.cuDeviceGetAttribute(optin, device))
            attribute = driver.CUfunction_attribute.CU_FUNC_ATTRIBUTE_MAX_DYNAMIC_SHARED_SIZE_BYTES
            for name in TILE_KERNELS:
                kernel = driver.CUkernel(int(self._kernels[name]))
                self._check(driver.cuKernelSetAttribute(attribute, most, kernel, device))

    def on_current_stream(self) -> Launch:
        stream = self._driver.CUstream(torch.cuda.current_stream(self._index).cuda_stream)

        def launch(kernel: str, blocks: int, threads: int, shared_bytes: int, parameters: int) -> None:
            function = self._kernels[kernel]
            answer = self._driver.cuLaunchKernel(
                function, blocks, 1, 1, threads, 1, 1, shared_bytes, stream, parameters, 0
            )
            self._check(answer)

        return launch

    def _check(self, answer: tuple[Any, ...]) -> Any:
        """What a driver function returned beside its error code."""
        if answer[0] != self._driver.CUresult.CUDA_SUCCESS:
            raise RuntimeError(f"CUDA driver: {answer[0].name}")
        return answer[1] if len(answer) > 1 else None


def _compiled(device_index: int, source: str) -> Any:
    major, minor = torch.cuda.get_device_capability(device_index)
    return compile_kernels(source, f"sm_{major}{minor}", cache=cache_folder())


@cache
def _system(device_index: int) -> Any:
    return _compiled(device_index, system_source())


@cache
def _failed() -> None:
    """Says once that the kernels cannot be had."""
    logger.warning("CUDA kernels for bundle adjustment cannot be used; torch does it", exc_info=True)


@cache
def device_launcher(device_index: int, kind: Specialisation) -> DeviceLauncher | None:
    """The kernels of a specialisation, or None where they cannot be compiled or loaded, which is logged once."""
    try:
        return DeviceLauncher(device_index, kind)
    except Exception:
        # cuda-core has no common base of errors; without the kernels there is another way for everything.
        _failed()
        return None
