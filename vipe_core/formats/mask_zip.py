"""A clip's masks in one zip of 8-bit PNG pictures of instance ids."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vipe_core.errors import FormatError
from vipe_core.formats.frame_zip import FrameZipReader, FrameZipWriter

_PNG_LEVEL = 3


class MaskZipWriter(FrameZipWriter):
    """Appends (H, W) uint8 masks."""

    suffix = "png"

    def _encoded(self, picture: NDArray[Any]) -> bytes:
        _, data = cv2.imencode(".png", picture, [cv2.IMWRITE_PNG_COMPRESSION, _PNG_LEVEL])
        return data.tobytes()


class MaskZipReader(FrameZipReader[np.uint8]):
    """Reads (H, W) uint8 instance ids; 0 is background."""

    suffix = "png"
    kind = "mask"
    max_bytes = 1 << 28

    def _decoded(self, data: bytes, label: str) -> NDArray[np.uint8]:
        mask = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_UNCHANGED) if data else None
        if mask is None or mask.dtype != np.uint8 or mask.ndim != 2:
            raise FormatError(f"{label}: not an 8-bit picture of one channel")
        return np.asarray(mask, dtype=np.uint8)
