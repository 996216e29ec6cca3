"""One depth map <-> one EXR image: scanline, a single HALF channel `Z`, ZIP compression (the layout ViPE writes)."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import OpenEXR
from numpy.typing import NDArray

from vipe_core.errors import FormatError

CHANNEL = "Z"
# Largest finite half; a far value is kept as far instead of becoming infinite.
MAX_DEPTH = 65504.0
# As large as a picture may be by default (`vipe_core.video.Limits`).
MAX_PIXELS = 1 << 26
MAX_SIDE_PX = 1 << 16
# Smallest half with full precision is 6e-5; anything below the smallest positive half would read back as "no value".
_MIN_DEPTH = 2.0**-24


def encode_depth(depth: NDArray[np.floating]) -> bytes:
    """(H, W) depth -> bytes of an EXR file. Same values, same bytes.

    0 means "no value"; NaN, infinities and negative values become 0; values beyond the range of a half are clamped.

    Raises:
        ValueError: Not a two-dimensional, non-empty array.
    """
    if depth.ndim != 2 or depth.size == 0:
        raise ValueError(f"a depth map has two dimensions, got {depth.shape}")
    valid = np.isfinite(depth) & (depth > 0)
    # The library takes the buffer for row-major whatever its strides say.
    half = np.ascontiguousarray(np.where(valid, np.clip(depth, _MIN_DEPTH, MAX_DEPTH), 0), dtype=np.float16)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    # The library's Python interface only knows file names.
    with tempfile.TemporaryDirectory(prefix="exr-") as folder:
        path = Path(folder, "depth.exr")
        OpenEXR.File(header, {CHANNEL: half}).write(str(path))
        return path.read_bytes()


def decode_depth(data: bytes, label: str = "depth map") -> NDArray[np.float32]:
    """Bytes of an EXR file -> (H, W) float32; 0 where there is no value.

    Args:
        data: A whole EXR file with a channel `Z` of any pixel type.
        label: Name for messages.

    Raises:
        FormatError: Not an EXR image, or one without a channel `Z`.
    """
    with tempfile.TemporaryDirectory(prefix="exr-") as folder:
        path = Path(folder, "depth.exr")
        path.write_bytes(data)
        try:
            header = OpenEXR.File(str(path), header_only=True).header()
            low, high = (np.asarray(corner, dtype=np.int64) for corner in header["dataWindow"])
            width, height = (int(side) for side in high - low + 1)
            # The library makes room for what the header claims before it looks for the pixels.
            if not (0 < width <= MAX_SIDE_PX and 0 < height <= MAX_SIDE_PX and width * height <= MAX_PIXELS):
                raise FormatError(f"{label}: a depth map of {width}x{height} pixels exceeds what is read")
            channels = OpenEXR.File(str(path)).channels()
        except (RuntimeError, ValueError, TypeError, OSError, KeyError, MemoryError) as error:
            raise FormatError(f"{label}: not a readable EXR image; write the artifact again") from error
    if CHANNEL not in channels:
        raise FormatError(f"{label}: the EXR image has no channel {CHANNEL!r}, only {sorted(channels)}")
    pixels: NDArray[np.float32] = np.asarray(channels[CHANNEL].pixels, dtype=np.float32)
    if pixels.ndim != 2:
        raise FormatError(f"{label}: channel {CHANNEL!r} has shape {pixels.shape}, two dimensions are needed")
    return pixels
