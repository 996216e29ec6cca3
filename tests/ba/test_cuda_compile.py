"""The CUDA kernels of bundle adjustment through the engine's own compile path, without a GPU.

A sample of specialisations and architectures; `python -m benchmarks.ba_kernels` compiles all of them.
"""

from __future__ import annotations

import logging
from pathlib import Path

import pytest
import torch

from benchmarks.ba_kernels import usage
from vipe_core.ba.cuda import launcher
from vipe_core.ba.cuda.compiler import (
    SYSTEM_KERNELS,
    TILE_KERNELS,
    Specialisation,
    compile_kernels,
    specialisations,
    system_source,
    tile_source,
)

pytest.importorskip("cuda.core", reason="cuda-core compiles the kernels")
pytest.importorskip("cuda.bindings.nvrtc", reason="NVRTC compiles the kernels")

_STATIC_SHARED_BYTES = 48 << 10


@pytest.mark.parametrize(
    ("architecture", "kind", "registers"),
    [
        ("sm_80", Specialisation(False, True, False, "geman_mcclure"), 128),
        ("sm_90", Specialisation(False, False, False, "huber"), 128),
        ("sm_120", Specialisation(True, True, True, "cauchy"), 168),
    ],
)
def test_the_pass_over_the_cells_fits_its_registers(architecture: str, kind: Specialisation, registers: int) -> None:
    found = usage(tile_source([kind]), architecture)
    assert set(found) == set(TILE_KERNELS)
    assert all(used.spilled == 0 and used.stack == 0 for used in found.values())
    # So that four blocks of threads are resident, three where alpha is free.
    assert 32 < found["tile"].registers <= registers
    assert found["tile_large"].registers <= 168


def test_the_other_kernels_neither_spill_nor_ask_for_more_shared_memory_than_every_gpu_has() -> None:
    found = usage(system_source(), "sm_90")
    assert set(found) == set(SYSTEM_KERNELS)
    assert all(used.spilled == 0 and used.shared <= _STATIC_SHARED_BYTES for used in found.values())
    assert max(used.registers for used in found.values()) <= 128


def test_there_is_a_specialisation_for_every_camera_intrinsics_and_robust_kernel() -> None:
    assert len(set(specialisations())) == 6 * 5


def test_compiled_code_is_kept(tmp_path: Path) -> None:
    source = 'extern "C" __global__ void nothing() {}'
    first = compile_kernels(source, "sm_90", cache=tmp_path)
    kept = [path for path in tmp_path.rglob("*") if path.is_file() and path.read_bytes() == bytes(first.code)]
    assert len(kept) == 1
    again = compile_kernels(source, "sm_90", cache=tmp_path)
    assert bytes(again.code) == bytes(first.code)
    compile_kernels(source, "sm_80", cache=tmp_path)
    assert kept[0].exists()


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_without_a_gpu_there_are_no_kernels_and_one_warning(caplog: pytest.LogCaptureFixture) -> None:
    launcher.device_launcher.cache_clear()
    launcher._failed.cache_clear()
    with caplog.at_level(logging.WARNING):
        found = [launcher.device_launcher(0, kind) for kind in list(specialisations())[:3]]
    assert found == [None, None, None]
    assert len(caplog.records) == 1
    launcher.device_launcher.cache_clear()
    launcher._failed.cache_clear()
