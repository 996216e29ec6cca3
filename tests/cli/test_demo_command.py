"""`vipectl demo`: the whole way with a user's video, and no harm to what is not its own."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from pathlib import Path

import pytest
from cli_helpers import VIPECTL, Run

pytestmark = pytest.mark.slow


def test_the_users_video_all_the_way(vipectl: Run, clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Somebody's production settings in the environment are not the demo's.
    monkeypatch.setenv("VIPE_DATABASE_URL", "postgresql://nobody@127.0.0.1:9/none")
    monkeypatch.setenv("VIPE_API_KEY", "secret")
    done = vipectl("demo", clip, "-o", "out")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "1 videos of 1 planned = 1 succeeded + 0 failed" in done.stdout
    assert "sideways-" in done.stdout
    assert "vipectl verify out/dataset --deep" in done.stdout
    (picture,) = (tmp_path / "out/pictures").glob("*.png")
    assert picture.stat().st_size > 10_000
    assert not processes_in(tmp_path)

    (tmp_path / "out/pictures/mine.txt").touch()
    again = vipectl("demo", tmp_path / "missing.mp4", "-o", "out")
    assert again.returncode == 2
    assert (tmp_path / "out/pictures/mine.txt").exists(), "nothing is replaced for a run that cannot start"


def test_a_folder_that_no_demo_made_is_left_alone(vipectl: Run, clip: Path, tmp_path: Path) -> None:
    mine = tmp_path / "project/service/main.py"
    mine.parent.mkdir(parents=True)
    mine.touch()
    done = vipectl("demo", clip, "-o", "project")
    assert done.returncode == 2
    assert "not made by a demo" in done.stderr
    assert mine.exists()


def test_an_input_inside_of_the_output_is_refused(vipectl: Run, clip: Path, tmp_path: Path) -> None:
    inside = tmp_path / "out/videos/clip.mp4"
    inside.parent.mkdir(parents=True)
    (tmp_path / "out/.vipe-demo").touch()
    inside.write_bytes(clip.read_bytes())
    done = vipectl("demo", inside, "-o", "out")
    assert done.returncode == 2
    assert inside.exists()


def test_a_demo_that_is_ended_takes_its_service_with_it(clip: Path, tmp_path: Path) -> None:
    command = [str(VIPECTL), "demo", str(clip), "-o", str(tmp_path / "out")]
    demo = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 60
    while not (tmp_path / "out/service/vipe.db").exists():
        assert time.monotonic() < deadline
        time.sleep(0.1)
    demo.send_signal(signal.SIGTERM)
    assert demo.wait(60) == 130
    assert not processes_in(tmp_path)


def processes_in(folder: Path) -> list[str]:
    """Command lines of live processes that name the folder."""
    found = []
    for process in Path("/proc").iterdir():
        if process.name.isdigit() and int(process.name) != os.getpid():
            try:
                command = (process / "cmdline").read_bytes().replace(b"\0", b" ").decode()
            except OSError:
                continue
            if str(folder) in command:
                found.append(command)
    return found
