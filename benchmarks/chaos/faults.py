"""What is done to a running service, how one sees that it noticed, and when it works again."""

from __future__ import annotations

import os
import random
import signal
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from benchmarks.chaos.world import AGENTS, Process, World


@dataclass(frozen=True, slots=True)
class Kind:
    """One kind of fault.

    Attributes:
        noticed: Part of a message that an agent logs when it has noticed; empty: the fault is meant to go unnoticed.
        working: What works again once it is overcome: `agent` finishes a video, the `api` answers, a shard gets its
            `commit`.
        lasts_s: How long the cause stays.
        by_order: It happens inside of a worker, at the beginning of the next video.
    """

    name: str
    working: str
    noticed: str = ""
    lasts_s: float = 0.0
    by_order: bool = False


KINDS = (
    Kind("segfault", "agent", "the worker died", by_order=True),
    Kind("exception", "agent", "an accident of the chaos run", by_order=True),
    Kind("memory", "agent", "", by_order=True),
    Kind("disk-full", "agent", "storage failed", 5.0, by_order=True),
    Kind("bad-slot", "agent", "this slot is fenced", by_order=True),
    Kind("worker-sigkill", "agent", "the worker died"),
    Kind("worker-sigstop", "agent", "went over its budget"),
    Kind("decoder-sigstop", "agent", ""),
    Kind("ray-head-sigkill", "agent", "Ray's head is gone"),
    Kind("agent-sigkill", "agent", "agent"),
    Kind("agent-freeze", "agent", "the lease of", 20.0),
    Kind("api-sigkill", "api"),
    Kind("database-crash", "commit", "database does not answer", 6.0),
    Kind("s3-down", "commit", "storage_error", 60.0),
    Kind("s3-lost-answers", "commit", "", 12.0),
    Kind("s3-truncated-uploads", "commit", "", 12.0),
    Kind("s3-slow", "commit", "", 12.0),
)


# How long a fault waits for work to break into.
_WAIT_S = 180.0
# Of the requests that a mode of the proxy befalls.
_SHARES = {"down": 1.0, "lost": 0.3, "truncated": 0.5, "slow": 1.0}


@dataclass
class Injected:
    """One fault that happened, and what became of it. Times are unix seconds."""

    kind: Kind
    agent: str
    planned_s: float
    at: float = 0.0
    over: float = 0.0
    noticed: float | None = None
    recovered: float | None = None
    video: str = ""
    lost_videos: int = 0
    lost_s: float = 0.0
    happened: bool = False


def schedule(seed: int, span_s: float) -> list[Injected]:
    """Every kind once, in an order, at times and on agents that the seed decides."""
    rng = random.Random(seed)
    kinds = list(KINDS)
    rng.shuffle(kinds)
    step = span_s / len(kinds)
    return [
        Injected(kind, rng.choice(AGENTS), number * step + rng.uniform(0, 0.6 * step))
        for number, kind in enumerate(kinds)
    ]


@dataclass
class Injector:
    """Carries out one fault at a time; what lasts is ended by a thread."""

    world: World
    victims: set[str] = field(default_factory=set)

    def inject(self, fault: Injected) -> None:
        world, kind = self.world, fault.kind
        fault.at = time.time()
        match kind.name:
            case "worker-sigkill" | "worker-sigstop":
                number = signal.SIGKILL if kind.name == "worker-sigkill" else signal.SIGSTOP
                self._strike(fault, number, world.worker)
            case "decoder-sigstop":
                self._strike(fault, signal.SIGSTOP, world.decoder)
            case "ray-head-sigkill":
                for process in world.head(fault.agent):
                    _kill(process.pid, signal.SIGKILL)
                    fault.happened = True
            case "agent-sigkill":
                world.signal(fault.agent, signal.SIGKILL)
                self._later(fault, 2.0, lambda: world.start_agent(fault.agent))
            case "agent-freeze":
                world.signal(fault.agent, signal.SIGSTOP)
                self._later(fault, kind.lasts_s, lambda: world.signal(fault.agent, signal.SIGCONT))
            case "api-sigkill":
                world.signal("api", signal.SIGKILL)
                self._later(fault, 2.0, world.start_api)
            case "database-crash":
                self._later(fault, kind.lasts_s, world.break_database())
            case "s3-down" | "s3-lost-answers" | "s3-truncated-uploads" | "s3-slow":
                mode = kind.name.split("-")[1]
                world.proxy.modes[mode] = _SHARES[mode]
                world.proxy.slow_s = 0.4
                self._later(fault, kind.lasts_s, lambda: world.proxy.modes.pop(mode))
            case _:
                (world.root / "orders" / f"{kind.name}.{fault.agent}").touch()
                fault.happened = True
        fault.over = fault.over or fault.at

    def _strike(self, fault: Injected, number: int, find: Callable[[str], Process | None]) -> None:
        """Hit a process while it works on a video that nothing has happened to, so that it is not blamed twice.

        Where the agent that was meant has no work for long, for whatever else happened to it, the other is hit.
        """
        began = time.monotonic()
        while (waited_s := time.monotonic() - began) < _WAIT_S:
            if waited_s > _WAIT_S / 4:
                fault.agent = AGENTS[int(waited_s / 5) % len(AGENTS)]
            video = running_video(self.world, fault.agent)
            process = find(fault.agent)
            if video is not None and video not in self.victims and not video.startswith("poison") and process:
                self.victims.add(video)
                fault.video, fault.at, fault.happened = video, time.time(), True
                _kill(process.pid, number)
                return
            time.sleep(0.05)

    def _later(self, fault: Injected, seconds: float, action: Callable[[], object]) -> None:
        fault.happened, fault.over = True, fault.at + seconds

        def run() -> None:
            time.sleep(seconds)
            action()

        threading.Thread(target=run, daemon=True).start()


def running_video(world: World, agent: str) -> str | None:
    """The video that an agent's worker is at: begun in the last seconds and not ended."""
    last = next((line for line in reversed(world.work()) if line["agent"] == agent), None)
    return str(last["video"]) if last is not None and last["event"] == "begin" else None


def _kill(pid: int, number: int) -> None:
    try:
        os.kill(pid, number)
    except ProcessLookupError:
        return
