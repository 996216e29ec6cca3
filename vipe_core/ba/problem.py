"""What a bundle adjustment is asked: measurements, state, what is free, and how the answer comes back.

Solver-independent. One `Problem` is a graph of directed edges between frames. Edge e = (i -> j) measures, for every
cell p of the source frame, where the point behind p is seen in frame j:

    r_e(p) = project(G_j G_i^-1 (ray(p), d_i(p)); K) - target_e(p)        weighted per component by weight_e(p)

with G = cam_from_world and d the inverse depth along the ray that the camera model returns (z = 1 for pinhole). Cells
are those of a grid, the same in every frame, or points of each frame's own.
Frames that are views of one rigid rig share its pose: G_n = cam_from_rig[view of n] rig_from_world[pose of n] (section
3.2.6); such a problem has a `Rig`, and may have intrinsics per view.
Units: pixels of the working image (integer pixel indices), inverse depth in 1 / world unit.
Paper section 3.2, equations of the dense term and of the depth prior; `torch_solver.py` says how it is solved.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Literal

import torch
from torch import Tensor

from vipe_core.cameras import CameraModel

Covariance = tuple[tuple[float, float], tuple[float, float]]
NO_COVARIANCE: Covariance = ((0.0, 0.0), (0.0, 0.0))
RobustKernel = Literal["none", "huber", "cauchy", "geman_mcclure", "tukey", "truncated"]


@dataclass(frozen=True, slots=True)
class Grid:
    """The cells of a frame that carry an inverse depth.

    Cell (row y, column x) samples the working image at index coordinates (x * stride + offset, y * stride + offset).
    """

    height: int
    width: int
    stride: float = 8.0
    offset: float = 3.5

    @property
    def num_cells(self) -> int:
        return self.height * self.width

    def sample_px(self, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu") -> Tensor:
        """(P, 2) index coordinates (u, v) of all cells, row-major."""
        v, u = torch.meshgrid(
            torch.arange(self.height, dtype=dtype, device=device) * self.stride + self.offset,
            torch.arange(self.width, dtype=dtype, device=device) * self.stride + self.offset,
            indexing="ij",
        )
        return torch.stack((u.reshape(-1), v.reshape(-1)), dim=-1)


@dataclass(frozen=True, slots=True)
class Points:
    """Places of a frame's own that carry an inverse depth: those of tracks alone, or of a grid and then of tracks.

    Attributes:
        px: (N, P, 2) finite index coordinates (u, v) in the working image.
        count: (N,) int64 how many of a frame's are real, from its first on. What is behind them fills up: it is finite,
            nothing gives it weight, and its inverse depth stays.
    """

    px: Tensor
    count: Tensor

    def __post_init__(self) -> None:
        if self.px.ndim != 3 or self.px.shape[2] != 2 or self.count.shape != self.px.shape[:1]:
            raise ValueError(f"points disagree in shape: {self.px.shape = }, {self.count.shape = }")

    @classmethod
    def beside(cls, grid: Grid, px: Tensor, count: Tensor) -> Points:
        """The cells of a grid, then points of each frame: (N, M, 2) of which (N,) are real."""
        cells = grid.sample_px(px.dtype, px.device).expand(len(px), -1, -1)
        return cls(torch.cat((cells, px), dim=1), count + grid.num_cells)

    @property
    def num_cells(self) -> int:
        return int(self.px.shape[1])

    def sample_px(self, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu") -> Tensor:
        """(N, P, 2) index coordinates (u, v)."""
        return self.px.to(device, dtype)

    def real(self, device: torch.device | str = "cpu") -> Tensor:
        """(N, P) bool."""
        return torch.arange(self.num_cells, device=device) < self.count.to(device)[:, None]


@dataclass(frozen=True, slots=True)
class Edges:
    """Directed measurements, in any order.

    Attributes:
        source: (E,) int64 frame that owns the inverse depth.
        target: (E,) int64 frame that the points are seen in; differs from `source`.
        target_px: (E, P, 2) float32 measured index coordinates in the target frame.
        weight: (E, P, 2) float32 inverse variance of u and v, 1/px^2; 0 is no measurement.
    """

    source: Tensor
    target: Tensor
    target_px: Tensor
    weight: Tensor

    def __post_init__(self) -> None:
        num_edges = len(self.source)
        if (
            self.target.shape != (num_edges,)
            or self.target_px.shape != self.weight.shape
            or (self.target_px.ndim != 3 or self.target_px.shape[0] != num_edges or self.target_px.shape[2] != 2)
        ):
            raise ValueError(
                "edges disagree in shape: "
                f"{self.source.shape = }, {self.target.shape = }, {self.target_px.shape = }, {self.weight.shape = }"
            )


@dataclass(frozen=True, slots=True)
class Rig:
    """Which frames are views of a rigid rig at one instant.

    Attributes:
        pose_of_frame: (N,) int64 number of the rig pose behind each frame, 0..R-1.
        view_of_frame: (N,) int64 which camera of the rig took it, 0..V-1.
    """

    pose_of_frame: Tensor
    view_of_frame: Tensor


@dataclass(frozen=True, slots=True)
class State:
    """The unknowns.

    Attributes:
        cam_from_world: (N, 4, 4) float64 rigid transforms. Those of a rig agree with `cam_from_rig`: all frames of one
            rig pose give the same inverse(cam_from_rig[view]) @ cam_from_world.
        inverse_depth: (N, P) float32 or float64, positive.
        intrinsics: (K,) float64, `Camera.index_params` of the working image: (fx, fy, cx, cy[, alpha]). Of a rig, also
            (V, K): each view has its own.
        cam_from_rig: (V, 4, 4) float64 of a rig, else None.
    """

    cam_from_world: Tensor
    inverse_depth: Tensor
    intrinsics: Tensor
    cam_from_rig: Tensor | None = None


@dataclass(frozen=True, slots=True)
class Free:
    """What may move.

    Attributes:
        poses: (N,) bool, the same for all frames of one rig pose. At least one pose must be fixed unless there is
            nothing else to hold the gauge.
        inverse_depth: (N,) bool, per frame.
        focal: Whether the focal length moves (fx and fy by the same factor; log-parametrised); every view's by itself
            where they have their own.
        distortion: Whether alpha of the unified model moves.
        extrinsics: Whether `State.cam_from_rig` moves but for view 0, which holds the gauge.
    """

    poses: Tensor
    inverse_depth: Tensor
    focal: bool = False
    distortion: bool = False
    extrinsics: bool = False


@dataclass(frozen=True, slots=True)
class Priors:
    """Soft knowledge, each with its own information (inverse variance).

    Attributes:
        inverse_depth: (N, P) prior value, or None.
        inverse_depth_weight: (N, P) information of that prior; 0 where there is none.
        inverse_depth_scale_sigma: Standard deviation of the factor that a frame's prior values have for themselves; 0
            holds it at one.
        inverse_depth_shift_sigma: Of what is added to them, 1 / world unit; 0 holds it at zero.
        log_focal: Prior of log(fx), or None. Where views have intrinsics of their own, of each of them, or one each.
        log_focal_sigma: Its standard deviation.
        cam_from_rig: (V, 4, 4) prior of the extrinsics, or None.
        extrinsic_sigma: (V, 2) its standard deviations: of the place in world units, of the rotation in radians.
    """

    inverse_depth: Tensor | None = None
    inverse_depth_weight: Tensor | None = None
    log_focal: float | tuple[float, ...] | None = None
    log_focal_sigma: float = 1.0
    cam_from_rig: Tensor | None = None
    extrinsic_sigma: Tensor | None = None
    inverse_depth_scale_sigma: float = 0.0
    inverse_depth_shift_sigma: float = 0.0

    def __post_init__(self) -> None:
        if (self.cam_from_rig is None) != (self.extrinsic_sigma is None):
            raise ValueError("a prior of the extrinsics needs its standard deviations")


@dataclass(frozen=True, slots=True)
class Problem:
    """One bundle adjustment. Frames that no edge touches are left as they are, but for those of a rig that moves.

    Edges between frames of one rig pose say nothing about it: a rig pose that no other edge touches stays.
    """

    camera_model: CameraModel
    grid: Grid | Points
    edges: Edges
    free: Free
    priors: Priors = field(default_factory=Priors)
    rig: Rig | None = None

    @property
    def refines_rig(self) -> bool:
        """Whether the extrinsics of a rig are among the unknowns."""
        return self.rig is not None and self.free.extrinsics


@dataclass(frozen=True, slots=True)
class Options:
    """How to solve it: Levenberg-Marquardt that accepts only a lower robust cost.

    Attributes:
        max_iterations: Upper bound of accepted plus rejected steps.
        relative_tolerance: Stop when a step lowers the cost, or is expected to, by less than this share.
        robust: Kernel on the 2-norm of the residual in pixels. `truncated` is truncated least squares, min(s, c^2):
            what is further off than c has no say at all, so it needs a start within c, or graduation.
        componentwise: Whether the kernel judges u and v each for itself, as the paper's own code does; not the norm.
        robust_scale_px: Its scale c.
        initial_scale_px: Graduated non-convexity (Yang et al. 2020): the scale to begin with, which narrows to c as the
            cost is lowered; infinity begins where a Geman-McClure or truncated kernel is convex over all residuals.
            None is c.
        initial_damping: First LM damping of the (scaled) reduced system.
        min_inverse_depth: Lower clamp of inverse depth after a step, relative to the median of the problem's.
        max_inverse_depth: Upper clamp, likewise.
        min_depth_ratio: A measurement counts only where the transformed homogeneous z exceeds this (z starts at 1).
    """

    max_iterations: int = 10
    relative_tolerance: float = 1e-4
    robust: RobustKernel = "geman_mcclure"
    componentwise: bool = False
    robust_scale_px: float = 3.0
    initial_scale_px: float | None = None
    initial_damping: float = 1e-4
    min_inverse_depth: float = 1e-3
    max_inverse_depth: float = 1e3
    min_depth_ratio: float = 0.1


class Status(StrEnum):
    """Why a solve ended. Failures return the state of the last accepted step, never a silent zero step."""

    CONVERGED = "converged"
    MAX_ITERATIONS = "max_iterations"
    NO_PROGRESS = "no_progress"  # damping ran out without a lower cost: already at a minimum
    SINGULAR = "singular"  # the reduced system was not positive definite at the largest damping
    NON_FINITE = "non_finite"  # the input state or measurements hold NaN or infinity
    EMPTY = "empty"  # nothing is free, or no edge has a weight


@dataclass(frozen=True, slots=True)
class Result:
    """The answer.

    Attributes:
        state: New state, same shapes and dtypes as the input.
        status: Why it ended.
        iterations: Steps tried.
        initial_cost: Robust cost of the measurements before: sum of w rho(r^T W r / w) at scale c, with w the larger of
            the two weights of a measurement; componentwise, of w_u rho(r_u^2) + w_v rho(r_v^2). Priors are not in it.
        cost: Robust cost after.
        weight_sum: Sum of these w over valid measurements at the end; `cost / weight_sum` is a mean squared residual,
            px^2.
        intrinsics_covariances: ((var, cov), (cov, var)) of log(f) and alpha from the reduced system at the end, with
            everything else marginalised; 0 for what was fixed, NaN where the system says nothing. One, or one per view
            where each has its own intrinsics.
        extrinsic_covariances: (V, 6, 6) float64 on the host, of the left twists (place in world units, rotation in
            radians) of `State.cam_from_rig`, likewise; None where extrinsics were fixed.
    """

    state: State
    status: Status
    iterations: int
    initial_cost: float
    cost: float
    weight_sum: float
    intrinsics_covariances: tuple[Covariance, ...] = (NO_COVARIANCE,)
    extrinsic_covariances: Tensor | None = None

    @property
    def intrinsics_covariance(self) -> Covariance:
        """That of the only camera, or of the first view."""
        return self.intrinsics_covariances[0]

    @property
    def log_focal_sigma(self) -> float:
        """1-sigma of log(f); NaN when the focal length was fixed."""
        variance = self.intrinsics_covariance[0][0]
        return math.sqrt(variance) if variance > 0 else math.nan
