"""What the engine returns: camera motion, camera model, dense depth and its own opinion of them."""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from vipe_core.cameras import Camera

Scale = Literal["metric", "relative"]
DepthKind = Literal["z", "ray"]
Reliability = Literal["yes", "doubtful", "no"]


@dataclass(frozen=True, slots=True)
class Quality:
    """What the engine knows about its own result.

    Attributes:
        reliable: Overall verdict; `reasons` says why it is not `yes`.
        reasons: Stable snake_case codes, e.g. `static_camera`, `few_keyframes`.
        residual_px: Median reprojection residual of inliers, pixels of the source video; NaN without edges.
        inlier_ratio: Share of weighted measurements that the robust kernel keeps, 0..1.
        coverage: Share of keyframe cells that at least one edge measures, 0..1.
        parallax_deg: Median over keyframes of the angle under which their points are seen.
        focal_sigma_ratio: 1-sigma of the focal length divided by the focal length (inflated to be honest).
        frame_inlier_ratio: (N,) float32 per-frame inlier ratio of the pose fit.
    """

    reliable: Reliability
    reasons: tuple[str, ...]
    residual_px: float
    inlier_ratio: float
    coverage: float
    parallax_deg: float
    focal_sigma_ratio: float
    frame_inlier_ratio: NDArray[np.float32]

    def summary(self) -> dict[str, object]:
        """The scalar fields, JSON-ready (no NaN: missing is None)."""

        def number(x: float) -> float | None:
            return round(float(x), 6) if np.isfinite(x) else None

        return {
            "reliable": self.reliable,
            "reasons": list(self.reasons),
            "residual_px": number(self.residual_px),
            "inlier_ratio": number(self.inlier_ratio),
            "coverage": number(self.coverage),
            "parallax_deg": number(self.parallax_deg),
            "focal_sigma_ratio": number(self.focal_sigma_ratio),
        }


@dataclass(frozen=True, slots=True)
class Provenance:
    """How the result came about. Holds nothing that differs between two runs of the same input, config and device."""

    engine_version: str
    preset: str
    config_hash: str
    device: str
    libraries: dict[str, str]
    providers: dict[str, str]
    weights: dict[str, str]
    source: dict[str, object]


@dataclass(frozen=True, slots=True)
class Progress:
    """How far an annotation is.

    Attributes:
        stage: `scan`, `intrinsics`, `track`, `backend`, `infill` or `depth`, in this order.
        frames_done: Frames of the stage that are done.
        frames_total: Frames of the stage, or None while the number is not known.
    """

    stage: str
    frames_done: int
    frames_total: int | None


ProgressCallback = Callable[[Progress], None]
"""Called often, from the thread that annotates. What it raises ends the annotation: the way to cancel."""


@dataclass(frozen=True, slots=True)
class DenseFrame:
    """One frame of the dense stream.

    Attributes:
        index: Frame index, 0..N-1.
        rgb: (H, W, 3) uint8, upright, at source resolution.
        depth: (H, W) float32 in units of the trajectory; 0 where there is no value.
        confidence: (H, W) float32 in 0..1: 0 is a value that was filled in, not measured.
    """

    index: int
    rgb: NDArray[np.uint8]
    depth: NDArray[np.float32]
    confidence: NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Annotation:
    """Poses, intrinsics and a stream of dense depth for one video.

    Attributes:
        world_from_cam: (N, 4, 4) float64, OpenCV axes; the world is the first camera.
        camera: Shared camera model at source resolution.
        timestamps_s: (N,) float64 presentation times as the container states them.
        fps: Average frames per second.
        keyframes: (K,) int64 increasing frame indices.
        scale: `relative` means one unknown scale for poses and depth together.
        depth_kind: `z` along the optical axis, `ray` distance from the centre.
        timings_s: Wall seconds per stage. Filled further while `dense` is consumed; never part of the payload bytes.
        dense: Starts the dense stream: every frame in order, once per call, in bounded memory. Closing it ends its
            decoders.
    """

    name: str
    world_from_cam: NDArray[np.float64]
    camera: Camera
    timestamps_s: NDArray[np.float64]
    fps: float
    keyframes: NDArray[np.int64]
    scale: Scale
    depth_kind: DepthKind
    quality: Quality
    provenance: Provenance
    dense: Callable[[], Generator[DenseFrame, None, None]]
    timings_s: dict[str, float] = field(default_factory=dict)

    @property
    def num_frames(self) -> int:
        return len(self.world_from_cam)

    @property
    def trajectory_length(self) -> float:
        """Sum of the distances between consecutive camera centres, in units of the trajectory."""
        centres = self.world_from_cam[:, :3, 3]
        return float(np.linalg.norm(np.diff(centres, axis=0), axis=1).sum())
