"""`python -m services.agent`: an agent alone, beside a database, an output and perhaps a Ray cluster.

Settings come from the environment (`VIPE_DATABASE_URL`, `VIPE_RAY_ADDRESS`, ...; see `services.settings`). SIGTERM and
SIGINT give unfinished shards back and end every process that was started.
"""

from __future__ import annotations

import argparse
import logging
import signal
import sys
import threading
from collections.abc import Sequence

from services.agent.open import open_agent
from services.observability.logging import configure_logging
from services.observability.metrics import Metrics
from services.settings import Settings
from services.store.sql import SqlStore

logger = logging.getLogger(__name__)


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m services.agent", description="Run one agent.")
    parser.add_argument("--metrics-host", default="0.0.0.0", help="address of GET /metrics")
    parser.add_argument("--metrics-port", type=int, default=9464, help="port of GET /metrics; 0 takes a free one")
    parser.add_argument("--log-format", choices=["json", "text"], default="json")
    parser.add_argument("--log-level", default="INFO")
    arguments = parser.parse_args(argv)

    configure_logging(arguments.log_level, arguments.log_format)
    settings, metrics = Settings(), Metrics()
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    server, _ = metrics.serve(arguments.metrics_port, arguments.metrics_host)
    logger.info("metrics on port %d", server.server_port)
    store = SqlStore(settings.database_url)
    agent = open_agent(store, settings, metrics)
    agent.start()
    try:
        stop.wait()
    finally:
        agent.stop()
        store.close()
        server.shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
