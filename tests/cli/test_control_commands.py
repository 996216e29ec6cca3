"""`vipectl pause | resume | set | retry | limit | tenants` against an API without agents, in one process each."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner

from services.api import create_app, create_server
from services.cli.main import app
from services.client import Client
from services.settings import Settings
from services.store.sql import SqlStore


@pytest.fixture
def database(tmp_path: Path) -> str:
    return f"sqlite:///{tmp_path}/store.db"


@pytest.fixture
def url(tmp_path: Path, database: str) -> Iterator[str]:
    settings = Settings(data_dir=tmp_path, database_url=database, port=0)
    store = SqlStore(database)
    server = create_server(create_app(store, settings), settings)
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    while not server.started:
        assert thread.is_alive()
        time.sleep(0.01)
    yield server.url
    server.should_exit = True
    thread.join(30)
    store.close()


def run(*arguments: str) -> tuple[int, str]:
    done = CliRunner().invoke(app, list(arguments))
    return done.exit_code, done.output


def test_a_job_is_paused_changed_and_resumed(url: str, tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    code, out = run("submit", str(tmp_path / "in"), "-o", str(tmp_path / "out"), "--priority", "3", "--api", url)
    assert code == 0, out
    job_id, client = out.strip(), Client(url)
    assert client.job(job_id)["control"]["priority"] == 3
    assert run("pause", job_id, "--api", url) == (0, "paused\n")
    code, out = run("set", job_id, "--priority", "7", "--max-slot-hours", "2.5", "--api", url)
    assert code == 0, out
    control = client.job(job_id)["control"]
    assert (control["priority"], control["max_slot_hours"]) == (7, 2.5)
    assert run("resume", job_id, "--api", url) == (0, "queued\n")
    code, out = run("retry", job_id, "--quarantined", "--api", url)
    assert code == 1
    assert "has not ended yet" in out


def test_limits_of_tenants_are_set_and_shown(url: str, database: str, tmp_path: Path) -> None:
    assert run("limit", "default", "--max-jobs", "1", "--weight", "2", "--database-url", database)[0] == 0
    for number, expected in ((1, 0), (2, 1)):
        (tmp_path / f"in-{number}").mkdir()
        arguments = ("submit", str(tmp_path / f"in-{number}"), "-o", str(tmp_path / f"out-{number}"), "--api", url)
        assert bool(run(*arguments)[0]) == bool(expected)
    code, table = run("tenants", "--database-url", database)
    assert code == 0
    assert "1/1" in table
    assert run("limit", "default", "--weight", "0", "--database-url", database)[0] != 0
