"""CPU-seconds of this process and of its decoder processes, by stage of an annotation.

Machines are shared and clocks differ, so speed is judged by the CPU time that the kernel counted, not by a stopwatch.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path

from benchmarks.processes import cpu_s
from vipe_core.annotation import Annotation, Progress
from vipe_core.pipeline.annotator import Annotator


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
    last_s: float = field(default_factory=cpu_s)

    def __call__(self, progress: Progress) -> None:
        now = cpu_s()
        self.spent_s[progress.stage] = self.spent_s.get(progress.stage, 0.0) + now - self.last_s
        self.last_s = now


def measure(annotator: Annotator, path: Path) -> Measured:
    """Annotates a video without its depth, and measures.

    Raises:
        VipeError: As `Annotator.annotate`.
    """
    clock = _Clock()
    started_s, started_cpu_s = time.perf_counter(), clock.last_s
    annotation = annotator.annotate(path, progress=clock)
    return Measured(annotation, cpu_s() - started_cpu_s, time.perf_counter() - started_s, clock.spent_s)
