"""What processes take of the machine: CPU-seconds and memory, as the kernel counts them."""

from __future__ import annotations

import os
import re
import resource
import time
from pathlib import Path

_TICKS_PER_S = os.sysconf("SC_CLK_TCK")
# Fields of /proc/PID/stat after the command's name: user and system time of the process itself.
_USER_FIELD, _SYSTEM_FIELD = 11, 12


def cpu_s() -> float:
    """CPU-seconds of this process, of its children that have ended, and of those that still run."""
    ended = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + ended.ru_utime + ended.ru_stime + _running_children_s()


def cpu_s_of(pid: int) -> float:
    """CPU-seconds of a process, without its children.

    Raises:
        OSError: It has ended.
    """
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[_USER_FIELD]) + int(fields[_SYSTEM_FIELD])) / _TICKS_PER_S


def resident_bytes(pid: int) -> int:
    """Memory that a process holds, files that it maps included."""
    return _status_bytes(str(pid), "VmRSS")


def anonymous_bytes() -> int:
    """Memory that this process holds of its own: no files that it maps."""
    return _status_bytes("self", "RssAnon")


def _status_bytes(process: str, field: str) -> int:
    found = re.search(rf"^{field}:\s+(\d+) kB$", Path(f"/proc/{process}/status").read_text(), re.MULTILINE)
    return 1024 * int(found[1]) if found else 0


def _running_children_s() -> float:
    spent_s = 0.0
    for children in Path("/proc/self/task").glob("*/children"):
        try:
            spent_s += sum(cpu_s_of(int(pid)) for pid in children.read_text().split())
        except OSError:  # a thread or a child that has just ended
            continue
    return spent_s
