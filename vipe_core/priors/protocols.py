"""One protocol per role. A preset names a provider for each; the pipeline knows only these.

All images are uint8 working images (see `WorkingFrame`); all pixel coordinates are integer-index coordinates of them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from vipe_core.annotation import DepthKind
from vipe_core.ba.problem import Grid
from vipe_core.cameras import Camera
from vipe_core.video.source import Frame

Array = NDArray[Any]


@dataclass(frozen=True, slots=True)
class WorkingFrame:
    """A frame resized to the working resolution of the SLAM stage.

    Attributes:
        index: Frame index in the video.
        gray: (h, w) uint8.
        rgb: (h, w, 3) uint8.
        valid: (h, w) bool, False on pixels that must not be used (a user's mask, a moving object), or None.
    """

    index: int
    gray: NDArray[np.uint8]
    rgb: NDArray[np.uint8]
    valid: NDArray[np.bool_] | None = None


@dataclass(frozen=True, slots=True)
class Match:
    """A dense measurement from one frame to another, sampled at the cells of a grid (row-major, P cells).

    Attributes:
        target_px: (P, 2) float32 where each source cell is seen in the target.
        weight: (P, 2) float32 inverse variance in 1/px^2 per component; 0 where there is no measurement.
        consistent: Share of in-bounds cells that pass the forward-backward check, 0..1.
    """

    target_px: NDArray[np.float32]
    weight: NDArray[np.float32]
    consistent: float


class DenseMatcher(Protocol):
    """Dense matching between working frames (paper: the DROID update operator; here any provider)."""

    def encode(self, frame: WorkingFrame) -> Any:
        """Per-frame features, computed once and kept with the keyframe."""

    def is_blank(self, features: Any) -> bool:
        """Whether the picture holds nothing to match, such as a black one: neither its motion nor a match with it means
        anything."""

    def motion_px(self, source: Any, target: Any) -> float:
        """Cheap median displacement over textured cells, in pixels: the motion filter's score."""

    def match(self, source: Any, target: Any, guess_px: Array | None = None) -> tuple[Match, Match]:
        """Measurements source -> target and target -> source.

        Args:
            source: Features of `encode`.
            target: Features of `encode`.
            guess_px: (P, 2) where the current estimate sees the source cells in the target; the starting point of the
                refinement, or None.
        """

    def match_fast(self, source: Any, target: Any, guess_px: Array | None = None) -> Match:
        """Cheaper one-way measurement for posing frames between keyframes."""


@runtime_checkable
class BatchEncoder(Protocol):
    """A matcher whose features are cheaper for several frames at once.

    Attributes:
        batch_frames: How many are best given together.
        bytes_per_px: Memory that the features of a frame hold, for each pixel of it.
    """

    batch_frames: int
    bytes_per_px: float

    def encode_batch(self, frames: Sequence[WorkingFrame]) -> list[Any]:
        """What `DenseMatcher.encode` gives for each frame."""


@dataclass(frozen=True, slots=True)
class Refined:
    """What one update of a refinement says. All tensors are on its device, and float32.

    Attributes:
        target_px: (E, P, 2) where the source cells of each edge are seen in the target.
        weight: (E, P, 2) inverse variance in 1/px^2 per component; 0 on cells that must not be used.
        damping: (S, P) information on the inverse depth of each source frame (in increasing order of their numbers), of
            staying where it is: px^-2 per (inverse depth as a share of the map's median)^2 as in `weight`.
    """

    target_px: Tensor
    weight: Tensor
    damping: Tensor


class Refinement(Protocol):
    """Directed edges between frames whose measurements are improved together with the geometry (paper section 3.2.1).

    Every edge has a state that remembers what was said of it. An update is asked where the geometry sees the cells; the
    geometry is then adjusted to the answer, and so on in turns.
    """

    def __len__(self) -> int:
        """Number of edges."""

    def add(self, pairs: Sequence[tuple[Any, Any]], seen_px: Tensor) -> None:
        """Append edges.

        Args:
            pairs: Features of `DenseMatcher.encode` of the source and the target of each.
            seen_px: (E, P, 2) where the geometry sees the source cells in the target.
        """

    def keep(self, rows: Sequence[int]) -> None:
        """Forget all edges but those of these rows."""

    def update(self, seen_px: Tensor, sources: Sequence[int]) -> Refined:
        """Improve all edges.

        Args:
            seen_px: (E, P, 2) where the geometry sees the source cells now, anything where it does not.
            sources: Number of the source frame of each edge: edges out of one frame inform each other.
        """


class Refiner(Protocol):
    """Measurements that are refined in turns with bundle adjustment, as a recurrent network does.

    Attributes:
        offset_px: Where in a cell its sample point is; see `Grid.offset`.
    """

    @property
    def offset_px(self) -> float: ...

    def picture(self, features: Any) -> NDArray[np.uint8]:
        """(h, w, 3) the working picture behind features of `DenseMatcher.encode`."""

    def begin(self, grid: Grid, *, lean: bool, spilled: bool = False) -> Refinement:
        """A refinement without edges.

        Args:
            grid: Cells of the frames.
            lean: Rather slower than with memory that grows with the edges by more than their states: for whole graphs.
            spilled: The states of edges, too, lie in the memory of the host between two updates.
        """


class SparseTracker(Protocol):
    """Corner tracks between two frames, already splatted to the grid (paper: the sparse term)."""

    def match(self, source: Any, target: Any, dense: Match) -> Match:
        """Measurements at the cells that hold a track; weight 0 elsewhere. `dense` guides the search."""


@dataclass(frozen=True, slots=True)
class TrackedPoints:
    """Points of a frame that were followed to it, or begin there.

    Attributes:
        ids: (n,) int64: a point keeps its own for as long as it is followed, and nobody has it afterwards.
        px: (n, 2) float32 where they are.
    """

    ids: NDArray[np.int64]
    px: NDArray[np.float32]


class PointFollower(Protocol):
    """Follows points through the frames of a shot, in order (paper section 3.2.2). Stateless between calls."""

    def input_size(self, width: int, height: int) -> tuple[int, int]:
        """(width, height) at which a video of that size is best given."""

    def follow(self, frames: Iterable[Frame], camera: Camera) -> Iterator[TrackedPoints]:
        """The points of every frame, in order; none on pixels that a frame says must not be used.

        Args:
            camera: As far as it is known, at the size of the frames.
        """


class Aligner(Protocol):
    """Measurements of the last digit, once the geometry is known to a few pixels (paper: the recurrent update)."""

    def align(self, source: Any, target: Any, guess_px: Array, wanted: Array) -> Match:
        """One-way measurement, each cell by itself.

        Args:
            guess_px: (P, 2) where the current estimate sees the source cells in the target, right to a few pixels; NaN
                where it knows nothing. Its local derivative tells how the picture is distorted.
            wanted: (P,) bool, the cells to measure.

        Returns:
            `consistent` is the share of the textured ones of the wanted cells with a guess that were aligned.
        """


@dataclass(frozen=True, slots=True)
class Correspondences:
    """The same points in two frames, verified by epipolar geometry; a few may still be wrong.

    Attributes:
        source_px: (n, 2) float32.
        target_px: (n, 2) float32.
    """

    source_px: NDArray[np.float32]
    target_px: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.source_px)

    @classmethod
    def none(cls) -> Correspondences:
        return cls(np.zeros((0, 2), np.float32), np.zeros((0, 2), np.float32))


class PointMatcher(Protocol):
    """Correspondences between frames however far apart, for where dense matching needs a starting point."""

    def correspond(self, source: Any, target: Any) -> Correspondences:
        """Correspondences between two frames; empty when there are too few to be sure of.

        Args:
            source: Features of `DenseMatcher.encode`.
            target: Features of `DenseMatcher.encode`.
        """

    def overview(self, features: Any) -> NDArray[np.float32]:
        """(n, D) descriptors of unit length by which places are recognised."""


@dataclass(frozen=True, slots=True)
class IntrinsicsEstimate:
    """An initial camera with how far it can be trusted.

    Attributes:
        camera: At the working resolution.
        log_focal_sigma: Standard deviation of log(f): about 0.05 for a sure estimate, 0.3 for a default.
        num_pairs: Number of frames and pairs of frames behind it; 0 means a default was taken.
        rivals_px: Focal lengths for which there is evidence that contradicts the camera's: to be tried too.
    """

    camera: Camera
    log_focal_sigma: float
    num_pairs: int
    rivals_px: tuple[float, ...] = ()


class IntrinsicsInit(Protocol):
    def estimate(self, frames: Sequence[WorkingFrame], grid: Grid) -> IntrinsicsEstimate:
        """Estimate the camera from frames spread over the clip (in time order, consecutive runs allowed)."""


@dataclass(frozen=True, slots=True)
class PriorFamily:
    """The providers of the geometric roles, made to work together (the tracker reads the matcher's features).

    Attributes:
        matcher: Dense matching.
        tracker: Sparse tracks, or None for a family whose dense matching needs none.
        points: Correspondences across wide steps, or None for a family whose dense matching needs none.
        intrinsics: Initial camera.
        aligner: Measurements near the finished geometry, or None for a family whose dense matching is as good.
        refiner: Measurements refined in turns with the geometry, which then replaces pairwise matching in the map; None
            for a family that measures each pair once.
        metric: Metric depth as a prior of the map, with a refiner; None without.
        follower: Tracks through consecutive frames that add to what a refiner measures; None without.
    """

    matcher: DenseMatcher
    tracker: SparseTracker | None
    points: PointMatcher | None
    intrinsics: IntrinsicsInit
    aligner: Aligner | None = None
    refiner: Refiner | None = None
    metric: MetricDepth | None = None
    follower: PointFollower | None = None


class VideoDepth(Protocol):
    """Depth of runs of frames that is smooth over time, up to one scale and one shift of inverse depth per run.

    Stateless between calls. All depth roles take pictures of any size and answer at the size they were given.
    """

    @property
    def depth_kind(self) -> DepthKind:
        """Of which depth the answer is the inverse."""

    @property
    def window_frames(self) -> int:
        """Most frames of a call."""

    @property
    def overlap_frames(self) -> int:
        """How many of them should be those that the call before ended with: at least 2, fewer than a window."""

    def input_size(self, width: int, height: int) -> tuple[int, int]:
        """(width, height) at which a video of that size is best given."""

    def predict(self, frames: Sequence[NDArray[np.uint8]]) -> NDArray[np.float32]:
        """(n, h, w) inverse depth of 1 to `window_frames` consecutive frames (h, w, 3): nearer is larger; NaN where the
        model says nothing."""


@dataclass(frozen=True, slots=True)
class MetricEstimate:
    """Metric depth of one picture.

    Attributes:
        depth_m: (h, w) float32; 0 where there is none, such as the sky.
        confidence: (h, w) float32 in 0..1.
    """

    depth_m: NDArray[np.float32]
    confidence: NDArray[np.float32]


class MetricDepth(Protocol):
    """Metric depth of single pictures (paper section 3.2.3). Stateless between calls."""

    @property
    def depth_kind(self) -> DepthKind:
        """Of `MetricEstimate.depth_m`."""

    @property
    def shared_sigma_ratio(self) -> float:
        """Standard deviation of the logarithm of the scale that all frames of a video share: 0.1 for 10 %."""

    def input_size(self, width: int, height: int) -> tuple[int, int]:
        """(width, height) at which a video of that size is best given."""

    def estimate(self, rgb: NDArray[np.uint8], camera: Camera) -> MetricEstimate:
        """Depth of a picture (h, w, 3) of a camera at its size."""


class DepthCompletion(Protocol):
    """Dense depth from a picture and the depth of a few of its pixels (paper section 3.3). Stateless between calls."""

    def complete(self, rgb: NDArray[np.uint8], depth: NDArray[np.float32], camera: Camera) -> NDArray[np.float32]:
        """(h, w) depth, positive everywhere, in the units and of the kind of the given one.

        Args:
            rgb: (h, w, 3).
            depth: (h, w) along the rays of the camera; 0 where it is not known. Known for 5 pixels at least.
            camera: At this size.
        """


@dataclass(frozen=True, slots=True)
class DepthFamily:
    """The providers of dense depth. Without any, depth is multi-view stereo and scale is relative.

    Attributes:
        video: Video depth, aligned to the map; without one, depth is multi-view stereo.
        completion: Completes the projected map where it is sparse, before video depth is aligned to it.
        metric: Metric scale, and what video depth is aligned to where there is no map.
    """

    video: VideoDepth | None = None
    completion: DepthCompletion | None = None
    metric: MetricDepth | None = None


@dataclass(frozen=True, slots=True)
class Instances:
    """The things of one frame.

    Attributes:
        ids: (h, w) uint8 at the size of the frame: 0, or an id from `FIRST_INSTANCE` on that a thing keeps for as long
            as it is followed.
        phrases: What each id so far stands for.
    """

    ids: NDArray[np.uint8]
    phrases: Mapping[int, str]


class InstanceMasks(Protocol):
    """Finds things of which phrases tell the kind, and follows them through a video (paper section 3.1).

    Stateless between videos.
    """

    def input_size(self, width: int, height: int) -> tuple[int, int]:
        """(width, height) at which a video of that size is best given."""

    def follow(self, frames: Iterable[Frame]) -> Iterator[Instances]:
        """One answer for every frame, in order, in memory that does not grow with their number."""
