"""Which things are followed through a video: detection at intervals, propagation between, ids that stay.

Paper section 3.1 and the reference's rules, with what those leave open: overlapping things share out their pixels by
how sure the network is, an id outlives an occlusion, and things that stay away are forgotten, so that neither time nor
memory of a frame grows with the length of the video.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from vipe_core.annotation import FIRST_INSTANCE, LAST_INSTANCE
from vipe_core.priors.instance_settings import STATIC_PHRASES, InstanceSettings
from vipe_core.priors.protocols import Instances
from vipe_core.video.source import Frame

Array = NDArray[Any]

# Times of frames are sums and quotients.
_ROUNDING_S = 1e-6


@dataclass(frozen=True, slots=True)
class Detection:
    """A box around a thing.

    Attributes:
        box_px: Left, top, right and bottom edge in pixels from the corner of the picture.
        score: How sure, 0..1.
        phrase: Which of the phrases it is.
    """

    box_px: tuple[float, float, float, float]
    score: float
    phrase: str


class Detector(Protocol):
    def detect(self, rgb: NDArray[np.uint8], phrases: Sequence[str], min_score: float) -> list[Detection]:
        """Boxes of at least this score around what the phrases name in a picture (h, w, 3), in no order."""


class Propagation(Protocol):
    """Things followed through the frames of one video."""

    @property
    def ids(self) -> tuple[int, ...]:
        """Of what is followed."""

    def advance(self, rgb: NDArray[np.uint8]) -> Tensor:
        """Go on to the next frame: (len(ids), a, b) where each is, a logit per pixel of a smaller picture."""

    def outline(self, boxes_px: Array) -> Tensor:
        """(n, a, b) logits of what is in each of the (n, 4) boxes in this frame."""

    def add(self, rows: Mapping[int, int]) -> None:
        """Follow from this frame on, by id, these rows of the last `outline`."""

    def forget(self, ids: Iterable[int]) -> None:
        """Follow these no more."""


class Propagator(Protocol):
    def begin(self) -> Propagation: ...


class FollowedInstances:
    """`InstanceMasks` from a detector and a propagator.

    Args:
        size: (longest, shortest) sides of the pictures that the detector sees at most.
    """

    def __init__(
        self, detector: Detector, propagator: Propagator, settings: InstanceSettings, size: tuple[int, int]
    ) -> None:
        self._detector = detector
        self._propagator = propagator
        self._settings = settings
        self._size = size

    def input_size(self, width: int, height: int) -> tuple[int, int]:
        """At most the detector's, with the aspect of the video; never enlarged."""
        scale = min(1.0, self._size[0] / max(width, height), self._size[1] / min(width, height))
        return max(1, round(width * scale)), max(1, round(height * scale))

    def follow(self, frames: Iterable[Frame]) -> Iterator[Instances]:
        """See `InstanceMasks.follow`."""
        one = _Following(self._detector, self._propagator.begin(), self._settings)
        for frame in frames:
            yield one.step(frame)


class _Following:
    """The things of one video."""

    def __init__(self, detector: Detector, propagation: Propagation, settings: InstanceSettings) -> None:
        self._detector = detector
        self._propagation = propagation
        self._settings = settings
        self._phrases: dict[int, str] = {}
        self._missed: dict[int, int] = {}
        self._forgotten: list[int] = []
        self._next_s = -float("inf")

    def step(self, frame: Frame) -> Instances:
        logits = self._propagation.advance(frame.rgb)
        ids = composed(logits, self._propagation.ids, frame.rgb.shape[:2])
        if frame.timestamp_s >= self._next_s - _ROUNDING_S:
            # From this frame, not from when it was due: a gap in the video asks for one detection, not for several.
            self._next_s = frame.timestamp_s + self._settings.interval_s
            self._retire(ids)
            ids = self._discover(frame.rgb, ids)
        return Instances(self._widened(ids), dict(self._phrases))

    def _retire(self, ids: NDArray[np.uint8]) -> None:
        """Forget what has been out of sight for long."""
        seen = np.bincount(ids.ravel(), minlength=LAST_INSTANCE + 1) > 0
        self._missed = {number: 0 if seen[number] else count + 1 for number, count in self._missed.items()}
        gone = [number for number, count in self._missed.items() if count >= self._settings.patience]
        for number in gone:
            del self._missed[number]
        self._forgotten += gone
        self._propagation.forget(gone)

    def _discover(self, rgb: NDArray[np.uint8], ids: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The map with the things that are new in it, which are followed from now on."""
        settings, (height, width) = self._settings, rgb.shape[:2]
        found = self._detector.detect(rgb, settings.phrases, settings.min_score)
        # The surest first: what overlaps it after that is the same thing by another name.
        found = sorted(found, key=lambda one: (-one.score, one.box_px, one.phrase))
        if not found:
            return ids
        logits = self._propagation.outline(np.array([one.box_px for one in found], np.float64))
        claimed = ids > 0
        new: list[tuple[int, NDArray[np.bool_]]] = []
        for row, region in enumerate(_regions(logits, (height, width))):
            area = int(region.sum())
            if area < settings.min_share * region.size or (region & ~claimed).sum() < settings.min_unclaimed * area:
                continue
            new.append((row, region & ~claimed))
            claimed |= region
        covered = sum(int(region.sum()) for row, region in new if found[row].phrase not in STATIC_PHRASES)
        if covered > settings.max_share * height * width:
            new = [(row, region) for row, region in new if found[row].phrase in STATIC_PHRASES]
        rows: dict[int, int] = {}
        for row, region in new:
            number = self._number(found[row].phrase)
            if number is None:
                continue
            ids[region] = number
            rows[number] = row
            self._missed[number] = 0
        self._propagation.add(rows)
        return ids

    def _number(self, phrase: str) -> int | None:
        """An id for a new thing. Once there are no more, that of the one of its kind that was forgotten first; None
        where there is none."""
        number = FIRST_INSTANCE + len(self._phrases)
        if number <= LAST_INSTANCE:
            self._phrases[number] = phrase
            return number
        again = next((old for old in self._forgotten if self._phrases[old] == phrase), None)
        if again is not None:
            self._forgotten.remove(again)
        return again

    def _widened(self, ids: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Things that may move grow into what is around them and into the sky."""
        still = [number for number, phrase in self._phrases.items() if phrase in STATIC_PHRASES]
        moving = np.where(np.isin(ids, still), 0, ids).astype(np.uint8)
        side = 2 * self._settings.margin_px + 1
        grown = cv2.dilate(moving, np.ones((side, side), np.uint8))
        return np.where((moving == 0) & (grown > 0), grown, ids).astype(np.uint8)


def composed(logits: Tensor, ids: Sequence[int], shape: tuple[int, ...]) -> NDArray[np.uint8]:
    """(h, w) ids of whatever has the highest logit above 0 in each pixel; 0 where nothing has.

    Args:
        logits: (n, a, b) of the things.
        ids: (n,) theirs.
        shape: (h, w).
    """
    height, width = shape[:2]
    best = torch.zeros((height, width), device=logits.device)
    found = torch.zeros((height, width), dtype=torch.uint8, device=logits.device)
    # One at a time: a crowd at full size would take gigabytes.
    for number, one in zip(ids, logits, strict=True):
        value = _enlarged(one, (height, width))
        above = value > best
        best = torch.where(above, value, best)
        found = torch.where(above, torch.full_like(found, number), found)
    return np.ascontiguousarray(found.cpu().numpy())


def _regions(logits: Tensor, shape: tuple[int, int]) -> Iterator[NDArray[np.bool_]]:
    for one in logits:
        yield np.asarray((_enlarged(one, shape) > 0).cpu().numpy(), np.bool_)


def _enlarged(logits: Tensor, shape: tuple[int, int]) -> Tensor:
    """(h, w) float32 of a smaller picture (a, b)."""
    large = torch.nn.functional.interpolate(logits.float()[None, None], size=shape, mode="bilinear")
    return large[0, 0]
