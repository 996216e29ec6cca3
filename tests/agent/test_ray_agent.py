"""The agent on a real private Ray: real worker processes that really die."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from agent_clips import write_assorted_inputs
from agent_rig import Rig

from services.agent.agent import Agent
from services.agent.config import AgentConfig
from services.agent.executor import Died
from services.agent.messages import Annotated, AnnotateVideo, Cancelled, Opened, OpenShard, Reply
from services.agent.ray_executor import RayExecutor, RaySlot, private_temp_dir
from services.agent.ray_health import head_processes
from services.commit.reconcile import committed_records
from services.domain.models import Job, JobSpec, ShardPlan, VideoRef, VideoResult, video_key
from services.domain.states import JobState, VideoStatus
from services.observability.metrics import Metrics
from services.storage import open_store
from services.store.sql import SqlStore

# A worker of Ray's takes seconds to start on an idle machine, half a minute on one that is busy; some tests need five.
pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]

HERE = Path(__file__).parent


@pytest.fixture(autouse=True)
def _engines_importable_in_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", f"{HERE}{os.pathsep}{Path.cwd()}")


def _config(root: Path) -> AgentConfig:
    return AgentConfig(scratch_dir=root / "scratch", engine="agent_engines:open_in_process", poll_s=0.2)


def _wait(condition: Callable[[], bool], what: str, seconds: float = 240.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > deadline:
            pytest.fail(f"waited in vain for: {what}")
        time.sleep(0.1)


def _submit(store: SqlStore, root: Path, *shards: dict[str, str]) -> str:
    """A planned job with these shards."""
    inputs = root / "inputs"
    inputs.mkdir()
    job_id = store.create_job(JobSpec((str(inputs),), str(root / "out"), attributes=("pose", "intrinsics", "depth")))[
        0
    ].id
    fence = store.begin_planning(job_id, "planner", ttl_s=60)
    assert fence is not None
    for ordinal, scripts in enumerate(shards):
        videos = []
        for name, script in scripts.items():
            path = inputs / f"{name}.mp4"
            path.write_text(script)
            videos.append(VideoRef(video_key(str(path)), str(path), len(script)))
        store.add_shards(job_id, fence, [ShardPlan(ordinal, tuple(videos))], ttl_s=60)
    store.finish_planning(job_id, fence)
    return job_id


def _finished(store: SqlStore, job_id: str, seconds: float = 400.0) -> Job:
    _wait(lambda: store.get_job(job_id).state.terminal, f"{job_id} to end", seconds)
    return store.get_job(job_id)


def _rows(root: Path, job_id: str) -> dict[str, VideoResult]:
    """Every committed row by input name; a video that is there twice fails the test."""
    rows = [row for record in committed_records(open_store(str(root / "out")), job_id) for row in record.videos]
    assert max(Counter(row.key for row in rows).values()) == 1
    return {Path(row.uri).stem: row for row in rows}


def _ray_processes(root: Path) -> list[str]:
    """Command lines of live processes that belong to the Ray of the agent in `root`."""
    found = []
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            try:
                environment = (folder / "environ").read_bytes()
                command = (folder / "cmdline").read_bytes().replace(b"\0", b" ").decode()
            except OSError:
                continue
            if f"VIPE_TEST_ROOT={root}".encode() in environment and command:
                found.append(command[:80])
    return found


@pytest.fixture
def slot(tmp_path: Path) -> Iterator[RaySlot]:
    executor = RayExecutor(_config(tmp_path))
    executor.start()
    try:
        (handle,) = executor.slots()
        assert isinstance(handle, RaySlot)
        assert handle.start(240) is None
        yield handle
    finally:
        executor.stop()


def _result(slot: RaySlot) -> Reply | Died:
    outcome = slot.poll(240)
    assert outcome is not None
    return outcome


def test_a_worker_works_reports_stops_and_dies_as_told(slot: RaySlot, tmp_path: Path) -> None:
    rig = Rig.make(tmp_path)
    rig.job({"good": "frames=3", "slow": "slow=60", "die": "die"})
    lease = rig.lease().lease
    good, slow, die = lease.videos

    slot.submit(OpenShard(lease))
    assert isinstance(_result(slot), Reply)
    slot.submit(AnnotateVideo(lease, good))
    reply = _result(slot)
    assert isinstance(reply, Reply)
    assert isinstance(reply.answer, Annotated)
    assert reply.answer.result.num_frames == 3

    slot.submit(AnnotateVideo(lease, slow))
    _wait(lambda: slot.progress().stage == "track", "progress beside the running task")
    assert slot.progress().video_key == slow.key
    slot.cancel()
    reply = _result(slot)
    assert isinstance(reply, Reply)
    assert isinstance(reply.answer, Cancelled)

    first = slot.pid
    slot.submit(AnnotateVideo(lease, die))
    died = _result(slot)
    assert isinstance(died, Died)
    assert not died.preempted
    slot.kill()

    assert slot.start(240) is None
    assert slot.pid not in (None, first)
    slot.submit(OpenShard(lease))
    reply = _result(slot)
    assert isinstance(reply, Reply)
    assert isinstance(reply.answer, Opened)
    assert [result.key for result in reply.answer.results] == [good.key]

    slot.submit(AnnotateVideo(lease, slow))
    pid = slot.pid
    assert pid is not None
    slot.kill()
    _wait(lambda: not Path(f"/proc/{pid}").exists(), "the killed worker to be gone", 60)


def test_deaths_and_poison_leave_the_others_unharmed(tmp_path: Path) -> None:
    store, metrics, config = SqlStore(f"sqlite:///{tmp_path}/vipe.db"), Metrics(), _config(tmp_path)
    executor = RayExecutor(config)
    agent = Agent(store, config, executor, metrics)
    count = tmp_path / "count"
    job_id = _submit(
        store,
        tmp_path,
        {
            "a": f"frames=3 count={count}",
            "b-shot": f"slow=2 count={count}",
            "c-poison": f"die count={count}",
            "d": f"frames=4 count={count}",
            "e-corrupt": "error",
        },
    )
    agent.start()
    try:
        # kill -9 of the worker while it works on the second video.
        _wait(lambda: count.exists() and "b-shot" in count.read_text(), "the second video to begin")
        (handle,) = executor.slots()
        assert isinstance(handle, RaySlot)
        assert handle.pid is not None
        os.kill(handle.pid, signal.SIGKILL)
        job = _finished(store, job_id)
    finally:
        agent.stop()
        store.close()
    rows = _rows(tmp_path, job_id)
    assert job.state is JobState.SUCCEEDED_WITH_ERRORS
    assert {name: row.status for name, row in rows.items()} == {
        "a": VideoStatus.SUCCEEDED,
        "b-shot": VideoStatus.SUCCEEDED,
        "c-poison": VideoStatus.QUARANTINED,
        "d": VideoStatus.SUCCEEDED,
        "e-corrupt": VideoStatus.FAILED,
    }
    tried = Counter(line.rsplit("-", 1)[0] for line in count.read_text().split())
    assert tried == {"a": 1, "b-shot": 2, "c-poison": 3, "d": 1}
    assert metrics.registry.get_sample_value("vipe_actor_restarts_total", {"reason": "died"}) == 4
    assert metrics.registry.get_sample_value("vipe_videos_total", {"outcome": "succeeded", "error_class": ""}) == 3
    assert (tmp_path / "out" / "dataset.json").exists()


def test_the_loss_of_the_head_costs_the_running_video_and_blames_nobody(tmp_path: Path) -> None:
    victims = {"gcs_server", "raylet"}
    store, metrics, config = SqlStore(f"sqlite:///{tmp_path}/vipe.db"), Metrics(), _config(tmp_path)
    agent = Agent(store, config, RayExecutor(config), metrics)
    count = tmp_path / "count"
    scripts = {"a": f"frames=3 count={count}", "b": f"frames=3 slow=4 count={count}", "c": f"frames=3 count={count}"}
    job_id = _submit(store, tmp_path, scripts)
    agent.start()
    try:
        _wait(lambda: count.exists() and "b-" in count.read_text(), "the second video to begin")
        ray_dir = private_temp_dir(config.scratch_dir.parent)
        heads = [pid for pid in head_processes(ray_dir) if Path(f"/proc/{pid}/comm").read_text().strip() in victims]
        assert len(heads) == len(victims)
        for pid in heads:
            os.kill(pid, signal.SIGKILL)
        job = _finished(store, job_id)
    finally:
        agent.stop()
        store.close()
    assert job.state is JobState.SUCCEEDED
    assert {row.status for row in _rows(tmp_path, job_id).values()} == {VideoStatus.SUCCEEDED}
    tried = Counter(line.rsplit("-", 1)[0] for line in count.read_text().split())
    assert tried == {"a": 1, "b": 2, "c": 1}
    assert not [e for e in store.events(job_id) if e.kind == "video.blamed"]
    assert metrics.registry.get_sample_value("vipe_executor_restarts_total") == 1


@pytest.mark.long
def test_kill_9_of_the_agent_loses_and_doubles_nothing(tmp_path: Path) -> None:
    store = SqlStore(f"sqlite:///{tmp_path}/vipe.db")
    count = tmp_path / "count"
    names = [f"v{number}" for number in range(8)]
    scripts = dict.fromkeys(names, f"frames=3 slow=0.5 count={count}")
    job_id = _submit(store, tmp_path, {n: scripts[n] for n in names[:4]}, {n: scripts[n] for n in names[4:]})
    environment = {**os.environ, "VIPE_TEST_ROOT": str(tmp_path)}

    def run() -> subprocess.Popen[bytes]:
        log = (tmp_path / "agent.log").open("ab")
        return subprocess.Popen(
            [sys.executable, str(HERE / "agent_process.py"), str(tmp_path)], stdout=log, stderr=log, env=environment
        )

    first = run()
    # One shard committed, the other in its middle.
    _wait(lambda: count.exists() and len(count.read_text().split()) >= 6, "the second shard to be under way")
    first.send_signal(signal.SIGKILL)
    first.wait()
    assert store.get_job(job_id).progress.shards_committed == 1
    _wait(lambda: not any("ray::" in c and "Slot" in c for c in _ray_processes(tmp_path)), "the worker to die", 60)

    second = run()
    try:
        job = _finished(store, job_id)
    finally:
        second.send_signal(signal.SIGTERM)
        second.wait(120)
    assert second.returncode == 0
    assert job.state is JobState.SUCCEEDED
    assert {row.status for row in _rows(tmp_path, job_id).values()} == {VideoStatus.SUCCEEDED}
    tried = Counter(line.rsplit("-", 1)[0] for line in count.read_text().split())
    # What was committed or finished is not done again; at most the video that was running at the kill is.
    assert set(tried) == set(scripts)
    assert all(tried[name] == 1 for name in names[:4])
    assert sum(tried.values()) <= len(names) + 1
    store.close()


@pytest.mark.long
def test_the_real_engine_on_what_users_drop_into_a_folder(tmp_path: Path) -> None:
    """One clip that works beside a cut one, an empty one, a text, one picture and a sound: a row for each."""
    write_assorted_inputs(tmp_path / "inputs")
    store, metrics = SqlStore(f"sqlite:///{tmp_path}/vipe.db"), Metrics()
    config = AgentConfig(scratch_dir=tmp_path / "scratch", poll_s=0.2)
    agent = Agent(store, config, RayExecutor(config), metrics)
    job_id = store.create_job(JobSpec((str(tmp_path / "inputs"),), str(tmp_path / "out")))[0].id
    agent.start()
    try:
        job = _finished(store, job_id, 240)
    finally:
        agent.stop()
        store.close()
    rows = _rows(tmp_path, job_id)
    assert job.state is JobState.SUCCEEDED_WITH_ERRORS
    assert {name: row.error_code for name, row in rows.items()} == {
        "good": None,
        "one-frame": None,
        "corrupt": "media_corrupt",
        "empty": "media_empty",
        "text": "media_corrupt",
        "audio": "no_video_stream",
    }
    good = rows["good"]
    assert (good.num_frames, good.width, good.height, good.camera_model) == (16, 128, 96, "pinhole")
    assert good.quality is not None
    assert good.provenance is not None
    assert good.timings_s is not None
    assert rows["one-frame"].quality is not None
    assert "few_frames" in rows["one-frame"].quality["reasons"]
    assert all(name in str(rows[name].error_message) for name in ("corrupt", "empty", "text", "audio"))
    assert (tmp_path / "out" / "meta.parquet").exists()
    assert not list((tmp_path / "scratch").glob("job_*"))


def test_slots_share_a_gpu_and_a_large_video_gets_more_of_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Real workers with parts of a GPU that Ray only counts; its memory is told in the one place that asks for it."""
    monkeypatch.setattr("services.agent.ray_executor.gpu_memory_bytes", lambda: (24 * 10**9,))
    config = replace(_config(tmp_path), device="cuda", slots=None, slots_per_gpu=2)
    executor = RayExecutor(config)
    log = tmp_path / "log"
    store = SqlStore(f"sqlite:///{tmp_path}/vipe.db")
    agent = Agent(store, config, executor, Metrics())
    agent.start()
    try:
        small = f"gpu-log={log} slow=1"
        job_id = _submit(store, tmp_path, {"a": small, "large": f"gpu-log={log} planned=15"}, {"b": small, "c": small})
        assert _finished(store, job_id).state is JobState.SUCCEEDED
        handles = executor.slots()
        assert len(handles) == 2
        assert len({handle.place for handle in handles}) == 1
        assert handles[0].place.endswith("/gpu-0")
    finally:
        agent.stop()
        store.close()
    assert {row.status for row in _rows(tmp_path, job_id).values()} == {VideoStatus.SUCCEEDED}
    granted = [line.split("(")[1] for line in log.read_text().splitlines() if line.startswith("large-")]
    assert executor.shares is not None
    plan = executor.shares.plan
    assert granted == [f"{plan.bytes_of(1)}, False)", f"{plan.bytes_of(2)}, False)"]
    assert plan.bytes_of(1) < 15e9 < plan.bytes_of(2)
