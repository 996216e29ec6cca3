"""Slots that share a GPU: how many there are, what a video may take of it, and what happens when that is too little."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path

import pytest
from agent_rig import Rig
from hypothesis import given
from hypothesis import strategies as st

from services.agent.gpus import GpuShares, SlotPlan, Want, plan_slots
from services.agent.leases import StopReason
from services.domain.states import VideoStatus
from vipe_core.errors import ConfigError

GB = 10**9
# Four slots on a GPU: 5 GB each, of which one keeps 1 GB when it has nothing to do.
FOUR = SlotPlan(4, 20 * GB, GB)


def plan(*memory_gb: float, **wanted: int) -> SlotPlan:
    return plan_slots([int(gb * GB) for gb in memory_gb], usual_bytes=5 * GB, idle_bytes=GB, **wanted)


def test_as_many_slots_share_a_gpu_as_usual_videos_fit_in_the_smallest() -> None:
    assert plan(24).per_gpu == 4
    assert plan(80, 24).per_gpu == 4
    assert plan(80).per_gpu == 8
    assert plan(4).per_gpu == 1  # a video that does not fit says so itself
    assert plan(80, 80, cores=6).per_gpu == 3
    assert plan(80, cores=1).per_gpu == 1


def test_what_is_asked_for_comes_first_and_is_refused_where_it_does_not_fit() -> None:
    assert plan(24, per_gpu=2).per_gpu == 2
    assert plan(24, per_gpu=6).per_gpu == 6
    assert plan(80, 80, slots=6).per_gpu == 3  # fewer than fit have more memory each
    assert plan(80, 80, slots=3, per_gpu=4).per_gpu == 4
    with pytest.raises(ConfigError, match=r"9 slots do not fit on 2 GPUs of 24 GB.*5\.0 GB.*set the number.*to 8"):
        plan(24, 24, slots=9)


@given(st.integers(1, 64), st.integers(1, 200), st.integers(0, 4))
def test_shares_of_a_gpu_never_sum_to_more_than_it_has(per_gpu: int, usable_gb: int, idle_gb: int) -> None:
    found = SlotPlan(per_gpu, usable_gb * GB, idle_gb * GB)
    assert 0 < per_gpu * found.gpus_per_slot <= 1
    assert per_gpu * found.bytes_of(1) <= found.usable_bytes
    whole = found.bytes_of(per_gpu) + (per_gpu - 1) * found.idle_bytes
    assert whole <= max(found.usable_bytes, (per_gpu - 1) * found.idle_bytes)


def test_too_little_memory_is_answered_with_the_low_memory_profile_and_then_with_more_of_the_gpu() -> None:
    low = FOUR.wider(Want(), None)
    assert low == Want(1, low_memory=True)
    assert FOUR.wider(low, None) == Want(2, low_memory=True)
    assert FOUR.wider(Want(4, low_memory=True), None) is None
    # What is planned to need 12 GB goes to where that is: 15 GB of three shares, less what two idle slots keep.
    assert FOUR.wider(Want(), 12 * GB) == Want(3)
    assert FOUR.wider(Want(), 18 * GB) is None
    # Shares that only pay for the idle slots are not worth waiting for.
    assert SlotPlan(4, 20 * GB, 5 * GB).wider(Want(1, low_memory=True), None) is None


def test_who_wants_more_of_a_gpu_waits_for_the_others_and_they_for_him() -> None:
    shares, order = GpuShares(FOUR), []
    inside, done = [threading.Event() for _ in range(3)], [threading.Event() for _ in range(3)]
    waiting = [threading.Event() for _ in range(3)]

    def work(number: int, place: str, wanted: int) -> None:
        with shares.held(place, wanted, waiting[number].set):
            order.append(number)
            inside[number].set()
            assert done[number].wait(10)

    threads = [threading.Thread(target=work, args=arguments) for arguments in ((0, "a", 2), (1, "a", 3), (2, "a", 1))]
    threads[0].start()
    assert inside[0].wait(10)
    threads[1].start()
    assert waiting[1].wait(10)
    threads[2].start()  # there is room for it, but it would starve who came before
    assert waiting[2].wait(10)
    with shares.held("b", 4, lambda: pytest.fail("another GPU is free")):
        done[0].set()
        assert inside[1].wait(10)
        assert inside[2].wait(10)
    for event in done[1:]:
        event.set()
    for thread in threads:
        thread.join(10)
    assert order == [0, 1, 2]


def test_a_wait_ends_with_what_it_waits_for() -> None:
    shares = GpuShares(FOUR)

    def stop() -> None:
        raise KeyboardInterrupt

    with shares.held("a", 4, stop), pytest.raises(KeyboardInterrupt), shares.held("a", 1, stop):
        pass
    with shares.held("a", 4, stop):
        pass


@pytest.fixture
def rig(tmp_path: Path) -> Rig:
    return Rig.make(tmp_path, GpuShares(FOUR))


def grants(rig: Rig) -> Callable[[str], list[str]]:
    lines = (rig.root / "log").read_text().splitlines()
    return lambda name: [line.split(" ", 1)[1] for line in lines if line.startswith(f"{name}-")]


def test_a_video_that_runs_out_of_memory_gets_the_low_memory_profile_and_a_fresh_process(rig: Rig) -> None:
    log = f"gpu-log={rig.root / 'log'}"
    rig.job({"a": f"{log} needs=1/1", "b": f"{log} needs=8/4", "c": f"{log} needs=1/1"})
    live = rig.lease()
    assert rig.supervisor.work(live).kind == "committed"
    assert {row.status for row in rig.rows(live).values()} == {VideoStatus.SUCCEEDED}
    seen = grants(rig)
    assert seen("b") == [f"({5 * GB}, False)", f"({5 * GB}, True)"]
    assert seen("c") == [f"({5 * GB}, False)"]  # nobody else pays for it
    assert rig.metric("vipe_actor_restarts_total", reason="device_memory") == 1
    assert rig.slot.starts == 2


def test_a_video_that_needs_more_than_a_share_waits_for_the_gpu_and_one_that_needs_more_than_that_fails(
    rig: Rig,
) -> None:
    log = f"gpu-log={rig.root / 'log'}"
    rig.job({"large": f"{log} planned=16", "huge": f"{log} planned=30", "odd": f"{log} needs=40/40"})
    live = rig.lease()
    assert rig.supervisor.work(live).kind == "committed"
    rows, seen = rig.rows(live), grants(rig)
    assert rows["large"].status is VideoStatus.SUCCEEDED
    assert seen("large") == [f"({5 * GB}, False)", f"({17 * GB}, False)"]
    assert seen("huge") == [f"({5 * GB}, False)"]
    assert [line.split(",")[0] for line in seen("odd")] == [f"({gb * GB}" for gb in (5, 5, 9, 13, 17)]
    for name in ("huge", "odd"):
        assert (rows[name].status, rows[name].error_code) == (VideoStatus.FAILED, "device_memory")
        assert rows[name].error_message
    assert rig.metric("vipe_actor_restarts_total", reason="device_memory") == 5
    assert not rig.metric("vipe_actor_restarts_total", reason="died")


def test_a_lease_that_is_stopped_does_not_wait_for_a_gpu(rig: Rig) -> None:
    rig.job({"a": "frames=3"})
    live = rig.lease()
    assert rig.shares is not None
    with rig.shares.held(rig.slot.place, 4, lambda: None):
        live.stop(StopReason.DRAINED)
        outcome = rig.supervisor.work(live)
    assert (outcome.kind, outcome.reason) == ("stopped", StopReason.DRAINED)
    assert rig.slot.annotated() == []
