"""What presets take of a GPU by plan, which profile a video gets, and what is said where none fits."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from vipe_core.annotation import Annotation
from vipe_core.ba.problem import Grid
from vipe_core.errors import OutOfDeviceMemory
from vipe_core.pipeline.annotator import Annotator
from vipe_core.pipeline.memory import MemoryBudget, idle_bytes, plan_of, usual_bytes
from vipe_core.pipeline.presets import PRESETS, Preset, PresetOptions, resolve
from vipe_core.priors.droid import DroidNetwork

GB = 10**9
GRID = Grid(48, 64, 8.0, 4.0)
FAST = resolve("vipe_fast")
# The whole of it, as short and as small as it goes.
_SCHEDULE = replace(
    FAST.slam.refinement, first_updates=1, updates=1, more_updates=1, global_updates=(1, 1, 2), fill_updates=1
)
TINY = replace(
    resolve("pose_only"), slam=replace(FAST.slam, working_area_px=64 * 48, refinement=_SCHEDULE, backend_at=())
)


@given(st.integers(2, 60), st.integers(2, 80), st.integers(1, 5000), st.integers(1, 500))
def test_the_low_memory_profile_takes_less_and_more_keyframes_take_more(
    height: int, width: int, keyframes: int, more: int
) -> None:
    grid = Grid(height, width, 8.0, 4.0)
    full, low = (plan_of(FAST, grid, keyframes, lean=lean).total_bytes for lean in (False, True))
    assert low < full
    assert plan_of(FAST, grid, keyframes + more, lean=False).total_bytes > full
    assert plan_of(FAST, grid, keyframes + more, lean=True).total_bytes > low


def test_presets_are_planned_by_what_they_hold() -> None:
    needs = {name: usual_bytes(resolve(name)) for name in PRESETS}
    assert needs["classical"] < needs["pose_only"] == needs["vipe_fast"] < needs["vipe"]
    masks = resolve("classical", options=PresetOptions(phrases=("person",)))
    assert usual_bytes(masks) > needs["classical"] + GB
    assert needs["vipe"] - needs["pose_only"] > idle_bytes(resolve("vipe")) - idle_bytes(FAST) > 3 * GB
    # 25 MB of volumes for an edge at 512 x 384, and all states of the graph, are what the profile saves.
    many = [plan_of(FAST, GRID, 1500, lean=lean) for lean in (False, True)]
    assert many[0].graph_bytes - many[1].graph_bytes > 6000 * GRID.num_cells * 250
    assert many[0].total_bytes < 24 * GB
    assert many[1].total_bytes < 0.7 * many[0].total_bytes


def test_a_budget_chooses_the_profile_by_the_number_of_keyframes_and_names_what_is_missing() -> None:
    full, low = (plan_of(FAST, GRID, 200, lean=lean).total_bytes for lean in (False, True))
    assert not MemoryBudget(FAST, None).fit("clip", GRID, 10**6)
    assert MemoryBudget(FAST, None, lean=True).fit("clip", GRID, 1)
    budget = MemoryBudget(FAST, full)
    assert not budget.fit("clip", GRID, 200)
    assert budget.fit("clip", GRID, 201)
    assert budget.fit("clip", GRID, 10)  # once begun so, it goes on so
    with pytest.raises(OutOfDeviceMemory, match=r"clip: 200 keyframes.*GB.*larger GPU.*split the video") as caught:
        MemoryBudget(FAST, low - 1).fit("clip", GRID, 200)
    assert caught.value.needed_bytes == low
    assert caught.value.retryable


Annotate = Callable[..., Annotation]


@pytest.fixture(scope="module")
def annotate(tmp_path_factory: pytest.TempPathFactory) -> Annotate:
    """The whole pipeline with random weights on a tiny clip that pans over noise."""
    root = tmp_path_factory.mktemp("droid")
    torch.save(DroidNetwork.random(1).state_dict(), root / "droid.pth")
    clip = root / "clip"
    clip.mkdir()
    noise = np.random.default_rng(0).integers(0, 256, (12, 30, 3), dtype=np.uint8)
    wide = cv2.resize(noise, None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC)
    for index in range(6):
        cv2.imwrite(str(clip / f"{index}.png"), wide[:, 5 * index : 5 * index + 64])
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv("VIPE_WEIGHTS", str(root))
        warm = Annotator(TINY)
    return lambda **how: warm.annotate(clip, **how)


def _plan(preset: Preset, keyframes: int, *, lean: bool) -> int:
    return plan_of(preset, Grid(6, 8, 8.0, 4.0), keyframes, lean=lean).total_bytes


def test_a_clip_gets_the_profile_that_fits_and_says_so_and_every_stage_is_timed(annotate: Annotate) -> None:
    full = annotate()
    assert full.provenance.memory_profile == "full"
    assert full.provenance.weights
    assert {"scan", "intrinsics", "track", "backend", "infill", "scale"} <= full.timings_s.keys()
    assert sum(1 for _ in full.dense()) == full.num_frames
    assert list(full.timings_s)[-1] == "depth"
    assert full.peak_bytes == {}
    low = annotate(memory_bytes=_plan(TINY, 2, lean=False))
    assert low.provenance.memory_profile == "low"
    assert np.isfinite(low.world_from_cam).all()
    assert len(low.keyframes) == len(full.keyframes) > 3
    with pytest.raises(OutOfDeviceMemory):
        annotate(memory_bytes=_plan(TINY, 2, lean=True) // 2)


def test_memory_that_runs_out_in_the_work_is_a_typed_error(annotate: Annotate, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB")

    monkeypatch.setattr(DroidNetwork, "step", full)
    with pytest.raises(OutOfDeviceMemory, match="clip: the GPU's memory ran out") as caught:
        annotate()
    assert caught.value.needed_bytes is None
