"""A clip's depth maps in one zip of EXR pictures."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from vipe_core.formats.exr import decode_depth, encode_depth
from vipe_core.formats.frame_zip import FrameZipReader, FrameZipWriter


class DepthZipWriter(FrameZipWriter):
    """Appends depth maps; see `encode_depth` for what becomes of odd values."""

    suffix = "exr"

    def _encoded(self, picture: NDArray[Any]) -> bytes:
        return encode_depth(picture)


class DepthZipReader(FrameZipReader[np.float32]):
    """Reads (H, W) float32 depth; 0 where there is no value."""

    suffix = "exr"
    kind = "depth map"
    max_bytes = 1 << 30

    def _decoded(self, data: bytes, label: str) -> NDArray[np.float32]:
        return decode_depth(data, label)
