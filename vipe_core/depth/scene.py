"""What the depth stage takes from the SLAM stage."""

from __future__ import annotations

import numpy as np

from vipe_core.depth.types import SceneMap
from vipe_core.slam.system import SlamResult


def scene_of(result: SlamResult) -> SceneMap:
    """The map of a video; moving cells are not to be trusted."""
    shape = (len(result.keyframes), result.grid.height, result.grid.width)
    return SceneMap(
        camera=result.camera,
        world_from_cam=result.world_from_cam,
        keyframes=result.keyframes,
        inverse_depth=result.inverse_depth.reshape(shape),
        confidence=np.where(result.static, result.map.confidence, np.float32(0)).reshape(shape),
        cuts=result.cuts,
        labels=result.trajectory.labels,
    )
