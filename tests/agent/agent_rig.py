"""What the agent's tests share: a real store and output, leases of small jobs, and an executor without processes."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from agent_engines import ProcessDeath, ProcessHang

from services.agent.backoff import GiveBacks
from services.agent.commits import Committer
from services.agent.config import AgentConfig
from services.agent.executor import Died
from services.agent.gpus import GpuShares
from services.agent.leases import LeaseBook, LiveLease
from services.agent.messages import AnnotateVideo, Cancelled, Reply, SlotProgress, Task
from services.agent.slot import Slot, SlotConfig
from services.agent.supervisor import Supervisor
from services.commit.reconcile import committed_record
from services.domain.models import CommitRecord, JobSpec, ShardPlan, VideoRef, VideoResult, video_key
from services.observability.metrics import Metrics
from services.storage import open_store
from services.store.sql import SqlStore


class FakeClock:
    """Seconds that pass only when somebody waits."""

    def __init__(self) -> None:
        self.now_s = 0.0

    def __call__(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds


class MemorySlot:
    """A `SlotHandle` that runs the real worker code in this process; deaths and hangs are exceptions of the engine."""

    def __init__(self, config: AgentConfig, clock: FakeClock) -> None:
        self._config = SlotConfig(config.scratch_dir, "cpu", config.engine, None, 1e9)
        self._clock = clock
        self._slot: Slot | None = None
        self._outcome: Reply | Died | None = None
        self.starts = 0
        self.start_failures = 0
        self.tasks: list[Task] = []
        self.before_poll: list[object] = []
        self.dies_idle = False
        self.obeys_cancel = True
        self.where = "here/slot-0"

    @property
    def place(self) -> str:
        return self.where

    def start(self, timeout_s: float) -> Died | None:
        if self.start_failures:
            self.start_failures -= 1
            return Died("no")
        self.starts += 1
        self._slot = Slot(self._config)
        return None

    def submit(self, task: Task) -> None:
        assert self._slot is not None
        assert self._outcome is None
        self.tasks.append(task)
        if self.dies_idle:
            self.dies_idle = False
            self._outcome = Died("gone while it was idle")
            return
        try:
            self._outcome = self._slot.run(task)
        except ProcessDeath:
            self._outcome = Died("segmentation fault")
        except ProcessHang:
            self._outcome = None

    def poll(self, timeout_s: float) -> Reply | Died | None:
        if self.before_poll:
            hook = self.before_poll.pop(0)
            if callable(hook):
                hook()
        outcome, self._outcome = self._outcome, None
        if outcome is None:
            self._clock.sleep(timeout_s)
        return outcome

    def progress(self) -> SlotProgress:
        return SlotProgress()

    def cancel(self) -> None:
        if self.obeys_cancel:
            self._outcome = Reply(Cancelled())

    def kill(self) -> None:
        self._slot = self._outcome = None

    def annotated(self) -> list[str]:
        """Names of the inputs handed over so far, without the hash."""
        return [t.video.key.rsplit("-", 1)[0] for t in self.tasks if isinstance(t, AnnotateVideo)]


@dataclass
class Rig:
    """One agent's parts around a store in `root`, with the agent's own threads left out."""

    root: Path
    config: AgentConfig
    store: SqlStore
    shares: GpuShares | None = None
    clock: FakeClock = field(default_factory=FakeClock)
    metrics: Metrics = field(default_factory=Metrics)

    @classmethod
    def make(cls, root: Path, shares: GpuShares | None = None, **settings: object) -> Rig:
        settings.setdefault("backoff_base_s", 0.0)  # A shard that was given back can be leased again at once.
        config = AgentConfig(
            scratch_dir=root / "scratch",
            engine="agent_engines:open_in_memory",
            lease_ttl_s=60.0,
            **settings,
        )
        return cls(root, config, SqlStore(f"sqlite:///{root}/vipe.db"), shares)

    def __post_init__(self) -> None:
        self.slot = MemorySlot(self.config, self.clock)
        self.committer = Committer(self.store, self.metrics)
        self.give_backs = GiveBacks(self.config.max_give_backs)
        self.book = LeaseBook(self.store, self.config.holder, self.config.lease_ttl_s, self.metrics, self.clock)
        self.supervisor = Supervisor(
            self.slot,
            self.store,
            self.committer,
            self.give_backs,
            self.config,
            self.metrics,
            self.clock,
            self.clock.sleep,
            self.shares,
        )

    def job(self, scripts: dict[str, str], *, preset: str = "classical", create_once: bool = True) -> str:
        """A planned job of one shard, one "video" for each name and script; its id."""
        inputs = self.root / "inputs"
        inputs.mkdir(exist_ok=True)
        videos = []
        for name, script in scripts.items():
            path = inputs / f"{name}.mp4"
            path.write_text(script)
            videos.append(VideoRef(video_key(str(path)), str(path), path.stat().st_size))
        spec = JobSpec(
            (str(inputs),), str(self.root / "out"), preset=preset, attributes=("pose", "intrinsics", "depth")
        )
        job, _ = self.store.create_job(spec)
        fence = self.store.begin_planning(job.id, "planner", ttl_s=60)
        assert fence is not None
        self.store.settle_commit_point(job.id, fence, create_once)
        self.store.add_shards(job.id, fence, [ShardPlan(0, tuple(videos))], ttl_s=60)
        self.store.finish_planning(job.id, fence)
        return job.id

    def lease(self) -> LiveLease:
        (live,) = self.book.claim(1)
        return live

    def record(self, live: LiveLease) -> CommitRecord | None:
        lease = live.lease
        return committed_record(open_store(lease.spec.output), lease.job_id, lease.shard_id)

    def rows(self, live: LiveLease) -> dict[str, VideoResult]:
        """Committed rows by input name."""
        record = self.record(live)
        assert record is not None
        return {Path(row.uri).stem: row for row in record.videos}

    def metric(self, name: str, **labels: str) -> float:
        return self.metrics.registry.get_sample_value(name, labels) or 0.0
