"""The seam between the supervisor's decisions and the machinery that runs processes.

`ray_executor` implements it with Ray actors; the tests of the state machine implement it in memory. A handle stands for
one slot: one process with at most one task in flight, so that a death always has one video to blame.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from services.agent.gpus import GpuShares
from services.agent.messages import Reply, SlotProgress, Task


@dataclass(frozen=True, slots=True)
class Died:
    """The process is gone, and the task with it.

    Attributes:
        detail: One line from the executor: signal, exit code or out of memory where it is known.
        preempted: The machine was taken away: nobody's fault.
    """

    detail: str
    preempted: bool = False


class SlotHandle(Protocol):
    """One worker process. Called from one thread only, except `progress`."""

    @property
    def place(self) -> str:
        """Where its processes run: host and GPU, or host and slot. Empty before the first one."""

    def start(self, timeout_s: float) -> Died | None:
        """Start a fresh process and wait until it answers; None when it does."""

    def submit(self, task: Task) -> None:
        """Hand over a task. There must be none in flight."""

    def poll(self, timeout_s: float) -> Reply | Died | None:
        """Wait up to `timeout_s` for the task in flight; None when it goes on."""

    def progress(self) -> SlotProgress:
        """The latest known position; never waits, never fails. Any thread."""

    def cancel(self) -> None:
        """Ask the task in flight to stop soon; never waits, never fails."""

    def kill(self) -> None:
        """End the process at once, with its children. Safe to repeat."""


class Executor(Protocol):
    """Owns the processes of an agent. All methods from one thread, which must live as long as the executor."""

    @property
    def shares(self) -> GpuShares | None:
        """How the slots share GPUs, once it has started; None where there are none."""

    def start(self) -> None:
        """Start or join the machinery."""

    def restart(self) -> None:
        """Start the machinery anew after it was lost. Handles stay valid; their processes are gone."""

    def healthy(self) -> bool:
        """Whether the machinery is there; quick. Where it is not, `restart` is called for."""

    def slots(self) -> list[SlotHandle]:
        """One handle per slot, not started yet."""

    def stop(self) -> None:
        """End every process that this executor started."""
