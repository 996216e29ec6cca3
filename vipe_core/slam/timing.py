"""The profile of a run: wall seconds and device memory per stage."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

import torch


class StageClock:
    """Adds up the time spent in each stage, which may be entered several times, but not inside of another.

    On a GPU, a stage ends when its work there is done, so that the work counts where it was asked for.

    Attributes:
        seconds: Stage -> wall seconds, in the order in which the stages were first entered.
        peak_bytes: Stage -> most bytes that torch had allocated on the GPU at a time; empty on a CPU.
    """

    def __init__(self, device: torch.device | None = None) -> None:
        self._gpu = device if device is not None and device.type == "cuda" else None
        self.seconds: dict[str, float] = {}
        self.peak_bytes: dict[str, int] = {}

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        if self._gpu is not None:
            torch.cuda.reset_peak_memory_stats(self._gpu)
        start = time.perf_counter()
        try:
            yield
            if self._gpu is not None:
                torch.cuda.synchronize(self._gpu)
        finally:
            self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - start
            if self._gpu is not None:
                peak_bytes = torch.cuda.max_memory_allocated(self._gpu)
                self.peak_bytes[stage] = max(self.peak_bytes.get(stage, 0), peak_bytes)
