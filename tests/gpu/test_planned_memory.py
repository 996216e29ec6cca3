"""The plan of a GPU's memory against the bytes that tensors hold on a claimed one."""

from __future__ import annotations

import pytest
import torch

from benchmarks.claimed_gpu import claimed_gpu
from benchmarks.gpu_memory import _held, _refining
from vipe_core.ba.problem import Grid
from vipe_core.pipeline.device import limit_memory, resolve_device
from vipe_core.priors.droid.memory import plan_memory

pytestmark = pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")


def test_bytes_are_counted_once_for_all_that_share_them_and_until_nobody_has_them() -> None:
    with claimed_gpu():
        empty = torch.cuda.memory_allocated()
        whole = torch.zeros(1000, device="cuda")
        part = whole[10:].view(99, 10)
        assert torch.cuda.memory_allocated() - empty == 4096
        del whole
        assert torch.cuda.memory_allocated() - empty == 4096
        torch.cuda.reset_peak_memory_stats()
        _ = part + 1
        del part, _
        assert torch.cuda.memory_allocated() == empty
        assert torch.cuda.max_memory_allocated() - empty == 2 * 4096


@pytest.mark.parametrize("name", ["cuda", "cuda:0"])
def test_a_process_is_held_to_its_part_of_a_gpu_however_that_is_named(name: str) -> None:
    with claimed_gpu():
        device = resolve_device(name)
        assert device == torch.zeros(1, device=device).device
        for size_bytes in (0, 10 << 30, 1 << 40):
            limit_memory(device, size_bytes)


def test_no_more_is_held_than_planned_and_not_much_less() -> None:
    grid, edges = Grid(4, 6, 8.0, 4.0), 48
    pairs = [(i, j) for i in range(12) for j in range(12) if 0 < abs(i - j) <= 2][:edges]
    plan = plan_memory(
        grid,
        keyframes=0,
        window_edges=1 << 20,
        edges_per_keyframe=0,
        most_edges=0,
        fill_frames=0,
        cache_bytes=0,
        lean=False,
    )
    held_bytes = _held(grid, _refining(grid, pairs, lean=False))
    assert 0.6 < held_bytes / (len(pairs) * plan.work_bytes / (1 << 20)) <= 1
