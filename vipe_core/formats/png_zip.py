"""A clip's 8-bit pictures in one zip of PNG: instance masks, confidence, and where each depth value comes from."""

from __future__ import annotations

import struct
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vipe_core.errors import FormatError
from vipe_core.formats.exr import MAX_PIXELS
from vipe_core.formats.frame_zip import FrameZipReader, FrameZipWriter

_PNG_LEVEL = 3
# What is filled in has no more confidence than this, what is measured no less.
_FILLED_CONFIDENCE = 0.05


class MaskZipWriter(FrameZipWriter):
    """Appends (H, W) uint8 masks."""

    suffix = "png"

    def _encoded(self, picture: NDArray[Any]) -> bytes:
        return _png(picture)


class MaskZipReader(FrameZipReader[np.uint8]):
    """Reads (H, W) uint8 instance ids; 0 is background."""

    suffix = "png"
    kind = "mask"
    max_bytes = 1 << 28

    def _decoded(self, data: bytes, label: str) -> NDArray[np.uint8]:
        return _picture(data, label)


class KindZipWriter(MaskZipWriter):
    """Appends (H, W) uint8 classes of `annotation.DEPTH_KINDS`."""


class KindZipReader(MaskZipReader):
    """Reads (H, W) uint8 classes of `annotation.DEPTH_KINDS`."""

    kind = "map of depth kinds"


class ConfidenceZipWriter(FrameZipWriter):
    """Appends (H, W) confidence in 0..1; what is not 0 stays above 0.

    It is known to a tenth or so: steps of 1/15 take a third of the bytes that steps of 1/255 would. Up to 0.05, which
    is of what is filled in, the steps are 4/255.
    """

    suffix = "png"

    def _encoded(self, picture: NDArray[Any]) -> bytes:
        low = np.maximum(np.rint(picture * np.float32(255 / 4)) * 4, 1)
        high = np.maximum(np.rint(picture * np.float32(15)), 1) * 17
        steps = np.where(picture > _FILLED_CONFIDENCE, high, np.where(picture > 0, low, 0))
        return _png(np.clip(steps, 0, 255).astype(np.uint8), cv2.IMWRITE_PNG_STRATEGY_RLE)


class ConfidenceZipReader(FrameZipReader[np.float32]):
    """Reads (H, W) float32 confidence in 0..1; what was filled in has 0.05 at most."""

    suffix = "png"
    kind = "confidence map"
    max_bytes = 1 << 28

    def _decoded(self, data: bytes, label: str) -> NDArray[np.float32]:
        return _picture(data, label) * np.float32(1 / 255)


def _png(picture: NDArray[Any], strategy: int = cv2.IMWRITE_PNG_STRATEGY_DEFAULT) -> bytes:
    how = [cv2.IMWRITE_PNG_COMPRESSION, _PNG_LEVEL, cv2.IMWRITE_PNG_STRATEGY, strategy]
    _, data = cv2.imencode(".png", picture, how)
    return data.tobytes()


def _picture(data: bytes, label: str) -> NDArray[np.uint8]:
    width, height = struct.unpack(">II", data[16:24]) if len(data) > 24 else (0, 0)
    if width * height > MAX_PIXELS:
        raise FormatError(f"{label}: a picture of {width}x{height} pixels exceeds what is read")
    try:
        picture = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_UNCHANGED) if data else None
    except cv2.error:
        picture = None
    if picture is None or picture.dtype != np.uint8 or picture.ndim != 2:
        raise FormatError(f"{label}: not an 8-bit picture of one channel")
    return np.asarray(picture, dtype=np.uint8)
