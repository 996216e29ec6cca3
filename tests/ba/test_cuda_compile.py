"""The CUDA kernels of bundle adjustment through the engine's own compile path, without a GPU.

A sample of specialisations and architectures; `python -m benchmarks.ba_kernels` compiles all of them.
"""

from __future__ import annotations

import logging
from pathlib import Path

import pytest
import torch

from benchmarks.ba_kernels import Usage, faults, usage
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

# Both cameras, one, two and the most intrinsics that there can be, points, every architecture.
_SAMPLE = (
    ("sm_80", Specialisation(True, True, False, "tukey")),
    ("sm_90", Specialisation(False, True, False, "geman_mcclure")),
    ("sm_120", Specialisation(True, True, True, "cauchy", apart=True)),
    ("sm_120", Specialisation(True, True, False, "componentwise", points=True)),
)


@pytest.mark.parametrize(("architecture", "kind"), _SAMPLE)
def test_the_pass_over_the_cells_has_the_registers_it_needs(architecture: str, kind: Specialisation) -> None:
    found = usage(tile_source([kind]), architecture)
    assert set(found) == set(TILE_KERNELS)
    assert {name: faults(name, used, kind) for name, used in found.items()} == {name: [] for name in TILE_KERNELS}
    assert all(used.registers > 32 for used in found.values())


def test_the_other_kernels_neither_spill_nor_ask_for_more_shared_memory_than_every_gpu_has() -> None:
    found = usage(system_source(), "sm_90")
    assert {name: faults(name, used) for name, used in found.items()} == {name: [] for name in SYSTEM_KERNELS}
    assert any(used.shared for used in found.values())


def test_what_is_wrong_with_a_kernel_is_told() -> None:
    kind = Specialisation(True, True, True, "none")
    assert faults("tile", Usage(registers=168, spilled=0, stack=0, shared=0), kind) == []
    assert faults("tile", Usage(registers=169, spilled=0, stack=0, shared=0), kind) == ["2 blocks of threads, not 3"]
    assert len(faults("tile", Usage(registers=256, spilled=4, stack=8, shared=1 << 16), kind)) == 5


def test_there_is_a_specialisation_for_every_camera_intrinsics_robust_kernel_and_points() -> None:
    assert len(set(specialisations())) == (6 + 4) * 7 * 2


def test_compiled_code_is_kept(tmp_path: Path) -> None:
    source = 'extern "C" __global__ void nothing() {}'
    first = compile_kernels(source, "sm_90", cache=tmp_path)
    kept = [path for path in tmp_path.rglob("*") if path.is_file() and path.read_bytes() == bytes(first.code)]
    assert len(kept) == 1
    again = compile_kernels(source, "sm_90", cache=tmp_path)
    assert bytes(again.code) == bytes(first.code)
    compile_kernels(source, "sm_80", cache=tmp_path)
    assert kept[0].exists()


def test_without_a_place_for_compiled_code_it_is_compiled(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "file").touch()
    with caplog.at_level(logging.WARNING):
        found = compile_kernels('extern "C" __global__ void nothing() {}', "sm_90", cache=tmp_path / "file" / "kernels")
    assert len(bytes(found.code)) > 0
    assert "cannot be kept" in caplog.text


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
