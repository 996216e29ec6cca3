"""A wavy wall seen by a moving camera, with exact measurements: what SLAM can do when matching is perfect."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from vipe_core.ba.problem import Grid
from vipe_core.cameras import Camera
from vipe_core.geometry.arrays import exp, inverse
from vipe_core.priors.protocols import IntrinsicsEstimate, Match, PriorFamily, WorkingFrame
from vipe_core.slam.reprojection import Reprojector
from vipe_core.video.source import Frame, VideoInfo

WIDTH, HEIGHT = 192, 144
GRID = Grid(HEIGHT // 8, WIDTH // 8)
CAMERA = Camera.pinhole_from_fov(60.0, WIDTH, HEIGHT)


def trajectory(count: int, step: Sequence[float]) -> NDArray[np.float64]:
    """(N, 4, 4) cam_from_world of a constant twist per frame (translation, rotation)."""
    return np.stack([exp(np.array(step) * k) for k in range(count)])


class ExactScene:
    """Truth and the providers that measure it without error.

    The world is one wavy wall z = f(x, y) that the rays of every frame are intersected with.

    Args:
        outliers: Share of cells whose measurement is noise.
        camera: Of `WIDTH` x `HEIGHT` pixels.
        ripple: Depth of the waves; a wide camera sees around those that are too deep.
    """

    def __init__(
        self,
        cam_from_world: NDArray[np.float64],
        *,
        outliers: float = 0.0,
        camera: Camera = CAMERA,
        ripple: float = 0.7,
    ) -> None:
        self.cam_from_world = cam_from_world
        self.reprojector = Reprojector(camera.model, GRID)
        self.camera = camera
        self.params = camera.index_params()
        self._ripple = ripple
        self.inverse_depth = [self._intersect(pose) for pose in cam_from_world]
        self._outliers = outliers

    def _intersect(self, cam_from_world: NDArray[np.float64]) -> NDArray[np.float64]:
        world_from_cam = inverse(cam_from_world)
        px = GRID.sample_px().numpy()
        rays = self.camera.unproject(px)
        rays, centre = rays @ world_from_cam[:3, :3].T, world_from_cam[:3, 3]
        depth = np.full(len(rays), 3.0)
        for _ in range(60):
            point = centre + depth[:, None] * rays
            wall = 3.0 + self._ripple * np.sin(1.7 * point[:, 0]) * np.cos(1.3 * point[:, 1])
            depth = depth + 0.5 * (wall - point[:, 2]) / rays[:, 2]
        return 1.0 / depth

    def measure(self, i: int, j: int) -> Match:
        relative = self.cam_from_world[j] @ inverse(self.cam_from_world[i])
        induced = self.reprojector.induced(self.params, relative, self.inverse_depth[i])
        target_px = np.nan_to_num(induced.target_px)
        rng = np.random.default_rng(1000 * i + j)
        wrong = rng.random(len(target_px)) < self._outliers
        target_px[wrong] += rng.normal(0, 15, (int(wrong.sum()), 2)).astype(np.float32)
        weight = np.repeat(induced.visible[:, None], 2, axis=1).astype(np.float32)
        return Match(target_px, weight, float(induced.visible.mean()))

    # -- the providers; the features of a frame are its index ------------------------------------------------------

    def encode(self, frame: WorkingFrame) -> int:
        return frame.index

    def is_blank(self, features: int) -> bool:
        return False

    def motion_px(self, source: int, target: int) -> float:
        match = self.measure(source, target)
        seen = match.weight[:, 0] > 0
        moved = np.linalg.norm(match.target_px - GRID.sample_px().numpy(), axis=1)
        return float(np.median(moved[seen])) if seen.any() else 0.0

    def match(self, source: int, target: int, guess_px: object = None) -> tuple[Match, Match]:
        return self.measure(source, target), self.measure(target, source)

    def match_fast(self, source: int, target: int, guess_px: object = None) -> Match:
        return self.measure(source, target)

    def priors(
        self,
        fov_deg: float = 60.0,
        sigma: float = 0.1,
        rivals_deg: Sequence[float] = (),
        camera: Camera | None = None,
    ) -> PriorFamily:
        """The scene as its own matcher, and an initial camera: a pinhole of the given field of view, or `camera`."""
        start = Camera.pinhole_from_fov(fov_deg, WIDTH, HEIGHT) if camera is None else camera
        return PriorFamily(matcher=self, tracker=None, points=None, intrinsics=_Guess(start, sigma, rivals_deg))

    # -- the frame source: pictures are blank, only their number counts --------------------------------------------

    @property
    def info(self) -> VideoInfo:
        return VideoInfo("exact", "exact", WIDTH, HEIGHT, 30.0, None, None, 0, "none", "rgb24", 0)

    def frames(self, size: tuple[int, int] | None = None, start: int = 0, stop: int | None = None) -> Iterator[Frame]:
        blank = np.zeros((HEIGHT, WIDTH, 3), dtype=np.uint8)
        for index in range(len(self.cam_from_world))[start:stop]:
            yield Frame(index, index / 30.0, blank)


class _Guess:
    def __init__(self, camera: Camera, sigma: float, rivals_deg: Sequence[float]) -> None:
        self._camera, self._sigma, self._rivals_deg = camera, sigma, rivals_deg

    def estimate(self, frames: Sequence[WorkingFrame], grid: Grid) -> IntrinsicsEstimate:
        rivals = [Camera.pinhole_from_fov(fov, grid.width * 8, grid.height * 8) for fov in self._rivals_deg]
        return IntrinsicsEstimate(self._camera, self._sigma, 1, tuple(rival.focal_px for rival in rivals))
