"""Dense depth of every frame: plane sweep over nearby frames, checked between frames, completed along edges."""

from vipe_core.depth.stream import DenseDepth
from vipe_core.depth.types import DepthFrame, DepthSettings, SceneMap

__all__ = ["DenseDepth", "DepthFrame", "DepthSettings", "SceneMap"]
