"""The lookup kernels: executed on a CPU by the emulator of the bundle adjustment's tests, and compiled by NVRTC."""

from __future__ import annotations

import ctypes
import io
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from vipe_core.ba.cuda.compiler import compile_kernels
from vipe_core.priors.droid import kernels
from vipe_core.priors.droid.correlation import FeatureCorrelation, VolumeCorrelation
from vipe_core.priors.droid.kernels import LookupKernels

DEVICE = Path(__file__).parents[1] / "ba" / "cuda_emulator" / "device.h"
COMPILER = shutil.which("g++") or shutil.which("clang++")

# What NVRTC knows and the emulator has not needed before.
PRELUDE = """
#define __forceinline__ inline
struct uint4 { unsigned x, y, z, w; };
"""
CALLS = {
    "lookup_volume": "*(value_t**)p[0], *(value_t**)p[1], *(value_t**)p[2], *(value_t**)p[3], *(float**)p[4],"
    " *(value_t**)p[5], *(long long*)p[6], *(int*)p[7], *(int*)p[8]",
    "lookup_features": "*(value_t**)p[0], *(value_t**)p[1], *(value_t**)p[2], *(value_t**)p[3], *(long long**)p[4],"
    " *(long long**)p[5], *(float**)p[6], *(value_t**)p[7], *(int*)p[8], *(int*)p[9]",
}


class Emulated(LookupKernels):
    """The kernels on a CPU; the order in which threads of a block take turns is a choice."""

    def __init__(self, library: ctypes.CDLL, order: int) -> None:
        self._library, self._order = library, order

    def _launch(self, kernel: str, blocks: int, threads: int, tensors: Any, numbers: Any) -> None:
        assert all(tensor.is_contiguous() for tensor in tensors)
        values = [*(ctypes.c_void_p(tensor.data_ptr()) for tensor in tensors), *numbers]
        parameters = (ctypes.c_void_p * len(values))(*(ctypes.addressof(value) for value in values))
        function = getattr(self._library, f"emulate_{kernel}")
        function.restype = ctypes.c_char_p
        failure = function(ctypes.c_uint(blocks), ctypes.c_uint(threads), self._order, parameters)
        assert failure is None, failure


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    if COMPILER is None:
        pytest.skip("no C++ compiler to run the kernels with")
    wrappers = "".join(
        f'extern "C" const char* emulate_{name}(unsigned blocks, unsigned threads, int order, void** p) {{'
        f" return emulator::run(blocks, threads, 0, order, [&] {{ {name}({call}); }}); }}\n"
        for name, call in CALLS.items()
    )
    path = tmp_path_factory.mktemp("lookup") / "lookup.so"
    command = [COMPILER, "-std=c++17", "-O1", "-fno-strict-aliasing", "-U_FORTIFY_SOURCE", "-w", "-shared", "-fPIC"]
    command += ["-x", "c++", "-include", str(DEVICE), "-", "-o", str(path)]
    subprocess.run(command, input=PRELUDE + kernels.source(torch.float32) + wrappers, text=True, check=True)
    return ctypes.CDLL(str(path))


@pytest.mark.parametrize(("height", "width"), [(5, 7), (9, 4), (1, 2)])
def test_the_kernels_give_what_torch_gives_in_any_order_of_threads(
    library: ctypes.CDLL, height: int, width: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(height)
    features = torch.from_numpy(rng.standard_normal((3, 128, height, width)).astype(np.float32))
    cells = torch.from_numpy(rng.uniform(-5, max(height, width) + 5, (2, height, width, 2)).astype(np.float32))
    cells[0, 0, 0] = torch.tensor([1e9, -1e9])
    cells[1, 0, 1] = torch.tensor([1.0, 0.0])
    source, target = torch.tensor([0, 2]), torch.tensor([1, 0])
    volume = VolumeCorrelation.of(features[source], features[target])
    on_the_fly = FeatureCorrelation.of(features, source, target)
    for correlation in (volume, on_the_fly):
        expected = correlation.lookup(cells)
        answers = []
        for order in range(3):
            emulated = Emulated(library, order)
            with monkeypatch.context() as patched:
                patched.setattr(
                    "vipe_core.priors.droid.correlation.lookup_kernels", lambda *_, emulated=emulated: emulated
                )
                answers.append(correlation.lookup(cells))
            torch.testing.assert_close(answers[-1], expected, atol=2e-5, rtol=0)
        assert all(torch.equal(answers[0], other) for other in answers[1:])


@pytest.mark.parametrize("architecture", ["sm_80", "sm_90", "sm_120"])
def test_the_kernels_compile_for_every_architecture_without_spilling(architecture: str) -> None:
    pytest.importorskip("cuda.core")
    for dtype in kernels.VALUE_MACROS:
        log = io.StringIO()
        code = compile_kernels(kernels.source(dtype), architecture, cache=None, log=log)
        assert code is not None
        report = log.getvalue()
        registers = [int(found) for found in re.findall(r"Used (\d+) registers", report)]
        spills = [int(found) for found in re.findall(r"(\d+) bytes spill", report)]
        assert len(registers) == len(kernels.NAMES)
        assert max(registers) <= 128
        assert not any(spills)
