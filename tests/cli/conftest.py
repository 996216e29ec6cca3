"""The program as a user has it: the installed `vipectl`, real processes, real videos."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest
from cli_helpers import VIPECTL, Run

from vipe_core.evaluation.synthetic import tiny_clip


@pytest.fixture(scope="session")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small video of a camera that moves sideways: 12 frames of 128x96."""
    rendered = tiny_clip("sideways", num_frames=12, width=128, height=96)
    return rendered.write_video(tmp_path_factory.mktemp("clip") / "sideways.mp4")


@pytest.fixture
def vipectl(tmp_path: Path) -> Run:
    """Runs `vipectl` with arguments in an empty folder and returns what it said."""

    def run(*arguments: object, timeout_s: float = 180) -> subprocess.CompletedProcess[str]:
        environment = {**os.environ, "HOME": str(tmp_path), "COLUMNS": "200"}
        command = [str(VIPECTL), *map(str, arguments)]
        return subprocess.run(
            command, capture_output=True, text=True, timeout=timeout_s, cwd=tmp_path, env=environment, check=False
        )

    return run
