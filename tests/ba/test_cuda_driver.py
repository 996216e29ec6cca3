"""What the launcher asks of a CUDA driver, through the real bindings, with a driver that does nothing."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from cuda_emulator import COMPILER

pytest.importorskip("cuda.core", reason="cuda-core loads the kernels")
pytestmark = pytest.mark.skipif(
    COMPILER is None or sys.platform != "linux" or torch.cuda.is_available(), reason="the driver stands in on Linux"
)

# In a process of its own: a library is loaded once, and no other test may take this driver for one.
_PROGRAM = """
import ctypes, sys
ctypes.CDLL(sys.argv[1], ctypes.RTLD_GLOBAL)
import contextlib
import types
import torch
from vipe_core.ba.cuda import launcher
from vipe_core.ba.cuda.compiler import Specialisation
from vipe_core.ba.cuda.context import Context
from vipe_core.ba.cuda.solver import _Parameters
from cuda.core import ObjectCode

stream = types.SimpleNamespace(cuda_stream=0x1234, synchronize=lambda: None)
torch.cuda.device = lambda index: contextlib.nullcontext()
torch.cuda.current_stream = lambda index=None: stream
torch.cuda.get_device_capability = lambda index: (9, 0)
launcher.compile_kernels = lambda source, architecture, cache: ObjectCode.from_cubin(b"\\x7fELF" + bytes(64))
found = launcher.DeviceLauncher(3, Specialisation(False, True, False, "none"))
launch = found.on_current_stream()
stream.cuda_stream = 0
parameters = _Parameters(Context(num_frames=7))
launch("tile", 5, 128, 65536, parameters.address(41, 0))
found.on_current_stream()("fold", 6, 256, 0, parameters.address(42, 0))
try:
    launch("judge", 0, 256, 0, parameters.address(0, 0))
except RuntimeError as error:
    print(error)
"""


def test_every_argument_arrives(tmp_path: Path) -> None:
    """Names, shared memory, sizes, stream and parameters; launches keep to the stream that was current once, and one
    that is refused is an error."""
    assert COMPILER is not None
    library = tmp_path / "libcuda.so.1"
    source = Path(__file__).parent / "cuda_emulator" / "driver.cpp"
    subprocess.run([COMPILER, "-shared", "-fPIC", "-Wl,-soname,libcuda.so.1", source, "-o", library], check=True)
    command = [sys.executable, "-c", _PROGRAM, str(library)]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert sorted(done.stdout.splitlines()) == [
        "CUDA driver: CUDA_ERROR_INVALID_VALUE",
        "fold 6 x 256, 0 bytes, on 0, frames 7, number 42",
        "tile 5 x 128, 65536 bytes, on 4660, frames 7, number 41",
        "tile may have 232448 bytes on 3",
        "tile_large may have 232448 bytes on 3",
    ]
