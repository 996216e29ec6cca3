"""Counting object storage traffic: in a worker until the next reply, in the agent straight into the metrics."""

from __future__ import annotations

import threading
from collections import Counter

from services.agent.messages import Traffic
from services.observability.metrics import Metrics


class TrafficRecorder:
    """A `StorageObserver` that adds up what a worker does, to be sent with its reply."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._requests: Counter[tuple[str, str]] = Counter()
        self._bytes: Counter[str] = Counter()

    def request(self, op: str, status: str) -> None:
        with self._lock:
            self._requests[op, status] += 1

    def transferred(self, op: str, size_bytes: int) -> None:
        with self._lock:
            self._bytes[op] += size_bytes

    def take(self) -> Traffic:
        """What was counted since the last call."""
        with self._lock:
            traffic = Traffic(dict(self._requests), dict(self._bytes))
            self._requests.clear()
            self._bytes.clear()
        return traffic


class TrafficMetrics:
    """A `StorageObserver` that counts in the metrics."""

    def __init__(self, metrics: Metrics) -> None:
        self._metrics = metrics

    def request(self, op: str, status: str) -> None:
        self._metrics.object_store_requests.labels(op=op, status=status).inc()

    def transferred(self, op: str, size_bytes: int) -> None:
        self._metrics.object_store_bytes.labels(op=op).inc(size_bytes)

    def add(self, traffic: Traffic) -> None:
        """Count what a worker sent with its reply."""
        for (op, status), count in traffic.requests.items():
            self._metrics.object_store_requests.labels(op=op, status=status).inc(count)
        for op, size_bytes in traffic.transferred_bytes.items():
            self._metrics.object_store_bytes.labels(op=op).inc(size_bytes)
