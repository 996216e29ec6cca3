"""Writing pictures as H.264 in mp4, with the same bytes for the same pictures."""

from __future__ import annotations

import os
from fractions import Fraction
from pathlib import Path
from types import TracebackType

import av
import numpy as np
from av.container import OutputContainer
from av.video.frame import VideoFrame
from av.video.reformatter import ColorRange, Colorspace, Interpolation, VideoReformatter
from av.video.stream import VideoStream
from numpy.typing import NDArray

DEFAULT_CRF = 20
# Rates such as 30000/1001 are exact with this denominator.
_MAX_FPS_DENOMINATOR = 1001
# H.264 holds larger ones, but those of broadcasting (64:45 and the like) and any that matters fit in.
_MAX_ASPECT_DENOMINATOR = 255


class VideoWriter:
    """Constant-rate H.264 writer; the file appears under its name only when it is complete.

    The size of the pictures is kept: even sizes are yuv420p, which every player shows; H.264 cannot subsample an odd
    size, so those are yuv444p. Colours are BT.601 limited range and tagged as such: readers that honour tags and those
    that assume BT.601 then agree.

    Use as a context manager: leaving it normally finishes the file, leaving it by an exception removes it.

    Args:
        path: Final path.
        fps: Frames per second.
        pixel_aspect: Width of a pixel over its height, which players stretch the picture by.
        crf: x264 quality, smaller is better (0-51).
        preset: x264 speed preset.
        threads: x264 threads; part of what determines the bytes.
    """

    def __init__(
        self,
        path: str | Path,
        fps: float | Fraction,
        *,
        pixel_aspect: float = 1.0,
        crf: int = DEFAULT_CRF,
        preset: str = "veryfast",
        threads: int = 1,
    ) -> None:
        if not fps > 0:
            raise ValueError(f"fps must be positive, got {fps}")
        self._path = Path(path)
        self._partial = self._path.with_name(f".{self._path.name}.{os.getpid()}.partial")
        # Among multiples of 1 / 1001 there is nothing for a picture an hour: below one per second, round the period.
        exact = Fraction(fps)
        self._rate = exact.limit_denominator(_MAX_FPS_DENOMINATOR) if exact >= 1 else 1 / round(1 / exact, 3)
        self._pixel_aspect = Fraction(pixel_aspect).limit_denominator(_MAX_ASPECT_DENOMINATOR)
        self._options = {"crf": str(crf), "preset": preset}
        self._threads = threads
        self._container: OutputContainer | None = None
        self._stream: VideoStream | None = None
        self._reformatter = VideoReformatter()
        self._num_frames = 0

    @property
    def num_frames(self) -> int:
        return self._num_frames

    def __enter__(self) -> VideoWriter:
        return self

    def __exit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if exc_type is None:
            self.close()
        else:
            self.abort()

    def write(self, rgb: NDArray[np.uint8]) -> None:
        """Append one (H, W, 3) uint8 RGB picture.

        Raises:
            ValueError: The picture is not of the first one's size.
        """
        stream = self._stream or self._open(rgb.shape[1], rgb.shape[0])
        if rgb.shape != (stream.height, stream.width, 3):
            raise ValueError(f"every picture must be {stream.width}x{stream.height} RGB, got an array of {rgb.shape}")
        frame = self._reformatter.reformat(
            VideoFrame.from_ndarray(np.ascontiguousarray(rgb), format="rgb24"),
            format=stream.codec_context.pix_fmt,
            interpolation=Interpolation.BILINEAR,
            dst_colorspace=Colorspace.ITU601,
            src_color_range=ColorRange.JPEG,
            dst_color_range=ColorRange.MPEG,
            threads=1,
        )
        frame.pts = self._num_frames
        frame.time_base = 1 / self._rate
        self._mux(frame)
        self._num_frames += 1

    def close(self) -> None:
        """Finish the file and give it its name.

        Raises:
            ValueError: No picture was written.
        """
        if self._container is None:
            if self._num_frames == 0:
                raise ValueError(f"{self._path.name}: a video needs at least one picture")
            return
        self._mux(None)
        self._container.close()
        self._container = None
        self._partial.replace(self._path)

    def abort(self) -> None:
        """Remove what was written."""
        if self._container is not None:
            self._container.close()
            self._container = None
        self._partial.unlink(missing_ok=True)

    def _open(self, width: int, height: int) -> VideoStream:
        container = av.open(
            str(self._partial), mode="w", format="mp4", options={"fflags": "+bitexact", "movflags": "+faststart"}
        )
        self._container = container
        stream = container.add_stream("libx264", rate=self._rate, options=dict(self._options))
        stream.width, stream.height = width, height
        stream.pix_fmt = "yuv444p" if width % 2 or height % 2 else "yuv420p"
        context = stream.codec_context
        context.thread_count = self._threads
        context.time_base = 1 / self._rate
        if self._pixel_aspect != 1:
            stream.sample_aspect_ratio = self._pixel_aspect
        context.colorspace = int(Colorspace.SMPTE170M)
        context.color_range = int(ColorRange.MPEG)
        self._stream = stream
        return stream

    def _mux(self, frame: VideoFrame | None) -> None:
        assert self._container is not None
        assert self._stream is not None
        for packet in self._stream.encode(frame):
            self._container.mux(packet)
