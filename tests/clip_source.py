"""A rendered clip as the pipeline sees it: a source of its frames, and the map that bundle adjustment would leave."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from vipe_core.depth.types import SceneMap
from vipe_core.evaluation.synthetic.clip import SyntheticClip
from vipe_core.geometry.arrays import inverse
from vipe_core.video.source import Frame, FrameStream, VideoInfo


@dataclass
class ClipSource:
    """A `FrameSource` over rendered frames that counts the open streams and the frames read at another size."""

    rgb: NDArray[np.uint8]
    masked: NDArray[np.bool_] | None = None
    open: int = 0
    decoded: int = 0

    @property
    def info(self) -> VideoInfo:
        n, h, w = self.rgb.shape[:3]
        return VideoInfo("clip", "clip", w, h, 24.0, n, n / 24, 0, "none", "rgb24", 0)

    def frames(self, size: tuple[int, int] | None = None, start: int = 0, stop: int | None = None) -> FrameStream:
        self.open += 1
        try:
            for index, rgb in list(enumerate(self.rgb))[start:stop]:
                self.decoded += size is not None
                picture = rgb if size is None else cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
                masked = None if self.masked is None else self.masked[index]
                if masked is not None and size is not None:
                    masked = cv2.resize(masked.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
                yield Frame(index, index / 24, np.asarray(picture, np.uint8), masked)
        finally:
            self.open -= 1


def scene_of(
    clip: SyntheticClip, every: int = 4, noise: float = 0.02, confidence: float = 0.8, unit_m: float | None = None
) -> SceneMap:
    """Noisy inverse depth at the cells of every few frames, without confidence where the depth jumps.

    Args:
        unit_m: Unit of lengths, in a world that is the first camera; None leaves the clip's metres and world.
    """
    n, height, width = clip.depth.shape
    keyframes = np.arange(0, n, every)
    inside = clip.depth[keyframes, : height // 8 * 8, : width // 8 * 8]
    blocks = (1 / inside).reshape(len(keyframes), height // 8, 8, width // 8, 8)
    value, spread = blocks.mean((2, 4)), blocks.max((2, 4)) / blocks.min((2, 4))
    value = value * np.exp(noise * np.random.default_rng(3).standard_normal(value.shape))
    sure = np.where(spread < 1.2, confidence, 0.0)
    poses = clip.world_from_cam
    if unit_m is not None:
        poses = inverse(poses[:1]) @ poses
        poses[:, :3, 3] /= unit_m
        value = value * unit_m
    return SceneMap(clip.camera, poses, keyframes, value.astype(np.float32), sure.astype(np.float32))
