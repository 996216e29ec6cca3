"""Reading the images of a directory, as it runs inside of the decoder child (OpenCV: EXIF orientation, 8 bit, RGB)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from vipe_core.errors import CorruptMedia, MediaTooLarge
from vipe_core.video.limits import Limits
from vipe_core.video.opened import OpenedMedia


def read_image(media: OpenedMedia, limits: Limits) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 RGB, upright after EXIF; grey is repeated, 16 bit keeps its upper 8, alpha is dropped.

    Raises:
        CorruptMedia: The file cannot be decoded; names it.
        MediaTooLarge: The picture exceeds `limits`.
    """
    label = media.label
    media.file.seek(0)
    data = np.frombuffer(media.file.read(), dtype=np.uint8)
    try:
        bgr = cv2.imdecode(data, cv2.IMREAD_COLOR) if len(data) else None
    except cv2.error as error:
        if "CV_IO_MAX_IMAGE" in str(error):
            raise MediaTooLarge(
                f"{label}: the image exceeds the limit of {limits.max_pixels} pixels; scale it down"
            ) from error
        bgr = None
    if bgr is None:
        raise CorruptMedia(f"{label}: the image cannot be decoded; replace or remove it")
    limits.check_picture(label, bgr.shape[1], bgr.shape[0])
    rgb: NDArray[np.uint8] = cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)
    return rgb


def read_images(
    images: Sequence[OpenedMedia],
    limits: Limits,
    size: tuple[int, int] | None,
    start: int,
    stop: int | None,
    on_progress: Callable[[], None],
) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    """Images [start, stop) as (index, rgb), area-resized to `size` = (width, height).

    Raises:
        CorruptMedia: An image cannot be decoded, or is not of the size of the first one; names it.
    """
    first = read_image(images[0], limits)
    for index in range(start, min(len(images), len(images) if stop is None else stop)):
        rgb = first if index == 0 else read_image(images[index], limits)
        on_progress()
        if rgb.shape != first.shape:
            raise CorruptMedia(
                f"{images[index].label}: {rgb.shape[1]}x{rgb.shape[0]} pixels where the first image has "
                f"{first.shape[1]}x{first.shape[0]}; all images must have one size"
            )
        if size is not None and size != (rgb.shape[1], rgb.shape[0]):
            rgb = np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
        yield index, rgb
