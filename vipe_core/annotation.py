"""What the engine returns: camera motion, camera model, dense depth and its own opinion of them."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from vipe_core.cameras import Camera

Scale = Literal["metric", "relative"]
DepthKind = Literal["z", "ray"]
Reliability = Literal["yes", "doubtful", "no"]


def depth_kind_of(camera: Camera) -> DepthKind:
    """`z` for pinhole and opencv; `ray` for the models that see sideways, where z would be zero or negative."""
    return "z" if camera.model in ("pinhole", "opencv") else "ray"


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
        fov_interval_deg: Horizontal field of view, lower and upper end of what `focal_sigma_ratio` makes 95 % likely;
            NaN where nothing is known.
        frame_inlier_ratio: (N,) float32 per-frame inlier ratio of the pose fit.
        frame_residual_px: (N,) float32 per-frame `residual_px`; NaN where nothing was measured.
        frame_coverage: (N,) float32 share of the cells of each frame that its pose explains.
        frame_interpolated: (N,) bool, True on frames whose pose nothing measures: it is interpolated.
        cuts: Frames at which another shot starts. Each shot is right by itself; the step over a cut is not measured.
        zoom_ratio: Longest over shortest focal length within a shot; 1 where no change is seen.
        loop_edges: Links between keyframes far apart in time.
        loop_residual_before_px: Median residual of those links before the last global adjustment, source pixels; NaN
            without any.
        loop_residual_after_px: The same after it.
        loop_moved_ratio: RMS shift of the keyframes by that adjustment, as a share of the path's length.
        scale_sigma_ratio: 1-sigma of the metres per unit divided by them; NaN where the scale is relative.
    """

    reliable: Reliability
    reasons: tuple[str, ...]
    residual_px: float
    inlier_ratio: float
    coverage: float
    parallax_deg: float
    focal_sigma_ratio: float
    frame_inlier_ratio: NDArray[np.float32]
    fov_interval_deg: tuple[float, float] = (float("nan"), float("nan"))
    frame_residual_px: NDArray[np.float32] = field(default_factory=lambda: np.zeros(0, np.float32))
    frame_coverage: NDArray[np.float32] = field(default_factory=lambda: np.zeros(0, np.float32))
    frame_interpolated: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, np.bool_))
    cuts: tuple[int, ...] = ()
    loop_edges: int = 0
    loop_residual_before_px: float = float("nan")
    loop_residual_after_px: float = float("nan")
    loop_moved_ratio: float = 0.0
    scale_sigma_ratio: float = float("nan")
    zoom_ratio: float = 1.0

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
            "fov_interval_deg": [number(end) for end in self.fov_interval_deg],
            "num_interpolated": int(self.frame_interpolated.sum()),
            "cuts": list(self.cuts),
            "zoom_ratio": number(self.zoom_ratio),
            "loop_edges": self.loop_edges,
            "loop_residual_before_px": number(self.loop_residual_before_px),
            "loop_residual_after_px": number(self.loop_residual_after_px),
            "loop_moved_ratio": number(self.loop_moved_ratio),
            "scale_sigma_ratio": number(self.scale_sigma_ratio),
        }

    def per_frame(self) -> dict[str, list[float | None] | list[int]]:
        """The per-frame fields, JSON-ready and short: rounded numbers (None is NaN) and the interpolated frames."""

        def numbers(values: NDArray[np.float32], digits: int) -> list[float | None]:
            return [round(float(x), digits) if np.isfinite(x) else None for x in values]

        return {
            "frame_inlier_ratio": numbers(self.frame_inlier_ratio, 3),
            "frame_residual_px": numbers(self.frame_residual_px, 3),
            "frame_coverage": numbers(self.frame_coverage, 3),
            "interpolated_frames": [int(index) for index in np.flatnonzero(self.frame_interpolated)],
        }


@dataclass(frozen=True, slots=True)
class Provenance:
    """How the result came about. Holds nothing that differs between two runs of the same input, config and device.

    Attributes:
        scale_source: What the scale was taken from: `normalised`, `metric_depth`, or the user's known length as text.
        memory_profile: `low` where the network's measurements were refined without volumes of correlation, as what the
            video may take of the GPU asks; their last digits differ then. `full` elsewhere.
        calibration: The camera that the user gave, as `Calibration.to_json`, at the size of the pictures; with
            `resampled_to`, model, params, width and height of the camera that poses and depth were found in, where its
            distortion was taken out for that. None where the camera was estimated.
    """

    engine_version: str
    preset: str
    config_hash: str
    device: str
    libraries: dict[str, str]
    providers: dict[str, str]
    weights: dict[str, str]
    source: dict[str, object]
    scale_source: str = "normalised"
    calibration: dict[str, object] | None = None
    memory_profile: str = "full"


@dataclass(frozen=True, slots=True)
class Progress:
    """How far an annotation is.

    Attributes:
        stage: `masks` (only where things are found by phrases), `scan`, `intrinsics`, `track`, `backend`, `infill`,
            `scale` (only with metric depth) or `depth`, in this order.
        frames_done: Frames of the stage that are done.
        frames_total: Frames of the stage, or None while the number is not known.
    """

    stage: str
    frames_done: int
    frames_total: int | None


ProgressCallback = Callable[[Progress], None]
"""Called often, from the thread that annotates. What it raises ends the annotation: the way to cancel."""


MASK_PHRASES = {0: "background", 1: "moving"}
"""What the ids of every mask stand for. 1 is what moves by itself, as geometry or the user says."""

FIRST_INSTANCE, LAST_INSTANCE = 2, 255
"""Ids of the things that a network found, each with its own phrase."""

MEASURED, FILLED, SKY, MOVING, UNOBSERVED = range(5)
"""Where the depth of a pixel comes from: several views agree on it; it is filled in from what is around it; it is sky,
at the far end; it moves by itself, and is filled in from what it touches; nothing is known around it."""

DEPTH_KINDS = {MEASURED: "measured", FILLED: "filled", SKY: "sky", MOVING: "moving", UNOBSERVED: "unobserved"}


@dataclass(frozen=True, slots=True)
class DenseFrame:
    """One frame of the dense stream.

    Attributes:
        index: Frame index, 0..N-1.
        rgb: (H, W, 3) uint8, upright, at source resolution.
        depth: (H, W) float32 in units of the trajectory; 0 where there is no value.
        confidence: (H, W) float32 in 0..1; what is filled in, not measured, has 0.05 at most, what moves 0.
        mask: (H, W) uint8 ids, `Annotation.mask_phrases` says of what; 0 is the static background.
        kind: (H, W) uint8, where the depth comes from: `MEASURED`, `FILLED`, `SKY`, `MOVING` or `UNOBSERVED`.
    """

    index: int
    rgb: NDArray[np.uint8]
    depth: NDArray[np.float32]
    confidence: NDArray[np.float32]
    mask: NDArray[np.uint8]
    kind: NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Annotation:
    """Poses, intrinsics and a stream of dense depth for one video.

    Attributes:
        world_from_cam: (N, 4, 4) float64, OpenCV axes; the world is the first camera.
        camera: Shared camera model at source resolution.
        timestamps_s: (N,) float64 presentation times as the container states them.
        fps: Average frames per second.
        keyframes: (K,) int64 increasing frame indices.
        scale: `metric` is metres; `relative` one unknown scale for poses and depth together, in units in which the
            median inverse depth of the map is 1. `provenance.scale_source` says where it is from.
        depth_kind: `z` along the optical axis, `ray` distance from the centre.
        mask_phrases: What the ids of the masks stand for: `MASK_PHRASES`, and a phrase for each thing that was found.
        timings_s: Wall seconds per stage. Filled further while `dense` is consumed; never part of the payload bytes.
        peak_bytes: Most memory of the GPU that each stage took, in the same way; empty on a CPU.
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
    mask_phrases: Mapping[int, str] = field(default_factory=lambda: dict(MASK_PHRASES))
    peak_bytes: dict[str, int] = field(default_factory=dict)

    @property
    def num_frames(self) -> int:
        return len(self.world_from_cam)

    @property
    def trajectory_length(self) -> float:
        """Sum of the distances between consecutive camera centres, in units of the trajectory."""
        centres = self.world_from_cam[:, :3, 3]
        return float(np.linalg.norm(np.diff(centres, axis=0), axis=1).sum())
