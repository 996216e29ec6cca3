"""A rig before the wavy wall of `exact_scene`, with exact measurements within and between its views."""

from __future__ import annotations

from collections.abc import Generator, Sequence

import numpy as np
from exact_scene import CAMERA, HEIGHT, WIDTH, ExactScene
from numpy.typing import NDArray

from vipe_core.geometry.arrays import exp
from vipe_core.priors.protocols import WorkingFrame
from vipe_core.video.source import Frame, VideoInfo


def fan_of_cameras(count: int, spacing: float, yaw_deg: float) -> NDArray[np.float64]:
    """(V, 4, 4) cam_from_rig side by side, each turned outwards."""
    middle = (count - 1) / 2
    mounts = []
    for view in range(count):
        turn = exp(np.array([0, 0, 0, 0, -np.radians(yaw_deg) * (view - middle), 0]))
        shift = np.eye(4)
        shift[0, 3] = -spacing * (view - middle)
        mounts.append(turn @ shift)
    return np.stack(mounts)


class ExactRig(ExactScene):
    """Truth of V N views of the wall, the views of an instant together; the source of the rig, and its providers.

    The features of a view are its number among them all, which the picture tells.
    """

    def __init__(self, rig_from_world: NDArray[np.float64], cam_from_rig: NDArray[np.float64], **kwargs: float) -> None:
        self.rig_from_world, self.cam_from_rig = rig_from_world, cam_from_rig
        self.num_views = len(cam_from_rig)
        poses = (cam_from_rig[None] @ rig_from_world[:, None]).reshape(-1, 4, 4)
        super().__init__(poses, **kwargs)

    def encode(self, frame: WorkingFrame) -> int:
        return frame.index * self.num_views + int(frame.rgb[0, 0, 0])

    @property
    def infos(self) -> Sequence[VideoInfo]:
        return [
            VideoInfo(f"view{v}", "exact", WIDTH, HEIGHT, 30.0, None, None, 0, "none", "rgb24", 0)
            for v in range(self.num_views)
        ]

    def instants(
        self, size: tuple[int, int] | None = None, start: int = 0, stop: int | None = None
    ) -> Generator[tuple[Frame, ...], None, None]:
        for index in range(len(self.rig_from_world))[start:stop]:
            yield tuple(
                Frame(index, index / 30.0, np.full((HEIGHT, WIDTH, 3), view, dtype=np.uint8))
                for view in range(self.num_views)
            )


class ExactRigSource:
    """The rig's frames, as the SLAM stage asks for them."""

    def __init__(self, rig: ExactRig) -> None:
        self.infos = rig.infos
        self.frames = rig.instants


__all__ = ["CAMERA", "ExactRig", "ExactRigSource", "fan_of_cameras"]
