"""A real Prometheus scrapes the service's metrics and answers every expression of the dashboard and the alerts."""

from __future__ import annotations

import json
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
import yaml

from services.observability.metrics import Metrics

DEPLOY = Path(__file__).resolve().parents[2] / "deploy"


def need(program: str) -> str:
    path = shutil.which(program)
    if path is None:
        pytest.skip(f"{program} is not installed: expressions were checked for names, not run (Debian: prometheus)")
    return path


def test_promtool_accepts_rules_and_configuration(tmp_path: Path) -> None:
    promtool = need("promtool")
    rules = DEPLOY / "prometheus/alerts.yaml"
    subprocess.run([promtool, "check", "rules", str(rules)], check=True, capture_output=True)
    config = (DEPLOY / "prometheus/prometheus.yaml").read_text()
    local = tmp_path / "prometheus.yaml"
    local.write_text(config.replace("/etc/prometheus/alerts.yaml", str(rules)))
    subprocess.run([promtool, "check", "config", str(local)], check=True, capture_output=True)


@pytest.fixture
def prometheus(tmp_path: Path) -> Iterator[httpx.Client]:
    program = need("prometheus")
    server, _ = Metrics().serve(0)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{probe.getsockname()[1]}"
    targets = [{"targets": [f"127.0.0.1:{server.server_port}"]}]
    config = {"global": {"scrape_interval": "1s"}, "scrape_configs": [{"job_name": "vipe", "static_configs": targets}]}
    (tmp_path / "prometheus.yaml").write_text(yaml.safe_dump(config))
    arguments = [
        f"--config.file={tmp_path}/prometheus.yaml",
        f"--storage.tsdb.path={tmp_path}/data",
        f"--web.listen-address={address}",
    ]
    with (tmp_path / "log").open("wb") as log:
        process = subprocess.Popen([program, *arguments], stdout=log, stderr=log)
    try:
        with httpx.Client(base_url=f"http://{address}") as client:
            wait_for_scrapes(client)
            yield client
    finally:
        process.kill()
        process.wait()
        server.shutdown()


def wait_for_scrapes(client: httpx.Client) -> None:
    deadline = time.monotonic() + 60
    while True:
        try:
            found = client.get("/api/v1/query", params={"query": "vipe_build_info"}).json()
            if found["data"]["result"]:
                return
        except (httpx.TransportError, ValueError, KeyError):
            pass  # still starting
        assert time.monotonic() < deadline, "Prometheus scraped nothing"
        time.sleep(0.2)


def test_every_expression_is_answered(prometheus: httpx.Client) -> None:
    board = json.loads((DEPLOY / "grafana/dashboards/vipe.json").read_text())
    panels = [target["expr"] for panel in board["panels"] for target in panel.get("targets", [])]
    rules = yaml.safe_load((DEPLOY / "prometheus/alerts.yaml").read_text())["groups"]
    expressions = panels + [rule["expr"] for group in rules for rule in group["rules"]]
    assert len(expressions) > 15
    for expression in expressions:
        query = expression.replace("$__rate_interval", "1m").replace("$__range", "1h")
        answer = prometheus.get("/api/v1/query", params={"query": query}).json()
        assert answer["status"] == "success", f"{expression}: {answer.get('error')}"
