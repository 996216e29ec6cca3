"""Is Ray's head still there, and who may talk to Ray while it is being replaced?

Ray's own answer to a head that is gone is to end this process once its patience runs out, or to start another Ray at
the next call. So calls into Ray go through a gate, which is closed before Ray is shut down and opened when it is back.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path

# Names of the processes of a head that this process started, as the kernel shows them.
_HEAD_PROCESSES = {"gcs_server", "raylet"}
_CONNECT_TIMEOUT_S = 2.0


class RayGone(Exception):
    """Ray is being replaced."""


class RayGate:
    """Lets calls into Ray through while it is open. Thread-safe."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._open = False
        self._inside = 0

    @property
    def is_open(self) -> bool:
        return self._open

    @contextlib.contextmanager
    def inside(self) -> Iterator[None]:
        """For one short call into Ray. Raises RayGone while the gate is closed."""
        with self._changed:
            if not self._open:
                raise RayGone
            self._inside += 1
        try:
            yield
        finally:
            with self._changed:
                self._inside -= 1
                self._changed.notify_all()

    def open(self) -> None:
        with self._changed:
            self._open = True
            self._changed.notify_all()

    def close(self, timeout_s: float) -> bool:
        """Let nobody in any more and wait for those inside; whether all have left."""
        with self._changed:
            self._open = False
            return self._changed.wait_for(lambda: self._inside == 0, timeout_s)

    def wait_open(self, timeout_s: float) -> bool:
        with self._changed:
            return self._changed.wait_for(lambda: self._open, timeout_s)


def head_processes(temp_dir: Path) -> dict[int, str]:
    """(process id -> start time) of the head that this process started with that folder."""
    return {
        pid: status[3]
        for pid, status in _processes_of(temp_dir).items()
        if status[0] in _HEAD_PROCESSES and status[2] == os.getpid()
    }


def end_processes(temp_dir: Path) -> None:
    """Kill what is left of a private Ray with that folder, and reap it.

    Ray ends its processes itself, but not those of a start that failed half-way: they would run as long as this one.
    """
    for pid, (_, _, parent, _) in _processes_of(temp_dir).items():
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.kill(pid, signal.SIGKILL)
        if parent == os.getpid():
            with contextlib.suppress(ChildProcessError):
                os.waitpid(pid, 0)


def all_alive(processes: dict[int, str]) -> bool:
    """Whether each of them still runs: neither gone, nor dead and not reaped yet, nor another one of the same id."""
    for pid, started in processes.items():
        status = _status(pid)
        if status is None or status[1] in "ZX" or status[3] != started:
            return False
    return True


def answers(address: str, patience_s: float = 10.0) -> bool:
    """Whether something accepts connections at `host:port`, now or within `patience_s`."""
    host, _, port = address.rpartition(":")
    deadline = time.monotonic() + patience_s
    while True:
        with contextlib.suppress(OSError, ValueError):
            socket.create_connection((host.strip("[]"), int(port)), timeout=_CONNECT_TIMEOUT_S).close()
            return True
        if time.monotonic() >= deadline:
            return False
        time.sleep(0.5)


def _processes_of(temp_dir: Path) -> dict[int, tuple[str, str, int, str]]:
    """The living processes whose command line names a Ray's own folder, but this one; see `_status`."""
    found = {}
    for folder in Path("/proc").iterdir():
        if not folder.name.isdigit() or int(folder.name) == os.getpid():
            continue
        with contextlib.suppress(OSError):  # It has ended meanwhile, or is somebody else's.
            named = os.fsencode(f"{temp_dir}/") in (folder / "cmdline").read_bytes()
            status = _status(int(folder.name)) if named else None
            if status is not None:
                found[int(folder.name)] = status
    return found


def _status(pid: int) -> tuple[str, str, int, str] | None:
    """(name, state, parent, start time) of a process; None if there is none."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return None
    name, _, rest = text.partition("(")[2].rpartition(")")
    fields = rest.split()
    return name, fields[0], int(fields[1]), fields[19]
