"""What the Ray executor decides before it has a process: slots and GPUs, and a start that fails half way."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from services.agent import ray_executor
from services.agent.config import AgentConfig, config_from_settings
from services.agent.ray_executor import RayExecutor, slots_on_this_machine
from services.settings import Settings
from vipe_core.errors import ConfigError


@pytest.fixture
def gpus(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Its only entry is the number of GPUs that PyTorch finds."""
    number = [1]
    monkeypatch.setattr(ray_executor, "count_gpus", lambda: number[0])
    return number


def test_without_a_number_there_is_a_slot_per_gpu(tmp_path: Path, gpus: list[int]) -> None:
    config = config_from_settings(Settings(data_dir=tmp_path, device="cuda"))
    assert slots_on_this_machine(config) == 1
    gpus[0] = 8
    assert slots_on_this_machine(config) == 8
    assert slots_on_this_machine(replace(config, gpus_per_slot=0.5)) == 16
    assert slots_on_this_machine(config_from_settings(Settings(data_dir=tmp_path, device="cuda", num_slots=3))) == 3


def test_without_gpus_there_is_a_slot_per_core(tmp_path: Path, gpus: list[int]) -> None:
    gpus[0] = 0
    assert 1 <= slots_on_this_machine(config_from_settings(Settings(data_dir=tmp_path))) <= 4


def test_more_slots_than_gpus_are_refused_before_anything_starts(tmp_path: Path, gpus: list[int]) -> None:
    config = AgentConfig(scratch_dir=tmp_path, device="cuda", slots=4)
    with pytest.raises(ConfigError, match="4 slots need 4 GPUs, this machine has 1"):
        RayExecutor(config)
    gpus[0] = 0
    with pytest.raises(ConfigError, match="no GPU"):
        RayExecutor(replace(config, slots=None))


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
