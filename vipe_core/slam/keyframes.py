"""The keyframe map: what the SLAM stage knows about each keyframe, in arrays that grow with the clip."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vipe_core.ba.problem import Grid
from vipe_core.cameras import Camera, CameraModel
from vipe_core.geometry.arrays import inverse
from vipe_core.slam.selection import Keyframe

Array = NDArray[Any]


class Snapshot(NamedTuple):
    """What adjustments change of a map: (K, 4, 4), (K, P), intrinsics, extrinsics of a rig and their units."""

    poses: NDArray[np.float64]
    depths: NDArray[np.float32]
    intrinsics: NDArray[np.float64]
    cam_from_rig: NDArray[np.float64] | None
    rig_units: float


class KeyframeMap:
    """Poses, inverse depths and features of keyframes 0..K-1, and the intrinsics they share.

    A rig of V views has V keyframes for every instant that was chosen, in order: keyframe k is view k % V of instant
    k // V. Their poses agree with the extrinsics.

    Attributes:
        frame_index: (K,) frame of the video behind each keyframe.
        times_s: (K,) its presentation time.
        features: The matcher's features of each.
        cam_from_world: (K, 4, 4) float64.
        inverse_depth: (K, P) float32, positive.
        static: (K, P) bool, False on cells that appear to move by themselves.
        camera_model: Of all of them.
        intrinsics: (K,) float64 `Camera.index_params` at the working size; (V, K) where each view of a rig has its own.
        cam_from_rig: (V, 4, 4) float64 extrinsics of a rig in the units of the map, else None.
        rig_units: Length of the map's unit in that of the extrinsics as they were given.
    """

    def __init__(
        self, grid: Grid, camera_model: CameraModel, intrinsics: Array, cam_from_rig: Array | None = None
    ) -> None:
        self.grid = grid
        self.cam_from_rig: NDArray[np.float64] | None = None if cam_from_rig is None else np.array(cam_from_rig)
        self.rig_units = 1.0
        self.camera_model: CameraModel = camera_model
        self.intrinsics: NDArray[np.float64] = np.array(intrinsics, dtype=np.float64)
        self.frame_index: list[int] = []
        self.times_s: list[float] = []
        self.features: list[Any] = []
        self._poses: list[NDArray[np.float64]] = []
        self._depths: list[NDArray[np.float32]] = []
        self._static: list[NDArray[np.bool_]] = []

    def __len__(self) -> int:
        return len(self.frame_index)

    @property
    def num_views(self) -> int:
        return 1 if self.cam_from_rig is None else len(self.cam_from_rig)

    @property
    def has_size(self) -> bool:
        """Whether it is of a rig whose cameras are apart, which tells the scale."""
        if self.cam_from_rig is None:
            return False
        centres = inverse(self.cam_from_rig)[:, :3, 3]
        return bool(np.ptp(centres, axis=0).max() > 0)

    def instant(self, k: int) -> int:
        """The number of the moment of a keyframe, without a rig its own."""
        return k // self.num_views

    def intrinsics_of(self, view: int) -> NDArray[np.float64]:
        """(K,) those of a view."""
        intrinsics: NDArray[np.float64] = self.intrinsics if self.intrinsics.ndim == 1 else self.intrinsics[view]
        return intrinsics

    def intrinsics_at(self, k: int) -> NDArray[np.float64]:
        """(K,) those of a keyframe."""
        return self.intrinsics_of(k % self.num_views)

    @property
    def camera(self) -> Camera:
        """The camera as it is known now, at the working size; of a rig, that of view 0."""
        return self.camera_of(0)

    def camera_of(self, view: int) -> Camera:
        width, height = (round(cells * self.grid.stride) for cells in (self.grid.width, self.grid.height))
        return Camera.from_index_params(self.camera_model, self.intrinsics_of(view), width, height)

    def rig_pose(self, instant: int) -> NDArray[np.float64]:
        """(4, 4) rig_from_world at an instant; without a rig the keyframe's own pose."""
        if self.cam_from_rig is None:
            return self.pose(instant)
        return np.asarray(inverse(self.cam_from_rig[0]) @ self.pose(instant * self.num_views))

    def set_rig_pose(self, instant: int, rig_from_world: Array) -> None:
        """Place all views of an instant."""
        if self.cam_from_rig is None:
            self.set_pose(instant, rig_from_world)
            return
        for view, mount in enumerate(self.cam_from_rig):
            self.set_pose(instant * self.num_views + view, mount @ rig_from_world)

    def append(self, keyframe: Keyframe, time_s: float, cam_from_world: Array, inverse_depth: Array) -> int:
        """Add a keyframe and return its number."""
        self.frame_index.append(keyframe.index)
        self.times_s.append(time_s)
        self.features.append(keyframe.features)
        self._poses.append(np.array(cam_from_world, dtype=np.float64))
        self._depths.append(np.array(inverse_depth, dtype=np.float32))
        self._static.append(np.ones(self.grid.num_cells, dtype=np.bool_))
        return len(self) - 1

    def remove(self, k: int) -> None:
        """Forget keyframe `k`; the numbers of those behind it go down by one."""
        kept: tuple[list[Any], ...] = (
            self.frame_index,
            self.times_s,
            self.features,
            self._poses,
            self._depths,
            self._static,
        )
        for each in kept:
            del each[k]

    def pose(self, k: int) -> NDArray[np.float64]:
        return self._poses[k]

    def depth(self, k: int) -> NDArray[np.float32]:
        return self._depths[k]

    def static(self, k: int) -> NDArray[np.bool_]:
        return self._static[k]

    def set_pose(self, k: int, cam_from_world: Array) -> None:
        self._poses[k] = np.array(cam_from_world, dtype=np.float64)

    def set_depth(self, k: int, inverse_depth: Array) -> None:
        self._depths[k] = np.array(inverse_depth, dtype=np.float32)

    def set_static(self, k: int, static: Array) -> None:
        self._static[k] = np.array(static, dtype=np.bool_)

    def poses(self) -> NDArray[np.float64]:
        """(K, 4, 4) copy of all poses."""
        return np.stack(self._poses)

    def depths(self) -> NDArray[np.float32]:
        """(K, P) copy of all inverse depths."""
        return np.stack(self._depths)

    def statics(self) -> NDArray[np.bool_]:
        """(K, P) copy of all motion masks."""
        return np.stack(self._static)

    def snapshot(self) -> Snapshot:
        """What adjustments change, to `restore` later."""
        extrinsics = None if self.cam_from_rig is None else self.cam_from_rig.copy()
        return Snapshot(self.poses(), self.depths(), self.intrinsics.copy(), extrinsics, self.rig_units)

    def restore(self, snapshot: Snapshot) -> None:
        for k in range(len(snapshot.poses)):
            self.set_pose(k, snapshot.poses[k])
            self.set_depth(k, snapshot.depths[k])
        self.intrinsics = np.array(snapshot.intrinsics, dtype=np.float64)
        self.cam_from_rig = None if snapshot.cam_from_rig is None else snapshot.cam_from_rig.copy()
        self.rig_units = snapshot.rig_units

    def normalise_scale(self) -> None:
        """Rescale the world so that the median inverse depth is 1. Leaves every reprojection as it is."""
        median = float(np.median(self.depths()))
        if not np.isfinite(median) or median <= 0:
            return
        self.rescale(median)

    def rescale(self, factor: float) -> None:
        """Make all lengths so many times larger."""
        for k in range(len(self)):
            self._depths[k] = (self._depths[k] / factor).astype(np.float32)
            self._poses[k][:3, 3] *= factor
        if self.cam_from_rig is not None:
            self.cam_from_rig[:, :3, 3] *= factor
            self.rig_units /= factor
