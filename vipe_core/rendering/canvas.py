"""Tiles, labels and files of pictures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vipe_core.formats.atomic import complete_file

Array = NDArray[Any]
Canvas = NDArray[np.uint8]

BACKGROUND = (20, 23, 28)
TEXT = (226, 230, 236)
_SMOOTH = 4  # letters are drawn this much larger


def grid(rows: Sequence[Sequence[Canvas]], gap: int = 6, margin: int = 0) -> Canvas:
    """Pictures of one size in rows, on the background; a row may be shorter."""
    height, width = rows[0][0].shape[:2]
    columns = max(len(row) for row in rows)
    size = (
        2 * margin + len(rows) * (height + gap) - gap,
        2 * margin + columns * (width + gap) - gap,
    )
    canvas = np.empty((*size, 3), np.uint8)
    canvas[:] = BACKGROUND
    for y, row in enumerate(rows):
        for x, picture in enumerate(row):
            top, left = margin + y * (height + gap), margin + x * (width + gap)
            canvas[top : top + height, left : left + width] = picture
    return canvas


def fitted(picture: Canvas, width: int) -> Canvas:
    """The picture at this width."""
    height = max(1, round(picture.shape[0] * width / picture.shape[1]))
    smaller = width < picture.shape[1]
    resized = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA if smaller else cv2.INTER_CUBIC)
    return np.asarray(resized, np.uint8)


def label(picture: Canvas, text: str, *, height_px: int = 15) -> Canvas:
    """The picture with a small text in its lower left corner, readable on anything."""
    scale = _SMOOTH * height_px / 30
    (wide, high), below = cv2.getTextSize(text, cv2.FONT_HERSHEY_DUPLEX, scale, 2)
    pad = _SMOOTH * height_px // 3
    plate = np.zeros((high + below + 2 * pad, wide + 2 * pad), np.uint8)
    cv2.putText(plate, text, (pad, high + pad), cv2.FONT_HERSHEY_DUPLEX, scale, 255, 3, cv2.LINE_AA)
    size = (plate.shape[1] // _SMOOTH, plate.shape[0] // _SMOOTH)
    letters = cv2.resize(plate, size, interpolation=cv2.INTER_AREA).astype(np.float32)[..., None] / 255
    out = picture.copy()
    inset = height_px // 2
    top, left = max(0, picture.shape[0] - size[1] - inset), min(inset, max(0, picture.shape[1] - size[0]))
    place = out[top : top + size[1], left : left + size[0]]
    letters = letters[: place.shape[0], : place.shape[1]]
    dark = 0.45 * place + 0.55 * np.array(BACKGROUND)
    place[:] = np.rint((1 - letters) * dark + letters * np.array(TEXT)).astype(np.uint8)
    return out


def save(picture: Canvas, out: Path, *, quality: int = 90) -> Path:
    """Write a `.jpg` or `.png`."""
    flags = [cv2.IMWRITE_JPEG_QUALITY, quality] if out.suffix == ".jpg" else []
    _, data = cv2.imencode(out.suffix, np.ascontiguousarray(picture[..., ::-1]), flags)
    with complete_file(out) as partial:
        partial.write_bytes(data.tobytes())
    return out


def save_animation(pictures: Sequence[Canvas], out: Path, *, fps: float, quality: int = 48) -> Path:
    """Write an animated `.webp` that runs for ever."""
    film = cv2.Animation()
    film.frames = [np.ascontiguousarray(picture[..., ::-1]) for picture in pictures]
    film.durations = [round(1000 / fps)] * len(pictures)
    film.loop_count = 0
    _, data = cv2.imencodeanimation(".webp", film, [cv2.IMWRITE_WEBP_QUALITY, quality])
    with complete_file(out) as partial:
        partial.write_bytes(data.tobytes())
    return out
