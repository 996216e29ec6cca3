"""The agent's threads around the supervisor, without Ray: many slots, cancelled jobs, broken storage, orderly stops."""

from __future__ import annotations

import json
import os
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from agent_rig import Rig

import services.dataset
from services.agent.agent import Agent
from services.agent.backoff import Backoff
from services.agent.config import AgentConfig
from services.agent.executor import Died, SlotHandle
from services.agent.jobs import JobKeeper
from services.agent.leases import LeaseBook, LiveLease, StopReason
from services.agent.messages import Reply, SlotProgress, Task
from services.agent.slot import Slot, SlotConfig
from services.agent.supervisor import Supervisor
from services.commit.protocol import CommitOutcome, PreparedPayload
from services.commit.reconcile import committed_records
from services.domain.errors import StorageError, StoreUnavailable
from services.domain.models import JobSpec, Lease
from services.domain.states import JobState, ShardState
from services.observability.metrics import Metrics
from services.planner import plan_next
from services.storage import open_store
from services.store.sql import SqlStore


class ThreadSlot:
    """A `SlotHandle` whose process is a thread with the real worker code."""

    def __init__(self, config: AgentConfig, executor: ThreadExecutor) -> None:
        self._executor = executor
        self._config = SlotConfig(config.scratch_dir, "cpu", config.engine, None, 1e9)
        self._slot = Slot(self._config)
        self._replies: list[Reply] = []
        self._done = threading.Event()

    @property
    def place(self) -> str:
        return "here/slot-0"

    def start(self, timeout_s: float) -> Died | None:
        if self._executor.lost:
            return Died("there is nothing that could start it")
        self._slot = Slot(self._config)
        return None

    def submit(self, task: Task) -> None:
        self._done = threading.Event()
        done, slot = self._done, self._slot

        def run() -> None:
            self._replies.append(slot.run(task))
            done.set()

        threading.Thread(target=run, daemon=True).start()

    def poll(self, timeout_s: float) -> Reply | Died | None:
        return self._replies.pop() if self._done.wait(timeout_s) else None

    def progress(self) -> SlotProgress:
        return self._slot.progress()

    def cancel(self) -> None:
        self._slot.cancel()

    def kill(self) -> None:
        self._slot.cancel()


class ThreadExecutor:
    def __init__(self, config: AgentConfig) -> None:
        self._config = config
        self.failures = 0
        self.restarts = 0
        self.lost = False
        self.stopped = False
        self.shares = None

    def start(self) -> None:
        if self.failures:
            self.failures -= 1
            raise ConnectionError("no cluster yet")

    def restart(self) -> None:
        self.restarts += 1
        self.lost = False

    def healthy(self) -> bool:
        return True

    def slots(self) -> list[SlotHandle]:
        return [ThreadSlot(self._config, self) for _ in range(self._config.slots)]

    def stop(self) -> None:
        self.stopped = True


class World:
    """A store, an agent on threads, and inputs."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.config = AgentConfig(
            scratch_dir=root / "scratch",
            slots=2,
            engine="agent_engines:open_in_process",
            poll_s=0.05,
            lease_ttl_s=3.0,
            backoff_base_s=0.05,
            backoff_max_s=0.2,
        )
        self.store = SqlStore(f"sqlite:///{root}/vipe.db")
        self.metrics = Metrics()
        self.executor = ThreadExecutor(self.config)
        self.agent = Agent(self.store, self.config, self.executor, self.metrics)

    def submit(self, name: str, scripts: dict[str, str], *, shard_max_videos: int = 2) -> str:
        folder = self.root / name
        folder.mkdir()
        for video, script in scripts.items():
            (folder / f"{video}.mp4").write_text(script)
        return self.store.create_job(
            JobSpec(
                (str(folder),),
                str(self.root / f"{name}-out"),
                attributes=("pose", "intrinsics", "depth"),
                shard_max_videos=shard_max_videos,
            )
        )[0].id

    def wait(self, condition: Callable[[], bool], what: str) -> None:
        deadline = time.monotonic() + 60
        while not condition():
            if time.monotonic() > deadline:
                pytest.fail(f"waited in vain for: {what}")
            time.sleep(0.02)

    def ended(self, job_id: str) -> JobState:
        self.wait(lambda: self.store.get_job(job_id).state.terminal, f"{job_id} to end")
        return self.store.get_job(job_id).state

    def metric(self, name: str, **labels: str) -> float:
        return self.metrics.registry.get_sample_value(name, labels) or 0.0


@pytest.fixture
def world(tmp_path: Path) -> Iterator[World]:
    made = World(tmp_path)
    try:
        yield made
    finally:
        made.agent.stop()
        made.store.close()


def test_jobs_run_side_by_side_and_a_bad_one_harms_nobody(world: World) -> None:
    good = world.submit("good", {f"v{n}": "frames=3" for n in range(7)})
    errors = world.submit("errors", {"a": "error", "b": "frames=2"})
    missing = world.store.create_job(JobSpec((str(world.root / "nowhere"),), str(world.root / "x")))[0].id
    blocked = world.submit("blocked", {"a": "frames=2"})
    (world.root / "blocked-out").write_text("a file where the output folder should be")
    world.agent.start()
    assert world.ended(good) is JobState.SUCCEEDED
    assert world.ended(errors) is JobState.SUCCEEDED_WITH_ERRORS
    assert world.ended(missing) is JobState.FAILED
    assert world.store.get_job(missing).error_code == "input_unavailable"
    keys = Counter(v.key for r in committed_records(open_store(str(world.root / "good-out")), good) for v in r.videos)
    assert len(keys) == 7
    assert set(keys.values()) == {1}
    assert world.metric("vipe_frames_total") == 7 * 3 + 2
    assert world.agent.ready
    world.wait(lambda: world.metric("vipe_actors", role="slot", state="idle") == 2, "both slots to be idle")
    assert world.store.get_job(blocked).state is not JobState.SUCCEEDED


def test_a_paused_job_stops_at_once_keeps_what_is_finished_and_goes_on(world: World, tmp_path: Path) -> None:
    """Within seconds, although the next renewal is far away; no video that was finished is computed again."""
    slow_renewals = replace(world.config, lease_ttl_s=600.0, slots=1)
    world.agent = Agent(world.store, slow_renewals, ThreadExecutor(slow_renewals), world.metrics)
    log = tmp_path / "opened"
    # The first eight shards of a job hold one video each; the last two share the ninth.
    scripts = {
        **{str(n): "frames=2" for n in range(8)},
        "a": f"frames=2 count={log}",
        "b": f"frames=2 slow=30 count={log}",
    }
    job_id = world.submit("job", scripts)
    world.agent.start()
    world.wait(lambda: log.exists() and len(log.read_text().splitlines()) == 2, "the second video to begin")
    paused_s = time.monotonic()
    world.store.request_pause(job_id)
    world.wait(lambda: world.store.list_shards(job_id)[0][8].state is ShardState.PENDING, "the shard to be given back")
    assert time.monotonic() - paused_s < 30
    (world.root / "job" / "b.mp4").write_text("frames=2")
    world.store.resume(job_id)
    assert world.ended(job_id) is JobState.SUCCEEDED
    assert [line.split("-")[0] for line in log.read_text().splitlines()] == ["a", "b"], "a is not computed again"
    rows = world.store.list_videos(job_id)[0]
    assert [row.result.attempt for row in rows if row.result is not None] == [1] * 9 + [2]
    assert world.store.get_job(job_id).slot_seconds > 0


def test_a_cancelled_job_stops_before_its_next_renewal(world: World, tmp_path: Path) -> None:
    slow_renewals = replace(world.config, lease_ttl_s=600.0, slots=1)
    world.agent = Agent(world.store, slow_renewals, ThreadExecutor(slow_renewals), world.metrics)
    log = tmp_path / "opened"
    job_id = world.submit("job", {"a": f"slow=600 count={log}"})
    world.agent.start()
    world.wait(log.exists, "the video to begin")
    world.store.request_cancel(job_id)
    assert world.ended(job_id) is JobState.CANCELLED


def test_a_job_whose_output_is_down_keeps_no_slot_from_the_others(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The older job has more shards than there are slots, and every one of them comes back."""
    broken = world.submit("broken", {f"v{n}": "frames=2" for n in range(12)}, shard_max_videos=1)
    original = world.agent._committer.write

    def write(lease: Lease, payload: PreparedPayload) -> CommitOutcome:
        if lease.job_id == broken:
            raise StorageError("the output does not answer")
        return original(lease, payload)

    monkeypatch.setattr(world.agent._committer, "write", write)
    world.agent.start()
    world.wait(
        lambda: any(e.kind == "shard.released" for e in world.store.events(broken)), "the first shard to be given back"
    )
    good = world.submit("good", {f"v{n}": "frames=2" for n in range(6)}, shard_max_videos=1)
    assert world.ended(good) is JobState.SUCCEEDED
    assert world.store.get_job(broken).state is JobState.RUNNING


def test_rubbish_goes_when_a_job_has_ended(world: World) -> None:
    """A payload that an attempt uploaded before it died, and the half-written file of a writer that died."""
    done, failed = (world.submit(name, {"a": "frames=3"}) for name in ("done", "failed"))
    assert plan_next(world.store, "planner")
    assert plan_next(world.store, "planner")
    leases = world.store.claim("dead agent", limit=2, ttl_s=60)
    for lease in leases:
        output = open_store(lease.spec.output)
        output.put_bytes(
            "_claims/vipe-0badbeef.json", json.dumps({"job_id": lease.job_id, "shard_id": lease.shard_id}).encode()
        )
        output.put_bytes("payload/vipe-0badbeef/pose.tar", b"half of the work")
        temporary = Path(lease.spec.output, "payload", ".vipe-tmp-1-2")
        temporary.write_bytes(b"")
        os.utime(temporary, (0, 0))
        world.store.release(lease.shard_id, lease.fence, "died")
    world.store.fail_job(failed, "storage_refused", "no more space")
    world.agent.start()
    assert world.ended(done) is JobState.SUCCEEDED
    for job_id in (done, failed):
        folder = Path(world.store.get_job(job_id).spec.output, "payload")
        world.wait(lambda at=folder: not (at / "vipe-0badbeef" / "pose.tar").exists(), "the payload to go")
        assert not (folder / ".vipe-tmp-1-2").exists()
    world.wait(lambda: world.store.next_unswept(quiet_s=0) is None, "both to be done with")
    assert len(list(Path(world.store.get_job(done).spec.output, "payload").glob("*/pose.tar"))) == 1


def test_an_output_that_cannot_be_tidied_up_harms_no_job(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object, **__: object) -> None:
        raise StorageError("slow down")

    monkeypatch.setattr("services.commit.gc.collect_garbage", broken)
    job_id = world.submit("job", {"a": "frames=3"})
    world.agent.start()
    assert world.ended(job_id) is JobState.SUCCEEDED
    world.wait(lambda: world.store.next_unswept(quiet_s=0) is None, "nobody to try again")
    assert world.store.get_job(job_id).state is JobState.SUCCEEDED


def test_cancelling_stops_the_work_and_frees_the_slot(world: World) -> None:
    long = world.submit("long", {"a": "slow=300", "b": "slow=300"}, shard_max_videos=1)
    world.agent.start()
    world.wait(lambda: world.metric("vipe_actors", role="slot", state="busy") == 2, "both slots to be busy")
    world.store.request_cancel(long)
    assert world.ended(long) is JobState.CANCELLED
    short = world.submit("short", {"a": "frames=3"})
    assert world.ended(short) is JobState.SUCCEEDED


def test_an_orderly_stop_gives_everything_back_at_once(world: World) -> None:
    job_id = world.submit("long", {f"v{n}": "slow=300" for n in range(3)}, shard_max_videos=1)
    world.agent.start()
    world.wait(lambda: world.metric("vipe_actors", role="slot", state="busy") == 2, "both slots to be busy")
    world.agent.stop()
    assert world.executor.stopped
    states = [shard.state for shard in world.store.list_shards(job_id)[0]]
    assert states == [ShardState.PENDING] * 3
    assert world.store.get_job(job_id).state is JobState.RUNNING


def test_leases_outlive_their_time_only_while_they_are_renewed(world: World) -> None:
    job_id = world.submit("slow", {"a": "slow=5"})
    world.agent.start()
    assert world.ended(job_id) is JobState.SUCCEEDED  # The work takes longer than the lease's time to live.
    (shard,), _ = world.store.list_shards(job_id)
    assert shard.attempts == 1
    assert world.metric("vipe_lease_expired_total") == 0
    assert world.metric("vipe_lease_renew_failures_total") == 0


def test_leases_of_a_dead_agent_are_taken_over(world: World) -> None:
    job_id = world.submit("orphan", {"a": "frames=3"})
    assert plan_next(world.store, "a dead agent")
    (lease,) = world.store.claim("a dead agent", limit=1, ttl_s=0.5)
    world.agent.start()
    assert world.ended(job_id) is JobState.SUCCEEDED
    assert world.metric("vipe_lease_expired_total") == 1
    (record,) = committed_records(open_store(lease.spec.output), job_id)
    assert (record.attempt, record.holder) == (2, world.agent.holder)


def test_an_executor_that_starts_late_and_a_store_that_stumbles_are_waited_for(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    job_id = world.submit("job", {"a": "frames=3"})
    world.executor.failures = 2
    stumbles = iter(range(3))
    claim = world.store.claim

    def stumbling(holder: str, *, limit: int, ttl_s: float) -> object:
        if next(stumbles, None) is not None:
            raise StoreUnavailable("the database is restarting")
        return claim(holder, limit=limit, ttl_s=ttl_s)

    monkeypatch.setattr(world.store, "claim", stumbling)
    world.agent.start()
    assert world.ended(job_id) is JobState.SUCCEEDED


def test_machinery_that_is_lost_is_started_anew(world: World) -> None:
    world.executor.lost = True
    job_id = world.submit("job", {"a": "frames=3"})
    world.agent.start()
    assert world.ended(job_id) is JobState.SUCCEEDED
    assert world.executor.restarts == 1


def test_an_index_that_cannot_be_written_yet_is_written_later(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    job_id = world.submit("job", {"a": "frames=3"})
    stumbles = iter(range(2))
    original = services.dataset.finalise

    def stumbling(*args: object, **options: object) -> object:
        if next(stumbles, None) is not None:
            raise StorageError("slow down")
        return original(*args, **options)

    monkeypatch.setattr(services.dataset, "finalise", stumbling)
    world.agent.start()
    assert world.ended(job_id) is JobState.SUCCEEDED
    world.wait(lambda: world.metric("vipe_stage_duration_seconds_count", stage="finalise") == 1, "the metric behind it")


def test_ten_thousand_failures_in_a_row_are_waited_out() -> None:
    backoff = Backoff(1.0, 60.0, uniform=lambda low, high: high)
    waits = [backoff.failed() for _ in range(10_000)]
    assert waits[:7] == [1, 2, 4, 8, 16, 32, 60]
    assert set(waits[6:]) == {60}


def test_a_thread_that_stumbles_goes_on(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever raises where nobody expects it: the slot, the jobs and the leases are still looked after."""
    stumbles: Counter[str] = Counter()

    def stumbling(name: str, original: Callable[..., object]) -> Callable[..., object]:
        def call(*args: object) -> object:
            if stumbles[name] < 2:
                stumbles[name] += 1
                raise OverflowError("a defect")
            return original(*args)

        return call

    monkeypatch.setattr(Supervisor, "work", stumbling("work", Supervisor.work))
    monkeypatch.setattr(JobKeeper, "step", stumbling("step", JobKeeper.step))
    monkeypatch.setattr(LeaseBook, "renew", stumbling("renew", LeaseBook.renew))
    job_id = world.submit("job", {"a": "frames=3"})
    world.agent.start()
    assert world.ended(job_id) is JobState.SUCCEEDED
    world.wait(lambda: stumbles == {"work": 2, "step": 2, "renew": 2}, "all to have stumbled")


# The book of leases -------------------------------------------------------------------------------------------------


def test_work_stops_before_the_lease_runs_out_when_the_store_is_gone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = Rig.make(tmp_path)
    rig.job({"a": ""})
    live = rig.lease()

    def gone(*_: object, **__: object) -> None:
        raise StoreUnavailable("gone")

    monkeypatch.setattr(rig.store, "renew", gone)
    rig.clock.now_s = rig.config.lease_ttl_s - 1
    rig.book.renew()
    assert live.stop_reason is None
    rig.clock.now_s = rig.config.lease_ttl_s
    rig.book.renew()
    assert live.stop_reason is StopReason.LOST
    assert rig.metric("vipe_lease_renew_failures_total") == 2


def test_a_stolen_lease_is_told_to_stop_and_a_closed_one_is_left_alone(tmp_path: Path) -> None:
    rig = Rig.make(tmp_path)
    rig.job({"a": ""})
    live = rig.lease()
    rig.store.release(live.lease.shard_id, live.lease.fence, "stolen")
    LeaseBook(rig.store, "another", 60.0, rig.metrics).claim(1)
    rig.book.renew()
    assert live.stop_reason is StopReason.LOST
    failures = rig.metric("vipe_lease_renew_failures_total")
    live.close()
    rig.book.renew()
    assert rig.metric("vipe_lease_renew_failures_total") == failures == 1


def test_a_lost_lease_outranks_a_drain() -> None:
    live = LiveLease(None, 0.0)
    live.stop(StopReason.DRAINED)
    live.stop(StopReason.LOST)
    live.stop(StopReason.CANCELLED)
    assert live.stop_reason is StopReason.LOST
