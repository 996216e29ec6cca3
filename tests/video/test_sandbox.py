"""What a decoder child cannot do, wherever the platform takes it away."""

from __future__ import annotations

import os
import struct
import subprocess
import sys
from pathlib import Path

import pytest
from video_clips import write_clip

from vipe_core.video import VideoFileSource
from vipe_core.video.sandbox import PROTECTIONS, seccomp_program

ROOT = Path(__file__).resolve().parents[2]

SCRIPT = """
import os, socket, sys, threading
import numpy
from vipe_core.video.sandbox import restrict

active = restrict(1 << 30)
attempts = {
    "socket": lambda: socket.socket(),
    "datagram": lambda: socket.socket(socket.AF_INET, socket.SOCK_DGRAM),
    "unix": lambda: socket.socket(socket.AF_UNIX),
    "process": os.fork,
    "program": lambda: os.execv("/bin/true", ["true"]),
    "signal": lambda: os.kill(os.getppid(), 0),
    "read": lambda: open("/etc/passwd").read(1),
    "list": lambda: os.listdir("/"),
    "environment": lambda: open(f"/proc/{os.getppid()}/environ").read(1),
    "write": lambda: open(sys.argv[1], "w"),
    "remove": lambda: os.unlink(sys.argv[2]),
    "memory": lambda: numpy.ones(1 << 31, dtype=numpy.uint8),
    "own signal": lambda: os.kill(os.getpid(), 0),
    "thread": lambda: threading.Thread(target=int).start(),
    "import": lambda: __import__("wave"),
    "files": lambda: [os.dup(0) for _ in range(1000)],
}
for name, attempt in attempts.items():
    try:
        attempt()
        print(name, "done")
    except (OSError, MemoryError) as error:
        print(name, "refused")
print("active", *active)
"""

PREVENTED = {
    "seccomp": {"socket", "datagram", "unix", "process", "program", "signal"},
    "landlock": {"read", "list", "environment", "write", "remove"},
    "limits": {"memory", "files"} if sys.platform == "linux" else {"files"},
    "privileges": set[str](),
}


def test_what_is_given_up(tmp_path: Path) -> None:
    (tmp_path / "mine").touch()
    answers = subprocess.check_output(
        [sys.executable, "-c", SCRIPT, str(tmp_path / "new"), str(tmp_path / "mine")],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        text=True,
    )
    lines = [line.rpartition(" ") for line in answers.splitlines()]
    outcome = {name: result for name, _, result in lines if result in ("done", "refused")}
    active = answers.splitlines()[-1].split()[1:]
    assert set(active) <= set(PROTECTIONS)
    assert "limits" in active
    expected = set().union(*(PREVENTED[name] for name in active))
    assert {name for name, result in outcome.items() if result == "refused"} >= expected
    assert {outcome[name] for name in ("own signal", "thread", "import")} == {"done"}, "what a decoder needs"
    assert (tmp_path / "mine").exists() or "landlock" not in active


@pytest.mark.skipif(not Path("/proc/self/status").is_file(), reason="looks at the child through /proc")
def test_the_child_that_decodes_is_one_of_these(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from test_decoder_process import decoder_children

    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "hush")
    frames = VideoFileSource(write_clip(tmp_path / "c.mp4", 30, (1024, 704))).frames()
    next(frames)
    (child,) = decoder_children(os.getpid())
    status = dict(line.split(":\t", 1) for line in Path(f"/proc/{child}/status").read_text().splitlines())
    environment = Path(f"/proc/{child}/environ").read_bytes()
    frames.close()
    assert int(status["CapEff"], 16) == 0
    assert status["NoNewPrivs"].strip() == "1"
    assert b"hush" not in environment


@pytest.mark.parametrize("machine", ["x86_64", "aarch64"])
def test_every_path_through_the_filter_ends(machine: str) -> None:
    """The kernel would refuse a jump past the end; here it is checked for the other architecture too."""
    steps = list(struct.iter_unpack("<HBBI", seccomp_program(machine, 42)))
    assert len(steps) < 4096
    for position, (code, then, otherwise, _) in enumerate(steps):
        if code & 0x07 == 0x05:
            assert position + 1 + max(then, otherwise) < len(steps)
    assert steps[-1][0] == 0x06


def run_filter(machine: str, number: int, argument: int = 0, architecture: int | None = None) -> int:
    """The verdict of the filter, by the rules of classic BPF."""
    words = {0: number, 4: architecture or {"x86_64": 0xC000003E, "aarch64": 0xC00000B7}[machine], 16: argument}
    steps = list(struct.iter_unpack("<HBBI", seccomp_program(machine, 42)))
    position = loaded = 0
    while True:
        code, then, otherwise, value = steps[position]
        position += 1
        if code == 0x20:
            loaded = words[value]
        elif code == 0x06:
            return int(value)
        else:
            holds = {0x15: loaded == value, 0x35: loaded >= value, 0x45: bool(loaded & value)}[code]
            position += then if holds else otherwise


@pytest.mark.parametrize(
    ("machine", "number", "argument", "allowed"),
    [
        ("x86_64", 0, 0, True),  # read
        ("x86_64", 41, 0, False),  # socket
        ("x86_64", 0x40000029, 0, False),  # socket of x32
        ("x86_64", 56, 0x10000, True),  # clone of a thread
        ("x86_64", 56, 17, False),  # clone of a process
        ("x86_64", 62, 42, True),  # kill itself
        ("x86_64", 62, 43, False),
        ("x86_64", 234, 1, False),
        ("x86_64", 435, 0, False),
        ("aarch64", 63, 0, True),  # read
        ("aarch64", 198, 0, False),
        ("aarch64", 220, 0x10000, True),
        ("aarch64", 220, 17, False),
        ("aarch64", 129, 42, True),
        ("aarch64", 131, 43, False),
    ],
)
def test_verdicts(machine: str, number: int, argument: int, allowed: bool) -> None:
    assert (run_filter(machine, number, argument) == 0x7FFF0000) is allowed


def test_calls_of_another_architecture_are_refused() -> None:
    assert run_filter("x86_64", 0, architecture=0x40000003) != 0x7FFF0000
