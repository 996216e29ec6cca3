"""Whether a picture is an equirectangular panorama, from the picture alone.

Its left and right border are neighbours, and its upper and lower border are a single point each, stretched to a row.
Of ordinary pictures, the borders of plain ones may look so; a border must have content to be evidence.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# Pictures are compared at this size, where grain and compression are averaged away.
_SIZE = (512, 256)
# Mean difference of the two borders, beside that of columns a quarter of the width apart. Panoramas: 0.09 to 0.13;
# other videos: 0.4 to 2.
_SEAM = 0.25
# ... and what no panorama has, though its ends be badly stitched.
_OPEN = 0.35
# Their correlation: 0.95 and more (less where the border has little content), against 0.8 and less. What has less
# contrast than this, beside the picture's, has no content to correlate.
_ALIKE, _CONTENT = 0.8, 0.2
# What is sharp in the rougher one of the upper and the lower border (standard deviation without the first harmonics,
# which a small circle around the pole has), beside the picture's: up to 0.08 in panoramas of 512 rows and 0.19 in one
# of 128, against 0.14 to 1 in others.
_POLE, _HARMONICS = 0.24, 4
# Standard deviation of the grey levels of a picture that shows anything.
_LEAST_CONTRAST = 5.0


def looks_panoramic(pictures: Sequence[NDArray[np.uint8]]) -> bool:
    """Whether all of some pictures (h, w, 3) of a video are whole panoramas; False without any."""
    return len(pictures) > 0 and all(_closes(picture) for picture in pictures)


def ends_apart(pictures: Sequence[NDArray[np.uint8]]) -> bool:
    """Whether all of some pictures (h, w, 3) of a video show that they do not go all round; False without any."""
    seams = [_Seam.of(picture) for picture in pictures]
    return len(seams) > 0 and all(seam.evident and seam.step > _OPEN for seam in seams)


@dataclass(frozen=True, slots=True)
class _Seam:
    """The left and the right border of a picture as neighbours.

    Attributes:
        gray: The small picture.
        contrast: Standard deviation of its grey levels.
        evident: Whether the borders have content to compare.
        step: Mean difference of the two, beside that of columns a quarter of the width apart.
    """

    gray: NDArray[np.float64]
    contrast: float
    evident: bool
    step: float

    @classmethod
    def of(cls, rgb: NDArray[np.uint8]) -> _Seam:
        import cv2

        small = cv2.resize(rgb, _SIZE, interpolation=cv2.INTER_AREA)
        gray = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY).astype(np.float64)
        contrast = float(gray.std())
        content = min(gray[:, 0].std(), gray[:, -1].std())
        evident = bool(contrast >= _LEAST_CONTRAST and content >= _CONTENT * contrast)
        apart = float(np.abs(gray - np.roll(gray, _SIZE[0] // 4, axis=1)).mean())
        return cls(gray, contrast, evident, float(np.abs(gray[:, 0] - gray[:, -1]).mean()) / max(apart, 1e-9))


def _closes(rgb: NDArray[np.uint8]) -> bool:
    seam = _Seam.of(rgb)
    if not seam.evident or seam.step >= _SEAM:
        return False
    gray = seam.gray
    if np.corrcoef(gray[:, 0], gray[:, -1])[0, 1] <= _ALIKE:
        return False
    return max(_sharpness(gray[0]), _sharpness(gray[-1])) < _POLE * seam.contrast


def _sharpness(row: NDArray[np.float64]) -> float:
    spectrum = np.fft.rfft(row)
    spectrum[: _HARMONICS + 1] = 0
    return float(np.fft.irfft(spectrum, len(row)).std())
