"""The CUDA kernels of bundle adjustment on a CPU: their own source, compiled by the host's C++ compiler.

`device.h` emulates threads, barriers, exchanges within a warp and shared memory. `EmulatedLauncher` takes the place of
`DeviceLauncher`, so `Adjustment` and everything it launches run as they would on a GPU.
"""

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

from vipe_core.ba.cuda.compiler import SYSTEM_KERNELS, TILE_KERNELS, Specialisation, system_source, tile_source
from vipe_core.ba.cuda.context import Context
from vipe_core.ba.cuda.launcher import Launch

_DEVICE = Path(__file__).with_name("device.h")
_SANITIZERS = os.environ.get("VIPE_EMULATOR_SANITIZERS")
"""Of the compiler, see `benchmarks/ba_sanitize.py`."""
COMPILER = shutil.which("g++") or shutil.which("clang++")
ORDERS = 3
"""In how many orders blocks of threads, and the threads of one, can take turns."""


def _wrapper(kernel: str, numbers: int) -> str:
    arguments = "".join(f", *(int*)parameters[{k + 1}]" for k in range(numbers))
    return (
        f'extern "C" const char* emulate_{kernel}(unsigned blocks, unsigned threads, unsigned shared_bytes, int order, '
        f"void** parameters) {{\n    return emulator::run(blocks, threads, shared_bytes, order, [&] {{ "
        f"{kernel}(*(const Context*)parameters[0]{arguments}); }});\n}}\n"
    )


_NUMBERS = {"damp": 1, "gather": 2, "factorise": 2, "substitute": 1, "covariance": 1}


def _build(source: str) -> ctypes.CDLL:
    """Compile, or find compiled by another test process."""
    assert COMPILER is not None
    command = [COMPILER, "-std=c++17", "-O1", "-fno-strict-aliasing", "-ffp-contract=off", "-U_FORTIFY_SOURCE"]
    command += ["-w", "-shared", "-fPIC", "-x", "c++", "-include", str(_DEVICE)]
    if _SANITIZERS:
        command += [f"-fsanitize={_SANITIZERS}", "-fno-sanitize-recover=all", "-g"]
    key = hashlib.sha256("\0".join([source, _DEVICE.read_text(), *command]).encode()).hexdigest()[:24]
    folder = Path(tempfile.gettempdir()) / f"vipe-cuda-emulator-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    library = folder / f"{key}.so"
    if not library.exists():
        partial = library.with_suffix(f".{os.getpid()}")
        subprocess.run([*command, "-", "-o", str(partial)], input=source, text=True, check=True)
        partial.replace(library)
    return ctypes.CDLL(str(library))


@cache
def _system() -> ctypes.CDLL:
    wrappers = (_wrapper(kernel, _NUMBERS.get(kernel, 0)) for kernel in SYSTEM_KERNELS)
    return _build(system_source() + "".join(wrappers))


@cache
def _tiles(kinds: tuple[Specialisation, ...]) -> ctypes.CDLL:
    names = [f"{name}_{k}" for k in range(len(kinds)) for name in TILE_KERNELS]
    return _build(tile_source(kinds, numbered=True) + "".join(_wrapper(name, 1) for name in names))


class EmulatedLauncher:
    """A `Launcher` of the kernels of one of several specialisations, compiled together."""

    def __init__(self, kind: Specialisation, compiled: Sequence[Specialisation], order: int = 0) -> None:
        self._order = order
        self._kernels = {}
        for name in SYSTEM_KERNELS:
            self._kernels[name] = getattr(_system(), f"emulate_{name}")
        number = list(compiled).index(kind)
        for name in TILE_KERNELS:
            self._kernels[name] = getattr(_tiles(tuple(compiled)), f"emulate_{name}_{number}")
        for function in self._kernels.values():
            function.restype = ctypes.c_char_p
            function.argtypes = [*([ctypes.c_uint] * 3), ctypes.c_int, ctypes.c_void_p]
        self.launched: list[str] = []

    def on_current_stream(self) -> Launch:
        self.launched.clear()
        return self._launch

    def _launch(self, kernel: str, blocks: int, threads: int, shared_bytes: int, parameters: int) -> None:
        self.launched.append(kernel)
        failure = self._kernels[kernel](blocks, threads, shared_bytes, self._order, parameters)
        if failure is not None:
            raise AssertionError(f"{kernel}: {failure.decode()}")


__all__ = ["COMPILER", "ORDERS", "Context", "EmulatedLauncher"]
