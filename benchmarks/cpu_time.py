"""CPU-seconds of this process and of its decoder processes, by stage of an annotation.

Machines are shared and clocks differ, so speed is judged by the CPU time that the kernel counted, not by a stopwatch.
"""

from __future__ import annotations

import os
import resource
import time
from dataclasses import dataclass, field
from pathlib import Path

from vipe_core.annotation import Annotation, Progress
from vipe_core.evaluation.synthetic import tiny_clip
from vipe_core.pipeline.annotator import Annotator
from vipe_core.video.encode import VideoWriter

_TICKS_PER_S = os.sysconf("SC_CLK_TCK")
# Fields of /proc/PID/stat after the command's name: user and system time of the process itself.
_USER_FIELD, _SYSTEM_FIELD = 11, 12


@dataclass(frozen=True, slots=True)
class Measured:
    """An annotation (poses and intrinsics, no depth) and what it cost.

    Attributes:
        cpu_s: CPU-seconds of all threads and child processes.
        wall_s: Wall seconds.
        stage_cpu_s: `cpu_s` by stage, in order; what lies between two stages counts for the one that follows.
    """

    annotation: Annotation
    cpu_s: float
    wall_s: float
    stage_cpu_s: dict[str, float]

    @property
    def cpu_s_per_frame(self) -> float:
        return self.cpu_s / self.annotation.num_frames


@dataclass(slots=True)
class _Clock:
    """Hands the CPU time since the last report to the stage of the next one."""

    spent_s: dict[str, float] = field(default_factory=dict)
    last_s: float = field(default_factory=lambda: cpu_s())

    def __call__(self, progress: Progress) -> None:
        now = cpu_s()
        self.spent_s[progress.stage] = self.spent_s.get(progress.stage, 0.0) + now - self.last_s
        self.last_s = now


def cpu_s() -> float:
    """CPU-seconds of this process, of its children that have ended, and of those that still run."""
    ended = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + ended.ru_utime + ended.ru_stime + _running_children_s()


def measure(annotator: Annotator, path: Path) -> Measured:
    """Annotates a video without its depth, and measures.

    Raises:
        VipeError: As `Annotator.annotate`.
    """
    clock = _Clock()
    started_s, started_cpu_s = time.perf_counter(), clock.last_s
    annotation = annotator.annotate(path, progress=clock)
    return Measured(annotation, cpu_s() - started_cpu_s, time.perf_counter() - started_s, clock.spent_s)


def warm_up(annotator: Annotator, folder: Path) -> None:
    """Annotates a tiny clip: libraries are loaded and kernels are compiled in what is timed afterwards."""
    clip = tiny_clip("orbit", num_frames=12)
    path = folder / "warm.mp4"
    with VideoWriter(path, clip.fps) as writer:
        for rgb in clip.rgb:
            writer.write(rgb)
    annotator.annotate(path)


def _running_children_s() -> float:
    ticks = 0
    for children in Path("/proc/self/task").glob("*/children"):
        try:
            pids = children.read_text().split()
            stats = [Path(f"/proc/{pid}/stat").read_text() for pid in pids]
        except OSError:  # a thread or a child that has just ended
            continue
        for stat in stats:
            fields = stat.rpartition(")")[2].split()
            ticks += int(fields[_USER_FIELD]) + int(fields[_SYSTEM_FIELD])
    return ticks / _TICKS_PER_S
