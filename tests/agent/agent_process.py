"""An agent as a process of its own with the scripted engine: `python agent_process.py ROOT`; SIGTERM stops it."""

from __future__ import annotations

import signal
import sys
import threading
from pathlib import Path

from services.agent.agent import Agent
from services.agent.config import AgentConfig
from services.agent.ray_executor import RayExecutor
from services.observability.logging import configure_logging
from services.observability.metrics import Metrics
from services.store.sql import SqlStore


def main(root: Path) -> None:
    configure_logging("INFO", "text")
    stop = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    config = AgentConfig(
        scratch_dir=root / "scratch", engine="agent_engines:open_in_process", lease_ttl_s=6.0, poll_s=0.2
    )
    store = SqlStore(f"sqlite:///{root}/vipe.db")
    agent = Agent(store, config, RayExecutor(config), Metrics())
    agent.start()
    stop.wait()
    agent.stop()
    store.close()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
