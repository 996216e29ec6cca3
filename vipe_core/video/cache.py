"""Random access to frames at one size in a bounded number of bytes."""

from __future__ import annotations

from collections import OrderedDict
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from vipe_core.video.source import Frame, FrameSource, FrameStream


class FrameCache:
    """Least-recently-used cache over a `FrameSource`, with one decoder kept open at the last position.

    Going forward costs one decode per frame; a frame that is neither cached nor ahead of the decoder starts it again.
    A caller that visits frames roughly in order, within a window that fits `max_bytes`, decodes each frame once.

    Args:
        source: Where frames come from.
        size: (width, height) of the frames, or None for the source's own size.
        max_bytes: Upper bound on the bytes of pixels held (at least one frame is always held).
    """

    def __init__(self, source: FrameSource, size: tuple[int, int] | None = None, max_bytes: int = 256 << 20) -> None:
        self._source = source
        self._size = size
        self._max_bytes = max_bytes
        self._held: OrderedDict[int, Frame] = OrderedDict()
        self._held_bytes = 0
        self._cursor: FrameStream | None = None
        self._next_index = 0

    def __enter__(self) -> FrameCache:
        return self

    def __exit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    @property
    def held_bytes(self) -> int:
        return self._held_bytes

    def close(self) -> None:
        """Kill the open decoder and drop all frames."""
        self._close_cursor()
        self._held.clear()
        self._held_bytes = 0

    def get(self, index: int) -> NDArray[np.uint8]:
        """(H, W, 3) uint8 RGB of frame `index`, read-only.

        Raises:
            IndexError: The clip has no such frame.
            InputError, DecodeError: From the source.
        """
        return self.frame(index).rgb

    def frame(self, index: int) -> Frame:
        """Like `get`, with the timestamp."""
        if index < 0:
            raise IndexError(f"frame {index}: frame numbers start at 0")
        held = self._held.get(index)
        if held is not None:
            self._held.move_to_end(index)
            return held
        if self._cursor is None or index < self._next_index:
            self._close_cursor()
            self._cursor = self._source.frames(self._size, start=index)
            self._next_index = index
        for frame in self._cursor:
            self._next_index = frame.index + 1
            self._hold(frame)
            if frame.index == index:
                return frame
        self._close_cursor()
        raise IndexError(f"frame {index}: the clip {self._source.info.name} ends before it")

    def _hold(self, frame: Frame) -> None:
        frame.rgb.setflags(write=False)
        if frame.index in self._held:
            self._held_bytes -= self._held.pop(frame.index).rgb.nbytes
        self._held[frame.index] = frame
        self._held_bytes += frame.rgb.nbytes
        while self._held_bytes > self._max_bytes and len(self._held) > 1:
            _, oldest = self._held.popitem(last=False)
            self._held_bytes -= oldest.rgb.nbytes

    def _close_cursor(self) -> None:
        if self._cursor is not None:
            self._cursor.close()
            self._cursor = None
