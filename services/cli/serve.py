"""`vipectl up | api | agent`: the service as one process, or its two halves."""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from services.cli.engine_options import DEVICE_HELP
from services.cli.settings import Database, settings_from

if TYPE_CHECKING:
    from services.agent.agent import Agent
    from services.observability.metrics import Metrics
    from services.settings import Settings
    from services.store.sql import SqlStore

logger = logging.getLogger(__name__)

# Nobody else takes the leases of an embedded service over; after a crash a short lease means a short wait.
_EMBEDDED_LEASE_TTL_S = 20.0

Host = Annotated[str | None, typer.Option(help="Address to listen on.")]
Port = Annotated[int | None, typer.Option(help="Port of the API; 0 takes a free one.")]
DataDir = Annotated[Path | None, typer.Option(help="Folder of the database and scratch files.")]
Slots = Annotated[int | None, typer.Option(help="Worker processes; one video in each.")]
Device = Annotated[str | None, typer.Option(help=DEVICE_HELP)]
TlsCert = Annotated[Path | None, typer.Option(help="Certificate chain (PEM): speak HTTPS only.")]
TlsKey = Annotated[Path | None, typer.Option(help="Private key of the certificate (PEM).")]


def up(
    host: Host = None,
    port: Port = None,
    data_dir: DataDir = None,
    slots: Slots = None,
    device: Device = None,
    database_url: Database = None,
    tls_cert: TlsCert = None,
    tls_key: TlsKey = None,
) -> None:
    """Run the whole service here: API, SQLite, a local Ray.

    Ctrl-C stops it; started again, it goes on where it was.
    """
    from services.api.server import check_exposure

    settings = settings_from(
        host=host,
        port=port,
        data_dir=data_dir,
        num_slots=slots,
        device=device,
        database_url=database_url,
        tls_cert_file=tls_cert,
        tls_key_file=tls_key,
    )
    if "lease_ttl_s" not in settings.model_fields_set:
        settings = settings.model_copy(update={"lease_ttl_s": _EMBEDDED_LEASE_TTL_S})
    with open_store(settings) as store:
        check_exposure(settings, store)  # before Ray and the workers start
        metrics = _metrics()
        with _running_agent(store, settings, metrics) as running:
            _serve_api(store, settings, metrics, lambda: running.ready)


def api(
    host: Host = None,
    port: Port = None,
    database_url: Database = None,
    tls_cert: TlsCert = None,
    tls_key: TlsKey = None,
) -> None:
    """Run the API alone; agents share its database."""
    settings = settings_from(
        host=host, port=port, database_url=database_url, tls_cert_file=tls_cert, tls_key_file=tls_key
    )
    with open_store(settings) as store:
        _serve_api(store, settings, _metrics())


def agent(
    slots: Slots = None,
    device: Device = None,
    database_url: Database = None,
    metrics_host: Annotated[str, typer.Option(help="Address of /metrics.")] = "127.0.0.1",
    metrics_port: Annotated[int, typer.Option(help="Port of /metrics; 0 takes a free one.")] = 9090,
) -> None:
    """Run an agent alone, without the API.

    It leases shards from the database and runs them on Ray: the cluster of VIPE_RAY_ADDRESS, or a private one.
    """
    settings = settings_from(num_slots=slots, device=device, database_url=database_url)
    metrics = _metrics()
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    with open_store(settings) as store, _running_agent(store, settings, metrics):
        server, _ = metrics.serve(metrics_port, metrics_host)
        logger.info("metrics on http://%s:%d/metrics", metrics_host, server.server_port)
        stop.wait()


def _metrics() -> Metrics:
    from services.observability.metrics import Metrics

    return Metrics()


@contextlib.contextmanager
def open_store(settings: Settings) -> Iterator[SqlStore]:
    from services.store.sql import open_when_ready

    settings.data_dir.mkdir(parents=True, exist_ok=True)
    store = open_when_ready(settings.database_url)
    try:
        yield store
    finally:
        store.close()


@contextlib.contextmanager
def _running_agent(store: SqlStore, settings: Settings, metrics: Metrics) -> Iterator[Agent]:
    from services.agent.agent import Agent
    from services.agent.config import config_from_settings
    from services.agent.ray_executor import RayExecutor

    config = config_from_settings(settings)
    running = Agent(store, config, RayExecutor(config), metrics)
    running.start()
    try:
        yield running
    finally:
        running.stop()


def _serve_api(
    store: SqlStore, settings: Settings, metrics: Metrics, agent_ready: Callable[[], bool] | None = None
) -> None:
    from services.api import create_app, create_server

    server = create_server(create_app(store, settings, metrics, agent_ready), settings)
    # uvicorn raises the signal again once it has stopped; the process must live on to stop the agent.
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: None)
    scheme = "https" if settings.tls_cert_file else "http"
    logger.info("API on %s://%s:%d, process %d", scheme, settings.host, settings.port, os.getpid())
    server.run()
