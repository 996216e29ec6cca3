"""Video depth by Video Depth Anything (Chen et al., 2025), paper section 3.3, a window of frames at a time.

The reference gives it the whole clip. Here it sees one window, and `depth.windows` joins them: memory is that of a
window, whatever the length of the video.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from vipe_core.annotation import DepthKind
from vipe_core.priors.hf.images import normalised, resized
from vipe_core.priors.nvidia_vipe.loading import filled, part, tensors

VideoDepthSize = Literal["vits", "vitl"]

WINDOW_FRAMES, OVERLAP_FRAMES = 32, 10
"""Frames that the network was trained to see at once, and those that its authors have two windows share."""

_SHORTEST, _PATCH = 518, 14
# Beyond this aspect its authors take smaller pictures, for memory.
_WIDEST_ASPECT = 1.777
HEADS: dict[VideoDepthSize, dict[str, Any]] = {
    "vits": {"features": 64, "out_channels": [48, 96, 192, 384]},
    "vitl": {"features": 256, "out_channels": [256, 512, 1024, 1024]},
}
"""What the head of each size is built with."""


class VideoDepthAnything:
    """`VideoDepth` by Video Depth Anything.

    Args:
        model: The package's network.
        half: Whether to compute in float16, as its authors do with the large one.
        shortest: Shorter side of its pictures.
    """

    def __init__(self, model: Any, device: torch.device, *, half: bool = False, shortest: int = _SHORTEST) -> None:
        self._model = model
        self._device = device
        self._half = half and device.type == "cuda"
        self._shortest = shortest

    @classmethod
    def load(cls, path: Path, which: VideoDepthSize, device: torch.device) -> VideoDepthAnything:
        """The network in a file.

        Raises:
            LibraryMissing, WeightsMissing, WeightsInvalid: See `loading`.
        """
        (build,) = part("depth.videodepthanything.video_depth", "VideoDepthAnything")
        model = filled(build(encoder=which, **HEADS[which]), tensors(path), path.name, device)
        return cls(model, device, half=which == "vitl")

    @property
    def depth_kind(self) -> DepthKind:
        return "z"

    @property
    def window_frames(self) -> int:
        return WINDOW_FRAMES

    @property
    def overlap_frames(self) -> int:
        return OVERLAP_FRAMES

    def input_size(self, width: int, height: int) -> tuple[int, int]:
        """Whole patches of the network with the aspect of the video, up to a patch."""
        aspect = max(width, height) / min(width, height)
        shortest = min(1.0, _WIDEST_ASPECT / aspect) * self._shortest
        scale = shortest / min(width, height)
        across, down = (max(1, round(side * scale / _PATCH)) * _PATCH for side in (width, height))
        return across, down

    def predict(self, frames: Sequence[NDArray[np.uint8]]) -> NDArray[np.float32]:
        """See `VideoDepth.predict`. A shorter run is filled up with its last frame, as the network wants a window."""
        height, width = frames[0].shape[:2]
        size = self.input_size(width, height)
        pictures = [normalised(frame, size, self._device) for frame in frames]
        pictures += pictures[-1:] * (WINDOW_FRAMES - len(pictures))
        with torch.inference_mode(), torch.autocast(self._device.type, torch.float16, enabled=self._half):
            found = self._model(torch.stack(pictures, dim=1))[0, : len(frames)]
        return np.stack([resized(one, height, width) for one in found])
