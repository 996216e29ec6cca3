"""The stream of a preset without dense depth: pictures and what moves in them, and no value anywhere."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import closing

import numpy as np

from vipe_core.ba.problem import Grid
from vipe_core.depth.types import MOVING, UNOBSERVED, DepthFrame, SceneMap
from vipe_core.errors import EngineError
from vipe_core.slam.segmentation import segment
from vipe_core.video.source import FrameSource


class NoDepth:
    """The depth stage where none is made."""

    def stream(self, source: FrameSource, scene: SceneMap) -> Generator[DepthFrame, None, None]:
        """Every frame of the video, in order, with a depth and a confidence of 0.

        Raises:
            EngineError: The video has another number of frames than before.
            InputError, DecodeError: From the source.
        """
        grid = Grid(scene.camera.height // 8, scene.camera.width // 8)
        count = 0
        with closing(source.frames()) as frames:
            for frame in frames:
                moving = np.zeros(frame.rgb.shape[:2], np.bool_)
                if scene.labels is not None and frame.index < len(scene.labels):
                    moving |= segment(frame.rgb, scene.labels[frame.index], grid) > 0
                if frame.masked is not None:
                    moving |= frame.masked
                nothing = np.zeros(moving.shape, np.float32)
                kind = np.where(moving, np.uint8(MOVING), np.uint8(UNOBSERVED))
                count += 1
                yield DepthFrame(frame.index, frame.rgb, nothing, nothing, kind, moving)
        if count != len(scene.world_from_cam):
            raise EngineError(f"the video gave {count} frames, but {len(scene.world_from_cam)} poses were found in it")
