"""Clips that the tests of the video package generate: every picture carries its number as a bar code."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray

BITS = 6


def picture(index: int, width: int, height: int) -> NDArray[np.uint8]:
    """RGB ramps, and in the upper third the bits of `index` as white or black blocks."""
    x = np.linspace(40, 200, width)[None, :].repeat(height, 0)
    y = np.linspace(60, 180, height)[:, None].repeat(width, 1)
    rgb = np.stack([x, y, np.full_like(x, 90)], -1)
    for bit in range(BITS):
        left, right = bit * width // BITS, (bit + 1) * width // BITS
        rgb[: height // 3, left:right] = 235 if index >> bit & 1 else 16
    return rgb.astype(np.uint8)


def number_of(rgb: NDArray[np.uint8]) -> int:
    """The number in the bar code of an upright picture of any size."""
    height, width = rgb.shape[:2]
    row = rgb[height // 6].astype(float).mean(-1)
    return sum(1 << bit for bit in range(BITS) if row[(2 * bit + 1) * width // (2 * BITS)] > 128)


def write_clip(
    path: Path,
    num_frames: int = 12,
    size: tuple[int, int] = (96, 64),
    *,
    codec: str = "libx264",
    pixel_format: str = "yuv420p",
    rate: int = 25,
    pts_ms: Sequence[int] | None = None,
    pixel_aspect: Fraction | None = None,
    options: dict[str, str] | None = None,
    container_options: dict[str, str] | None = None,
) -> Path:
    """Encode `picture(0)`, `picture(1)` ...; with `pts_ms` at those times, else at a constant `rate`."""
    with av.open(str(path), "w", options=container_options or {}) as container:
        stream = container.add_stream(codec, rate=rate, options=options or {})
        stream.width, stream.height = size
        stream.pix_fmt = pixel_format
        if pixel_aspect is not None:
            stream.sample_aspect_ratio = pixel_aspect
        time_base = Fraction(1, 1000) if pts_ms is not None else Fraction(1, rate)
        stream.codec_context.time_base = time_base
        for index in range(num_frames):
            frame = av.VideoFrame.from_ndarray(picture(index, *size), format="rgb24")
            frame.pts = pts_ms[index] if pts_ms is not None else index
            frame.time_base = time_base
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def write_audio(path: Path, codec: str) -> Path:
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=44100, layout="mono")
        time = np.arange(44100) / 44100
        samples = (np.sin(2 * np.pi * 440 * time) * 8000).astype(np.int16)[None]
        resampler = av.AudioResampler(
            stream.codec_context.format, "mono", 44100, stream.codec_context.frame_size or 1024
        )
        frame = av.AudioFrame.from_ndarray(samples, format="s16", layout="mono")
        frame.sample_rate = 44100
        for part in (*resampler.resample(frame), *resampler.resample(None)):
            container.mux(stream.encode(part))
        container.mux(stream.encode(None))
    return path


def set_display_rotation(path: Path, clockwise_deg: int) -> None:
    """Overwrite the display matrix in the track header of an mp4 (phones write this instead of turning the picture)."""
    data = bytearray(path.read_bytes())
    at = data.index(b"tkhd") + 4
    assert data[at] == 0, "a version 1 track header has wider fields"
    cos, sin = {0: (1, 0), 90: (0, 1), 180: (-1, 0), 270: (0, -1)}[clockwise_deg]
    one = 1 << 16
    matrix = (cos * one, sin * one, 0, -sin * one, cos * one, 0, 0, 0, 1 << 30)
    data[at + 40 : at + 76] = struct.pack(">9i", *matrix)
    path.write_bytes(data)


_GOOGLE_SPHERICAL = bytes.fromhex("ffcc8263f8554a938814587a02521fdd")


def declare_panorama(path: Path, projection: str = "equirectangular") -> None:
    """Say in a finished mp4, in the way of Google's spherical video metadata (version 1), that it is a panorama."""
    keys = {"Spherical": "true", "Stitched": "true", "StitchingSoftware": "none", "ProjectionType": projection}
    xml = "".join(f"<GSpherical:{key}>{value}</GSpherical:{key}>" for key, value in keys.items())
    namespace = 'xmlns:GSpherical="http://ns.google.com/videos/1.0/spherical/"'
    payload = _GOOGLE_SPHERICAL + f"<rdf:SphericalVideo {namespace}>{xml}</rdf:SphericalVideo>".encode()
    data = bytearray(path.read_bytes())
    movie, movie_end = _box(data, b"moov", 0, len(data))
    track, track_end = _box(data, b"trak", movie + 8, movie_end)
    # The index lies behind the pictures, so that nothing it points to moves.
    data[track_end:track_end] = struct.pack(">I4s", 8 + len(payload), b"uuid") + payload
    for start, end in ((movie, movie_end), (track, track_end)):
        data[start : start + 4] = struct.pack(">I", end - start + 8 + len(payload))
    path.write_bytes(data)


def _box(data: bytearray, kind: bytes, start: int, stop: int) -> tuple[int, int]:
    """Where the first box of a kind begins and ends."""
    while start < stop:
        size, found = struct.unpack(">I4s", data[start : start + 8])
        if found == kind:
            return start, start + size
        start += size
    raise AssertionError(f"no box {kind!r}")
