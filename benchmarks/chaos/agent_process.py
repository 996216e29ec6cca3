"""One agent of the chaos run, as a process: `python -m benchmarks.chaos.agent_process DATABASE_URL SCRATCH`.

It is `vipectl agent` with short patience and with the engine that has accidents.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from pathlib import Path

from benchmarks.chaos.engine import AGENT_VARIABLE
from services.agent.agent import Agent
from services.agent.config import AgentConfig
from services.agent.ray_executor import RayExecutor
from services.observability.logging import configure_logging
from services.observability.metrics import Metrics
from services.store.sql import open_when_ready

LEASE_TTL_S = 12.0
VIDEO_BUDGET_S = 30.0


def main(database_url: str, scratch: Path) -> None:
    configure_logging("INFO", "json")
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    config = AgentConfig(
        scratch_dir=scratch,
        engine="benchmarks.chaos.engine:open_with_accidents",
        lease_ttl_s=LEASE_TTL_S,
        poll_s=0.5,
        video_budget_base_s=VIDEO_BUDGET_S,
        video_budget_per_frame_s=0.0,
        start_timeout_s=90.0,
        fence_cooloff_s=8.0,
        backoff_base_s=0.5,
        backoff_max_s=5.0,
        recycle_videos=12,
        s3_endpoint_url=os.environ["VIPE_S3_ENDPOINT_URL"],
    )
    store = open_when_ready(database_url)
    agent = Agent(store, config, RayExecutor(config), Metrics())
    agent.start()
    print(f"agent {os.environ[AGENT_VARIABLE]} is {agent.holder}", flush=True)
    stop.wait()
    agent.stop()
    store.close()


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
