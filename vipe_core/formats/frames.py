"""A sequence on disk, frame by frame, for everything that is made of it: exports, clouds, pictures."""

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import ExitStack, closing
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vipe_core.annotation import MEASURED, MOVING
from vipe_core.errors import FormatError
from vipe_core.formats.reading import Artifacts
from vipe_core.fusion import SurfaceView, surface_weight


@dataclass(frozen=True, slots=True)
class ArtifactFrame:
    """One frame of a sequence.

    Attributes:
        index: Row of the poses.
        rgb: (H, W, 3) uint8.
        depth: (H, W) float32, 0 is no value; the artifacts say of what kind.
        confidence: (H, W) float32 in 0..1, or None where the sequence has none.
        kind: (H, W) uint8 classes of `annotation.DEPTH_KINDS`, or None.
        mask: (H, W) uint8 instance ids, or None.
    """

    index: int
    rgb: NDArray[np.uint8]
    depth: NDArray[np.float32]
    confidence: NDArray[np.float32] | None
    kind: NDArray[np.uint8] | None
    mask: NDArray[np.uint8] | None

    @property
    def moving(self) -> NDArray[np.bool_] | None:
        """(H, W) bool of what moves by itself, or None where the sequence does not say."""
        if self.mask is None:
            return None if self.kind is None else self.kind == MOVING
        return self.mask > 0 if self.kind is None else (self.mask > 0) | (self.kind == MOVING)

    def view(self, artifacts: Artifacts, min_confidence: float = 0.0) -> SurfaceView:
        """The frame as fusion takes it: what moves and what nobody measured stays out."""
        out = self.moving
        if self.kind is not None:
            out = self.kind != MEASURED if out is None else out | (self.kind != MEASURED)
        weight = surface_weight(self.depth, confidence=self.confidence, mask=out, min_confidence=min_confidence)
        return SurfaceView(artifacts.world_from_cam[self.index], self.rgb, self.depth, weight)


def read_frames(
    artifacts: Artifacts, wanted: Callable[[int], bool] | None = None
) -> Generator[ArtifactFrame, None, None]:
    """Frames in order, one in memory at a time. Closing the generator ends the decoder.

    Args:
        wanted: Which frames to give, by index; all if None.

    Raises:
        FormatError: The sequence has no depth or no rgb, or they do not fit together.
    """
    if artifacts.rgb_path is None or not artifacts.has_depth:
        missing = "rgb" if artifacts.rgb_path is None else "depth"
        raise FormatError(f"{artifacts.name}: the attribute {missing} is needed and is not there")
    size = (artifacts.camera.height, artifacts.camera.width)
    with ExitStack() as stack:
        depth = stack.enter_context(artifacts.open_depth())
        confidence = stack.enter_context(artifacts.open_confidence()) if artifacts.has_confidence else None
        kind = stack.enter_context(artifacts.open_kind()) if artifacts.has_confidence else None
        mask = stack.enter_context(artifacts.open_mask()) if artifacts.has_mask else None
        stream = stack.enter_context(closing(artifacts.pictures()))
        index = -1
        for index, picture in enumerate(stream):
            if wanted is not None and not wanted(index):
                continue
            frame = ArtifactFrame(
                index,
                picture,
                depth.read(index),
                confidence.read(index) if confidence is not None else None,
                kind.read(index) if kind is not None else None,
                mask.read(index) if mask is not None else None,
            )
            maps = (frame.depth, frame.confidence, frame.kind, frame.mask)
            if frame.rgb.shape[:2] != size or any(m is not None and m.shape != size for m in maps):
                raise FormatError(f"{artifacts.name}: frame {index} is not of the size {size[1]}x{size[0]} everywhere")
            yield frame
        if index + 1 < artifacts.num_frames:
            raise FormatError(f"rgb/{artifacts.name}.mp4: {index + 1} frames for {artifacts.num_frames} poses")


def spread(count: int, most: int) -> set[int]:
    """At most `most` of `count` indices, evenly spread, the first and the last among them."""
    return set(np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(np.int64)).tolist())
