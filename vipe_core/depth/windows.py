"""Video depth of a whole shot from a model that sees a window at a time.

Windows agree only up to a scale and a shift of inverse depth: each is mapped onto the one before it by the frames that
both see, and faded into it over them.
"""

from __future__ import annotations

from collections.abc import Generator, Iterable, Iterator
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vipe_core.depth.alignment import Affine, Samples, measure
from vipe_core.errors import EngineError
from vipe_core.priors.protocols import VideoDepth
from vipe_core.video.source import Frame

Array = NDArray[Any]

# Pixels of each common frame that the map between windows is fitted to.
_PIXELS = 2000


def stitched(video: VideoDepth, frames: Iterable[Frame]) -> Generator[tuple[Frame, NDArray[np.float32]], None, None]:
    """The frames of one shot with their inverse depth (h, w), all in the scale and shift of the first window.

    Holds one window and its overlap. NaN where the model says nothing.

    Raises:
        EngineError: The model does not keep to its protocol.
    """
    window, overlap = video.window_frames, video.overlap_frames
    if not 2 <= overlap < window:
        raise EngineError(f"video depth with windows of {window} frames cannot overlap by {overlap}")
    source: Iterator[Frame] = iter(frames)
    held: list[Frame] = []
    maps = np.zeros((0, 0, 0), np.float32)
    coming = list(islice(source, window))
    while coming:
        batch = held + coming
        found = _predicted(video, batch)
        if held:
            alpha, beta = _between(found[: len(held)], maps)
            found = alpha * found + beta
            share = (np.arange(1, len(held) + 1, dtype=np.float32) / (len(held) + 1))[:, None, None]
            found[: len(held)] = _faded(maps, found[: len(held)], share)
        coming = list(islice(source, window - overlap))
        ready = len(batch) - overlap if coming else len(batch)
        yield from zip(batch[:ready], found[:ready], strict=True)
        held, maps = batch[ready:], found[ready:].copy()


def _predicted(video: VideoDepth, batch: list[Frame]) -> NDArray[np.float32]:
    found = np.array(video.predict([frame.rgb for frame in batch]), np.float32)
    wanted = (len(batch), *batch[0].rgb.shape[:2])
    if found.shape != wanted:
        raise EngineError(f"video depth of {wanted[0]} frames must be {wanted}, the provider gave {found.shape}")
    found[~np.isfinite(found)] = np.nan
    return found


def _between(new: Array, old: Array) -> Affine:
    """What maps the new window onto the old one, from the frames of both."""
    step = max(1, old[0].size // _PIXELS)
    x, y = (maps.reshape(len(maps), -1)[:, ::step].ravel().astype(np.float64) for maps in (new, old))
    both = np.isfinite(x) & np.isfinite(y)
    if both.sum() < 3:
        return 1.0, 0.0
    x, y = x[both], y[both]
    # The fit wants inverse depths, which are positive; those of an affine model are only so up to a shift.
    low, high = np.quantile(y, (0.001, 0.999))
    lift = max(0.0, 0.3 * float(high - low) - float(low))
    spread_x, spread_y = (float(np.subtract(*np.quantile(values, (0.9, 0.1)))) for values in (x, y))
    scale = spread_y / spread_x if spread_x > 0 and spread_y > 0 else 1.0
    start = (scale, float(np.median(y + lift) - scale * np.median(x)))
    found = measure(Samples(x, y + lift, np.ones_like(x)), start)
    if found is None:
        return start[0], start[1] - lift
    alpha, beta = found.solution(start)
    return alpha, beta - lift


def _faded(old: Array, new: Array, share: Array) -> NDArray[np.float32]:
    """From one to the other; where only one says something, that one."""
    mixed = (1 - share) * old + share * new
    return np.where(np.isnan(old), new, np.where(np.isnan(new), old, mixed)).astype(np.float32)
