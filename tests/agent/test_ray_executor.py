"""What the Ray executor decides before it has a process: slots and GPUs, and a start that fails half way."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from services.agent import ray_executor
from services.agent.config import AgentConfig, config_from_settings
from services.agent.ray_executor import RayExecutor
from services.settings import Settings
from vipe_core.errors import ConfigError


@pytest.fixture
def gpus(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The memory of each GPU that PyTorch finds."""
    memory_bytes = [141 * 10**9]
    monkeypatch.setattr(ray_executor, "gpu_memory_bytes", lambda: tuple(memory_bytes))
    monkeypatch.setattr(ray_executor.os, "cpu_count", lambda: 64)
    return memory_bytes


def _slots(executor: RayExecutor) -> int | None:
    return executor._num_slots


def test_slots_are_planned_from_the_memory_of_the_gpus_and_the_preset(tmp_path: Path, gpus: list[int]) -> None:
    config = config_from_settings(Settings(data_dir=tmp_path, device="cuda"))
    assert _slots(RayExecutor(config)) == 8
    gpus.append(24 * 10**9)
    small = RayExecutor(config)
    assert small.shares is not None
    per_gpu = small.shares.plan.per_gpu
    assert 2 <= per_gpu < 8
    assert _slots(small) == 2 * per_gpu
    # The paper's networks take most of a small GPU.
    paper = RayExecutor(replace(config, gpu_preset="vipe"))
    assert paper.shares is not None
    assert paper.shares.plan.per_gpu == 1
    assert _slots(RayExecutor(replace(config, slots_per_gpu=5))) == 10
    assert _slots(RayExecutor(config_from_settings(Settings(data_dir=tmp_path, device="cuda", num_slots=3)))) == 3


def test_without_gpus_there_is_a_slot_per_core(tmp_path: Path) -> None:
    executor = RayExecutor(config_from_settings(Settings(data_dir=tmp_path)))
    assert 1 <= (_slots(executor) or 0) <= 4
    assert executor.shares is None


def test_more_slots_than_fit_are_refused_before_anything_starts(tmp_path: Path, gpus: list[int]) -> None:
    config = AgentConfig(scratch_dir=tmp_path, device="cuda", slots=9)
    with pytest.raises(ConfigError, match="9 slots do not fit on 1 GPUs of 141 GB"):
        RayExecutor(config)
    gpus.clear()
    with pytest.raises(ConfigError, match="no GPU"):
        RayExecutor(replace(config, slots=None))
    with pytest.raises(ValueError, match="unknown preset 'fast'"):
        Settings(data_dir=tmp_path, gpu_preset="fast")


def test_a_start_that_fails_half_way_leaves_nothing_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import ray

    ended = []
    monkeypatch.setattr(ray, "shutdown", lambda: ended.append(True))

    def half(**options: object) -> None:
        Path(str(options["_temp_dir"]), "session").mkdir()
        raise ConnectionError("the head started, its node did not")

    monkeypatch.setattr(ray, "init", half)
    executor = RayExecutor(AgentConfig(scratch_dir=tmp_path / "scratch"))
    for _ in range(2):
        with pytest.raises(ConnectionError):
            executor.start()
        assert executor._temp_dir is not None
        assert not executor._temp_dir.exists()
    assert ended == [True, True]
    assert executor.slots() == []
