"""A network that knows the answer: updates go part of the way to the exact flow of a room, with noise."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import exact_room
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from vipe_core.annotation import DepthKind
from vipe_core.ba.problem import Grid
from vipe_core.cameras import Camera
from vipe_core.geometry.arrays import inverse
from vipe_core.priors.protocols import (
    IntrinsicsEstimate,
    Match,
    MetricDepth,
    MetricEstimate,
    PointFollower,
    PriorFamily,
    Refined,
    TrackedPoints,
    WorkingFrame,
)
from vipe_core.slam.reprojection import Reprojector
from vipe_core.video.source import Frame, VideoInfo

WIDTH, HEIGHT = 128, 96
OFFSET_PX = 4.0
GRID = Grid(HEIGHT // 8, WIDTH // 8, 8.0, OFFSET_PX)


class RoomRefiner:
    """`DenseMatcher`, `Refiner` and frame source of the exact room; the features of a frame are its index.

    Args:
        share: Part of the way that an update goes.
        noise_px: Standard deviation of each update's answer.
        damping: Information on staying put that every update gives.
        blind_cells: The last so many cells of every frame get no weight.
    """

    def __init__(
        self,
        world_from_cam: NDArray[np.float64],
        *,
        share: float = 0.5,
        noise_px: float = 0.1,
        damping: float = 20.0,
        fov_deg: float = 75.0,
        blind_cells: int = 0,
    ) -> None:
        self.world_from_cam = world_from_cam
        self.camera = Camera.pinhole_from_fov(fov_deg, WIDTH, HEIGHT)
        self.share, self.noise_px, self.damping = share, noise_px, damping
        self.blind_cells = blind_cells
        self.updates = 0
        self.lean: list[bool] = []
        self.reprojector = Reprojector("pinhole", GRID)
        first = int(OFFSET_PX)
        self.inverse_depth = [
            1 / exact_room.depth_and_colour(self.camera, pose, "z")[0][first::8, first::8].reshape(-1)
            for pose in world_from_cam
        ]

    offset_px = OFFSET_PX

    def exact(self, i: int, j: int) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """(P, 2) where the cells of frame i are in frame j, and (P,) whether that is in the picture."""
        relative = inverse(self.world_from_cam[j]) @ self.world_from_cam[i]
        induced = self.reprojector.induced(self.camera.index_params(), relative, self.inverse_depth[i])
        return np.nan_to_num(induced.target_px), induced.visible

    # -- Refiner ---------------------------------------------------------------------------------------------------

    def picture(self, features: int) -> NDArray[np.uint8]:
        # The only pixel that matters says which frame it is.
        return np.full((HEIGHT, WIDTH, 3), features, dtype=np.uint8)

    def begin(self, grid: Grid, *, lean: bool, spilled: bool = False) -> _Refinement:
        assert grid == GRID
        self.lean.append(lean)
        return _Refinement(self)

    # -- DenseMatcher ----------------------------------------------------------------------------------------------

    def encode(self, frame: WorkingFrame) -> int:
        return frame.index

    def is_blank(self, features: int) -> bool:
        return False

    def motion_px(self, source: int, target: int) -> float:
        px, seen = self.exact(source, target)
        return float(np.linalg.norm(px - GRID.sample_px().numpy(), axis=1)[seen].mean()) if seen.any() else 0.0

    def match_fast(self, source: int, target: int, guess_px: object = None) -> Match:
        px, seen = self.exact(source, target)
        return Match(px, np.repeat(seen[:, None], 2, axis=1).astype(np.float32), float(seen.mean()))

    def match(self, source: int, target: int, guess_px: object = None) -> tuple[Match, Match]:
        return self.match_fast(source, target), self.match_fast(target, source)

    # -- the initial camera ----------------------------------------------------------------------------------------

    def priors(
        self,
        fov_deg: float,
        sigma: float,
        metric: MetricDepth | None = None,
        follower: PointFollower | None = None,
    ) -> PriorFamily:
        guess = _Guess(fov_deg, sigma)
        return PriorFamily(self, None, None, guess, refiner=self, metric=metric, follower=follower)

    # -- the frame source ------------------------------------------------------------------------------------------

    @property
    def info(self) -> VideoInfo:
        return VideoInfo("room", "room", WIDTH, HEIGHT, 30.0, None, None, 0, "none", "rgb24", 0)

    def frames(self, size: tuple[int, int] | None = None, start: int = 0, stop: int | None = None) -> Iterator[Frame]:
        blank = np.zeros((HEIGHT, WIDTH, 3), dtype=np.uint8)
        for index in range(len(self.world_from_cam))[start:stop]:
            yield Frame(index, index / 30.0, blank)


class RoomDepth:
    """`MetricDepth` of the exact room in some unit, by a network that takes the focal length into account.

    Attributes:
        shown: Frame and focal length of every picture so far.
    """

    depth_kind: DepthKind = "z"
    shared_sigma_ratio = 0.05

    def __init__(self, refiner: RoomRefiner, unit: float = 3.0) -> None:
        self._refiner, self._unit = refiner, unit
        self.shown: list[tuple[int, float]] = []

    def input_size(self, width: int, height: int) -> tuple[int, int]:
        return width, height

    def estimate(self, rgb: NDArray[np.uint8], camera: Camera) -> MetricEstimate:
        index = int(rgb[0, 0, 0])
        self.shown.append((index, camera.focal_px))
        inverse_depth = self._refiner.inverse_depth[index].reshape(GRID.height, GRID.width)
        shape = (camera.height // 8, camera.width // 8)
        assert inverse_depth.shape == shape
        depth_m = self._unit * camera.focal_px / self._refiner.camera.focal_px / inverse_depth
        return MetricEstimate(depth_m.astype(np.float32), np.ones(shape, np.float32))


class RoomFollower:
    """`PointFollower` that sees points of the exact room where they are, in pictures of twice the size.

    Attributes:
        followed: Frames that it was given, a list for each run.
    """

    def __init__(self, refiner: RoomRefiner, wrong_px: float = 0.0) -> None:
        self._refiner, self._wrong_px = refiner, wrong_px
        self.followed: list[list[int]] = []
        # Points of the surfaces that every fifth frame sees.
        rng = np.random.default_rng(0)
        camera, points = refiner.camera, []
        for pose in refiner.world_from_cam[::5]:
            depth = exact_room.depth_and_colour(camera, pose, "z")[0]
            x, y = rng.integers(0, WIDTH, 150), rng.integers(0, HEIGHT, 150)
            fx, fy, cx, cy = camera.index_params()
            z = depth[y, x]
            points.append(np.stack(((x - cx) / fx * z, (y - cy) / fy * z, z), axis=1) @ pose[:3, :3].T + pose[:3, 3])
        self._points = np.concatenate(points)

    def input_size(self, width: int, height: int) -> tuple[int, int]:
        return 2 * width, 2 * height

    def follow(self, frames: Iterable[Frame], camera: Camera) -> Iterator[TrackedPoints]:
        assert (camera.width, camera.height) == (2 * WIDTH, 2 * HEIGHT)
        self.followed.append([])
        own = self._refiner.camera
        fx, fy, cx, cy = own.index_params()
        for frame in frames:
            self.followed[-1].append(frame.index)
            pose = self._refiner.world_from_cam[frame.index]
            x, y, z = ((self._points - pose[:3, 3]) @ pose[:3, :3]).T
            px = np.stack((x / z * fx + cx, y / z * fy + cy), axis=1)
            inside = ((px >= 0) & (px <= (WIDTH - 1, HEIGHT - 1))).all(axis=1) & (z > 0)
            depth = exact_room.depth_and_colour(own, pose, "z")[0]
            column, row = np.rint(np.where(inside[:, None], px, 0)).astype(int).T
            ids = np.flatnonzero(inside & (np.abs(depth[row, column] - z) < 0.02 * z))
            slipped = self._wrong_px * np.array([[frame.index, 0]])
            yield TrackedPoints(ids, (2 * (px[ids] + slipped + 0.5) - 0.5).astype(np.float32))


class _Refinement:
    def __init__(self, owner: RoomRefiner) -> None:
        self._owner = owner
        self._pairs: list[tuple[int, int]] = []

    def __len__(self) -> int:
        return len(self._pairs)

    def add(self, pairs: Sequence[tuple[int, int]], seen_px: Tensor) -> None:
        assert seen_px.shape == (len(pairs), GRID.num_cells, 2)
        self._pairs += pairs

    def keep(self, rows: Sequence[int]) -> None:
        self._pairs = [self._pairs[row] for row in rows]

    def update(self, seen_px: Tensor, sources: Sequence[int]) -> Refined:
        assert len(sources) == len(self._pairs)
        owner = self._owner
        owner.updates += 1
        rng = np.random.default_rng(owner.updates)
        seen = seen_px.numpy()
        exact = [owner.exact(i, j) for i, j in self._pairs]
        true = np.stack([px for px, _ in exact])
        weight = np.repeat(np.stack([visible for _, visible in exact])[..., None], 2, axis=2)
        weight[:, GRID.num_cells - owner.blind_cells :] = False
        start = np.where(np.isfinite(seen), seen, GRID.sample_px().numpy())
        target = start + owner.share * (true - start) + rng.normal(0, owner.noise_px, true.shape)
        damping = torch.full((len(set(sources)), GRID.num_cells), owner.damping)
        return Refined(torch.from_numpy(target).float(), torch.from_numpy(weight).float(), damping)


class _Guess:
    def __init__(self, fov_deg: float, sigma: float) -> None:
        self._estimate = IntrinsicsEstimate(Camera.pinhole_from_fov(fov_deg, WIDTH, HEIGHT), sigma, 1)

    def estimate(self, frames: Sequence[WorkingFrame], grid: Grid) -> IntrinsicsEstimate:
        return self._estimate
