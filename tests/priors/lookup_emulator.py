"""The lookup kernels on a CPU: their own source, with the device of the bundle adjustment's emulator."""

from __future__ import annotations

import ctypes
import hashlib
import os
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from vipe_core.priors.droid import kernels
from vipe_core.priors.droid.kernels import LookupKernels

COMPILER = shutil.which("g++") or shutil.which("clang++")
ORDERS = 3
"""In how many orders the threads of a block can take turns."""

_DEVICE = Path(__file__).parents[1] / "ba" / "cuda_emulator" / "device.h"
# What NVRTC knows and the emulator has not needed before.
_PRELUDE = """
#define __forceinline__ inline
struct uint4 { unsigned x, y, z, w; };
"""
_CALLS = {
    "lookup_volume": "*(value_t**)p[0], *(value_t**)p[1], *(value_t**)p[2], *(value_t**)p[3], *(float**)p[4],"
    " *(value_t**)p[5], *(long long*)p[6], *(int*)p[7], *(int*)p[8]",
    "lookup_features": "*(value_t**)p[0], *(value_t**)p[1], *(value_t**)p[2], *(value_t**)p[3], *(long long**)p[4],"
    " *(long long**)p[5], *(float**)p[6], *(value_t**)p[7], *(int*)p[8], *(int*)p[9]",
}


class EmulatedLookups(LookupKernels):
    """The kernels of single precision on a CPU; halves are widened for them and their answers rounded."""

    def __init__(self, order: int = 0) -> None:
        self._library, self._order = _library(), order

    def of_volume(self, levels: Sequence[Tensor], at: Tensor) -> Tensor:
        return super().of_volume([level.float() for level in levels], at).to(levels[0].dtype)

    def of_features(self, levels: Sequence[Tensor], source: Tensor, target: Tensor, at: Tensor) -> Tensor:
        wide = [level.float() for level in levels]
        return super().of_features(wide, source, target, at).to(levels[0].dtype)

    def _launch(self, kernel: str, blocks: int, threads: int, tensors: Any, numbers: Any) -> None:
        assert all(tensor.is_contiguous() for tensor in tensors)
        values = [*(ctypes.c_void_p(tensor.data_ptr()) for tensor in tensors), *numbers]
        parameters = (ctypes.c_void_p * len(values))(*(ctypes.addressof(value) for value in values))
        function = getattr(self._library, f"emulate_{kernel}")
        function.restype = ctypes.c_char_p
        failure = function(ctypes.c_uint(blocks), ctypes.c_uint(threads), self._order, parameters)
        assert failure is None, failure


@cache
def _library() -> ctypes.CDLL:
    assert COMPILER is not None
    wrappers = "".join(
        f'extern "C" const char* emulate_{name}(unsigned blocks, unsigned threads, int order, void** p) {{'
        f" return emulator::run(blocks, threads, 0, order, [&] {{ {name}({call}); }}); }}\n"
        for name, call in _CALLS.items()
    )
    text = _PRELUDE + kernels.source(torch.float32) + wrappers
    key = hashlib.sha256(f"{text}\0{_DEVICE.read_text()}".encode()).hexdigest()[:24]
    folder = Path(tempfile.gettempdir()) / f"vipe-cuda-emulator-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    library = folder / f"lookup-{key}.so"
    if not library.exists():
        partial = library.with_suffix(f".{os.getpid()}")
        command = [COMPILER, "-std=c++17", "-O1", "-fno-strict-aliasing", "-U_FORTIFY_SOURCE", "-w", "-shared", "-fPIC"]
        command += ["-x", "c++", "-include", str(_DEVICE), "-", "-o", str(partial)]
        subprocess.run(command, input=text, text=True, check=True)
        partial.replace(library)
    return ctypes.CDLL(str(library))
