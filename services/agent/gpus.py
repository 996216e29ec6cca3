"""Slots that share a GPU: how many, how much of its memory each may take, and how one video gets more of it.

A slot is one process with one video. Its share of the GPU's memory is planned from what a usual video takes; a video
that takes more has to wait until other slots of the same GPU are between two videos, and they wait while it runs.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

from vipe_core.errors import ConfigError

_GB = 1e9
# Videos on one GPU beyond which there is nothing left to overlap: while one decodes, others compute.
_MOST_PER_GPU = 8
_USABLE_SHARE = 0.9
_PATIENCE_S = 0.2


def gpu_memory_bytes() -> tuple[int, ...]:
    """The memory of each GPU that this process may use: the one place where the hardware is asked."""
    import torch  # Slow to import, and of no use to a process without GPUs.

    return tuple(
        int(torch.cuda.get_device_properties(index).total_memory) for index in range(torch.cuda.device_count())
    )


@dataclass(frozen=True, slots=True)
class Want:
    """What a video is given of a GPU.

    Attributes:
        shares: Of as many as the GPU has slots.
        low_memory: Whatever would fit.
    """

    shares: int = 1
    low_memory: bool = False


@dataclass(frozen=True, slots=True)
class SlotPlan:
    """How GPUs are shared.

    Attributes:
        per_gpu: Slots on each.
        usable_bytes: Of the smallest of them.
        idle_bytes: What a slot between two videos keeps.
    """

    per_gpu: int
    usable_bytes: int
    idle_bytes: int

    @property
    def gpus_per_slot(self) -> float:
        """What a slot reserves of a GPU; rounded down, so that all of them find room."""
        return math.floor(1e4 / self.per_gpu) / 1e4

    def bytes_of(self, shares: int) -> int:
        """What a video may take that holds so many shares: theirs, but for what the idle slots among them keep."""
        return max(self.usable_bytes * shares // self.per_gpu - (shares - 1) * self.idle_bytes, 0)

    def wider(self, want: Want, needed_bytes: int | None) -> Want | None:
        """What to give a video for which `want` was too little; None where the GPU has no more.

        Args:
            needed_bytes: What it takes by plan, in the low-memory profile; None where memory ran out in the work.
        """
        if needed_bytes is None and not want.low_memory:
            return replace(want, low_memory=True)
        for shares in range(want.shares + 1, self.per_gpu + 1):
            if self.bytes_of(shares) >= max(needed_bytes or 0, self.bytes_of(want.shares) + 1):
                return replace(want, shares=shares)
        return None


def plan_slots(
    memory_bytes: Sequence[int],
    *,
    usual_bytes: int,
    idle_bytes: int,
    cores: int | None = None,
    slots: int | None = None,
    per_gpu: int | None = None,
) -> SlotPlan:
    """How many slots share each of these GPUs.

    Args:
        memory_bytes: Of each GPU; at least one.
        usual_bytes: What a usual video takes.
        idle_bytes: What a slot between two videos keeps.
        cores: For all of them; a slot without a core of its own would only wait for the others.
        slots: Wanted on all of them; as many as fit if None.
        per_gpu: Wanted on each, whatever a usual video takes.

    Raises:
        ConfigError: So many slots do not fit.
    """
    smallest = min(memory_bytes)
    usable_bytes = int(_USABLE_SHARE * smallest)
    fitting = min(usable_bytes // usual_bytes, _MOST_PER_GPU)
    if cores is not None:
        fitting = min(fitting, cores // len(memory_bytes))
    number = per_gpu or max(fitting, 1)
    if slots is not None:
        if per_gpu is None:
            # Fewer than fit have more of it each; more than fit are for who asks for them by GPU.
            number = min(number, math.ceil(slots / len(memory_bytes)))
        if slots > number * len(memory_bytes):
            raise ConfigError(
                f"{slots} slots do not fit on {len(memory_bytes)} GPUs of {smallest / _GB:.0f} GB: a usual video takes "
                f"{usual_bytes / _GB:.1f} GB by plan, so {number} on each; set the number of slots to "
                f"{number * len(memory_bytes)} at most, or VIPE_SLOTS_PER_GPU"
            )
    return SlotPlan(number, usable_bytes, idle_bytes)


class GpuShares:
    """Who runs on which GPU now. Thread-safe; first come, first served, so that who wants much is not starved."""

    def __init__(self, plan: SlotPlan) -> None:
        self.plan = plan
        self._changed = threading.Condition()
        self._taken: dict[str, int] = {}
        self._queues: dict[str, deque[object]] = {}

    @contextmanager
    def held(self, place: str, shares: int, waiting: Callable[[], None]) -> Iterator[None]:
        """Hold shares of the GPU at `place`; none may be held by the same slot already.

        Args:
            waiting: Called again and again while they are not free; what it raises ends the wait.
        """
        ticket = object()
        with self._changed:
            queue = self._queues.setdefault(place, deque())
            queue.append(ticket)
            try:
                while queue[0] is not ticket or self._taken.get(place, 0) + shares > self.plan.per_gpu:
                    waiting()
                    self._changed.wait(_PATIENCE_S)
                self._taken[place] = self._taken.get(place, 0) + shares
            finally:
                queue.remove(ticket)
                self._changed.notify_all()
        try:
            yield
        finally:
            with self._changed:
                self._taken[place] -= shares
                self._changed.notify_all()
