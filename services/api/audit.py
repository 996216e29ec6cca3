"""What goes into the audit trail: every request that changes something, and refused keys at a bounded rate."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

from services.domain.access import AuditEntry
from services.domain.errors import StoreUnavailable
from services.store.base import Store

_log = logging.getLogger(__name__)
_WINDOW_S = 60.0
_MAX_SOURCES = 20


@dataclass(slots=True)
class _Window:
    opened_at_s: float
    last: AuditEntry
    more: int


class AuditTrail:
    """Writes entries to the store and to the log. Thread-safe; to be called outside of the event loop.

    The first refusal of a source (an address and the key that it claims) is written at once, what follows within a
    minute as one entry with their number; beyond 20 sources at a time all others count as one. So strangers add some
    dozen rows a minute at most, however often they knock.
    """

    def __init__(self, store: Store, clock: Callable[[], float] = time.monotonic) -> None:
        self._store = store
        self._clock = clock
        self._lock = threading.Lock()
        self._windows: dict[tuple[str, str | None], _Window] = {}

    def record(self, entry: AuditEntry) -> None:
        """Write down a request that changed something or tried to."""
        self._write([*self._closed(), entry])

    def refused(self, entry: AuditEntry) -> None:
        """Count a refused key."""
        entries = self._closed()
        with self._lock:
            source = (entry.address, entry.key_id)
            if source not in self._windows and len(self._windows) >= _MAX_SOURCES:
                source, entry = ("others", None), replace(entry, address="others", key_id=None, tenant=None)
            window = self._windows.get(source)
            if window is None:
                self._windows[source] = _Window(self._clock(), entry, 0)
                entries.append(entry)
            else:
                window.last, window.more = entry, window.more + 1
        self._write(entries)

    def flush(self) -> None:
        """Write the counts of windows that are over."""
        self._write(self._closed())

    def close(self) -> None:
        """Write all counts."""
        self._write(self._closed(everything=True))

    def _closed(self, everything: bool = False) -> list[AuditEntry]:
        now_s = self._clock()
        with self._lock:
            over = [s for s, w in self._windows.items() if everything or now_s - w.opened_at_s >= _WINDOW_S]
            windows = [self._windows.pop(source) for source in over]
        return [replace(window.last, count=window.more) for window in windows if window.more]

    def _write(self, entries: list[AuditEntry]) -> None:
        for e in entries:
            who = f"{e.tenant or '-'}/{e.key_id or 'anonymous'} at {e.address}"
            level = logging.WARNING if e.status in (401, 403, 429) else logging.INFO
            times = f" ({e.count} times)" if e.count > 1 else ""
            _log.log(level, "audit: %s: %s on %s: %d %s%s", who, e.action, e.object, e.status, e.code or "", times)
        if not entries:
            return
        try:
            self._store.record_audit(entries)
        except StoreUnavailable as error:
            _log.error("the audit trail lacks %d entries, which are in this log only: %s", len(entries), error)
