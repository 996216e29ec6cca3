"""Whose processes a private Ray's are, and that none is left."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from services.agent.ray_health import all_alive, end_processes, head_processes


class Pretenders:
    """Processes that look like those of Ray: a shell by their name that waits, with Ray's folder as an argument."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.started: list[subprocess.Popen[bytes]] = []

    def start(self, name: str, ray: Path) -> subprocess.Popen[bytes]:
        program = self._folder / name
        if not program.exists():
            shutil.copy(shutil.which("sh") or "/bin/sh", program)
        command = [program, "-c", "echo; read line", f"--log_dir={ray}/session/logs"]
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        assert process.stdout is not None
        process.stdout.readline()  # It runs under its own name now.
        self.started.append(process)
        return process


@pytest.fixture
def pretenders(tmp_path: Path) -> Iterator[Pretenders]:
    found = Pretenders(tmp_path)
    yield found
    for process in found.started:
        process.kill()
        process.communicate()


def test_a_start_that_failed_half_way_leaves_nothing_behind(pretenders: Pretenders, tmp_path: Path) -> None:
    ours, others = tmp_path / "ray-1", tmp_path / "ray-12"
    failed = [pretenders.start(name, ours) for name in ("gcs_server", "raylet", "log_monitor")]
    stranger = pretenders.start("raylet", others)
    assert set(head_processes(ours)) == {failed[0].pid, failed[1].pid}

    end_processes(ours)

    assert head_processes(ours) == {}
    assert all(process.poll() is not None for process in failed)
    assert stranger.poll() is None
    again = pretenders.start("raylet", ours)
    head = head_processes(ours)
    assert set(head) == {again.pid}
    assert all_alive(head)


def test_a_head_that_died_and_was_not_reaped_is_none(pretenders: Pretenders, tmp_path: Path) -> None:
    gcs = pretenders.start("gcs_server", tmp_path / "ray")
    head = head_processes(tmp_path / "ray")
    gcs.kill()
    os.waitid(os.P_PID, gcs.pid, os.WEXITED | os.WNOWAIT)
    assert not all_alive(head)
    assert head_processes(tmp_path / "ray") == {}
    end_processes(tmp_path / "ray")
