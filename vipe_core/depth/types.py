"""What the depth stage is given and what it yields."""

from __future__ import annotations

import bisect
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vipe_core.annotation import FILLED as FILLED
from vipe_core.annotation import MEASURED as MEASURED
from vipe_core.annotation import MOVING as MOVING
from vipe_core.annotation import SKY as SKY
from vipe_core.annotation import UNOBSERVED as UNOBSERVED
from vipe_core.cameras import Camera


@dataclass(frozen=True, slots=True)
class DepthSettings:
    """Parameters of the depth stage. Lengths in pixels belong to the sweep image, a quarter of the working image.

    Attributes:
        window_frames: Sources are looked for among this many frames before and after a frame.
        parallax_px: Wanted parallax of the near and the far source of each side, for a sweep image 160 pixels wide.
        min_parallax_px: A source with less is not used.
        min_overlap: Share of the picture that a source must see.
        planes: Hypotheses of the coarse sweep, uniform in inverse depth.
        fine_planes: Hypotheses around the coarse answer at half of the working resolution (odd).
        fine_reach: How far they reach to either side, in coarse steps.
        coarse_radius, fine_radius: Half sides of the matching windows.
        support_stride: Distance of the pixels of a window that count.
        support_edge: Grey-level difference to the centre of the window at which a pixel counts less by a factor e.
        noise: Variance of a flat window, (grey levels)^2: below it, correlation says nothing.
        smooth_small: Penalty of a change by one plane between neighbours.
        smooth_large: Penalty of a larger change.
        smooth_edge: Grey-level difference that lowers `smooth_large` by a factor e.
        prior_gain: Cost of leaving the inverse depth that bundle adjustment found, at full confidence.
        prior_reach: Planes after which that cost no longer grows.
        check_frames: Distances to the frames whose depth must agree.
        check_tolerance: Relative difference in inverse depth that still agrees.
        fill_smoothness: Weight of a difference between neighbours that look the same, beside a sure measurement's 1.
        fill_edge: Difference in colour, in grey levels, that lowers it by a factor e.
        fill_tolerance: Relative difference to its surroundings at which a measurement counts a quarter.
    """

    window_frames: int = 60
    parallax_px: tuple[float, float] = (3.5, 9.0)
    min_parallax_px: float = 0.7
    min_overlap: float = 0.5
    planes: int = 48
    fine_planes: int = 9
    fine_reach: float = 1.5
    coarse_radius: int = 2
    fine_radius: int = 2
    support_stride: int = 1
    support_edge: float = 10.0
    noise: float = 2.0
    smooth_small: float = 0.1
    smooth_large: float = 1.2
    smooth_edge: float = 12.0
    prior_gain: float = 0.2
    prior_reach: float = 3.0
    check_frames: tuple[int, ...] = (3, 6, 10)
    check_tolerance: float = 0.08
    fill_smoothness: float = 0.3
    fill_edge: float = 4.0
    fill_tolerance: float = 0.1

    @classmethod
    def fast(cls) -> DepthSettings:
        """Fewer hypotheses, every other pixel of the windows, and fewer frames that are asked: a third of the time."""
        return cls(planes=32, fine_planes=7, support_stride=2, check_frames=(3, 6))


@dataclass(frozen=True, slots=True)
class SceneMap:
    """What is known of the camera and the scene before dense depth.

    Attributes:
        camera: At the working resolution (whose sides are multiples of 8).
        world_from_cam: (N, 4, 4) float64, one pose per frame.
        keyframes: (K,) int64 increasing frame indices.
        inverse_depth: (K, h/8, w/8) float32 along the rays of the camera model, sampled at the centres of 8 x 8 blocks.
        confidence: (K, h/8, w/8) float32 in 0..1; 0 where nothing was measured or where something moves.
        cuts: First frames of the shots but the first. Frames of different shots say nothing about each other.
        labels: (N, h/8 * w/8) int8 for each cell of each frame, what `slam.segmentation` makes masks of moving things
            from; None where nothing is known to move.
    """

    camera: Camera
    world_from_cam: NDArray[np.float64]
    keyframes: NDArray[np.int64]
    inverse_depth: NDArray[np.float32]
    confidence: NDArray[np.float32]
    cuts: tuple[int, ...] = ()
    labels: NDArray[np.int8] | None = None

    def __post_init__(self) -> None:
        cells = (len(self.keyframes), self.camera.height // 8, self.camera.width // 8)
        if self.inverse_depth.shape != cells or self.confidence.shape != cells:
            raise ValueError(
                f"keyframe maps must be {cells}: {self.inverse_depth.shape = }, {self.confidence.shape = }"
            )
        if self.camera.width % 8 or self.camera.height % 8:
            raise ValueError(f"the working size must be whole cells, got {self.camera.width} x {self.camera.height}")

    def shot_of(self, frame: int) -> tuple[int, int]:
        """First frame of the shot that `frame` is in, and one past its last."""
        number = bisect.bisect_right(self.cuts, frame)
        start = self.cuts[number - 1] if number else 0
        return start, self.cuts[number] if number < len(self.cuts) else len(self.world_from_cam)


@dataclass(frozen=True, slots=True)
class DepthFrame:
    """Dense depth of one frame at source resolution.

    Attributes:
        index: Frame index.
        rgb: (H, W, 3) uint8.
        depth: (H, W) float32, finite and positive on every pixel, in units of the trajectory: z for pinhole, distance
            for the other models.
        confidence: (H, W) float32 in 0..1; what is filled in has 0.05 at most, what moves 0.
        kind: (H, W) uint8, where the value comes from: `MEASURED`, `FILLED`, `SKY`, `MOVING` or `UNOBSERVED`.
        moving: (H, W) bool, what moves by itself, and what the frame itself says must not be used.
    """

    index: int
    rgb: NDArray[np.uint8]
    depth: NDArray[np.float32]
    confidence: NDArray[np.float32]
    kind: NDArray[np.uint8]
    moving: NDArray[np.bool_]
