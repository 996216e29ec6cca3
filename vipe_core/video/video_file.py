"""Frames of a video file, decoded in a killable child process."""

from __future__ import annotations

import logging
import os
from pathlib import Path
from typing import Any

from vipe_core.video.limits import Limits, default_limits
from vipe_core.video.probe import PROBE_BUDGET_S, file_size_bytes, probe
from vipe_core.video.process import DecoderProcess
from vipe_core.video.source import Frame, FrameStream, VideoInfo
from vipe_core.video.wire import Request

_LOG = logging.getLogger(__name__)

STALL_S = 60.0


def default_threads() -> int:
    """Decoder threads: enough to keep up with the engine, few enough to share the machine."""
    return max(1, min(4, len(os.sched_getaffinity(0))))


class VideoFileSource:
    """`FrameSource` over one video file.

    Every iterator owns one child process; it ends when the iterator is exhausted, closed or garbage collected. A range
    that does not start at 0 decodes and discards what lies before, because only that numbers frames exactly in every
    container. A file that is damaged or cut short gives the pictures that are whole, and says so in `damage`.

    Args:
        path: Video file.
        limits: Bounds on picture size and length.
        name: Name of the sequence; the sanitised stem if None.
        stall_s: Seconds without a decoded frame after which the child is killed (DecodeTimeout).
        threads: Decoder threads.

    Raises:
        InputError, DecodeError: From `probe`.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        limits: Limits | None = None,
        name: str | None = None,
        stall_s: float = STALL_S,
        threads: int | None = None,
    ) -> None:
        self._limits = limits or default_limits()
        self._stall_s = stall_s
        self._threads = threads or default_threads()
        self._path = Path(path).absolute()
        self._info = probe(path, limits=self._limits, name=name, budget_s=max(stall_s, PROBE_BUDGET_S))
        self._damage: str | None = None

    @property
    def info(self) -> VideoInfo:
        return self._info

    @property
    def damage(self) -> str | None:
        """What was wrong with the file, in one sentence; None before a pass has reached the end, or if nothing was."""
        return self._damage

    def frames(self, size: tuple[int, int] | None = None, start: int = 0, stop: int | None = None) -> FrameStream:
        """See `FrameSource.frames`."""
        check_range(size, start, stop)
        if stop is not None and stop <= start:
            return
        file_size_bytes(self._path)
        request = Request(
            task="decode",
            root=str(self._path.parent),
            files=(self._path.name,),
            images=False,
            limits=self._limits,
            size=size,
            start=start,
            stop=stop,
            fps=self._info.fps,
            threads=self._threads,
            stall_s=self._stall_s,
        )
        with DecoderProcess(request, self._path.name, self._stall_s) as child:
            for item in child.frames():
                if isinstance(item, Frame):
                    yield item
                else:
                    self._note_end(item)

    def _note_end(self, document: dict[str, Any]) -> None:
        damage = document.get("damage")
        if damage and self._damage is None:
            self._damage = str(damage)
            _LOG.warning("%s: %s; the whole pictures are used", self._path.name, self._damage)


def check_range(size: tuple[int, int] | None, start: int, stop: int | None) -> None:
    """Raises:
    ValueError: A size that is not positive, or a negative frame number.
    """
    if size is not None and min(size) < 1:
        raise ValueError(f"size must be positive, got {size}")
    if start < 0 or (stop is not None and stop < 0):
        raise ValueError(f"frame numbers must not be negative, got [{start}, {stop})")
