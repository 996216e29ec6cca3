"""When to try again, and when not any more.

Waits are exponential with full jitter, so that a thousand workers do not come back together.
"""

from __future__ import annotations

import random
import threading
from collections import Counter
from collections.abc import Callable

# Beyond any `max_s`, and far from where a float overflows: an outage may last for thousands of failures.
_MAX_DOUBLINGS = 64


def exponential_s(failures: int, base_s: float, max_s: float) -> float:
    """`base_s`, doubled for each failure before, `max_s` at most."""
    return min(max_s, base_s * 2.0 ** min(failures, _MAX_DOUBLINGS))


class Backoff:
    """Delays that double with each failure.

    Args:
        uniform: (low, high) -> seconds; a seam for tests.
    """

    def __init__(self, base_s: float, max_s: float, uniform: Callable[[float, float], float] = random.uniform) -> None:
        self._base_s = base_s
        self._max_s = max_s
        self._uniform = uniform
        self._failures = 0

    @property
    def failures(self) -> int:
        """Failures in a row."""
        return self._failures

    def failed(self) -> float:
        """Count a failure and return how long to wait, at least a tenth of the ceiling."""
        ceiling = exponential_s(self._failures, self._base_s, self._max_s)
        self._failures += 1
        return self._uniform(ceiling / 10, ceiling)

    def succeeded(self) -> None:
        self._failures = 0


class GiveBacks:
    """How often this agent gave each shard back. Restarts and preemptions do not count. Thread-safe."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()

    def add(self, shard_id: str) -> None:
        with self._lock:
            self._counts[shard_id] += 1

    def exhausted(self, shard_id: str) -> bool:
        """Whether giving this shard back once more would only repeat what did not help."""
        with self._lock:
            return self._counts[shard_id] >= self._limit

    def forget(self, shard_id: str) -> None:
        with self._lock:
            self._counts.pop(shard_id, None)
