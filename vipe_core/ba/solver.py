"""What the Levenberg-Marquardt loop asks of a solver, and what it gets back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, TypeVar

from torch import Tensor

from vipe_core.ba.problem import State


@dataclass(frozen=True, slots=True)
class Cost:
    """Sums over all measurements, 0-dim float64 tensors.

    Attributes:
        measurements: sum of wmax rho(s) where valid, px^2.
        weight: sum of wmax where valid.
        lost_weight: sum of wmax where the point is not in front of the target camera.
        priors: Cost of the priors.
    """

    measurements: Tensor
    weight: Tensor
    lost_weight: Tensor
    priors: Tensor

    def total(self, lost_rho: Tensor) -> Tensor:
        """What a step must lower. Lost measurements cost `lost_rho` each, else losing them all would be best."""
        return self.measurements + self.priors + lost_rho * self.lost_weight


@dataclass(frozen=True, slots=True)
class Step:
    """An update of the state.

    Attributes:
        pose: (N, 6) float64 left twists of cam_from_world (translation, rotation); of a rig, what the rig poses
            contribute to it.
        log_focal: 0-dim float64; (V,) where each view has its own intrinsics.
        alpha: 0-dim float64; (V,) likewise.
        inverse_depth: (N, P), before clamping.
        predicted_drop: 0-dim float64, g^T step: how much the undamped quadratic model expects to gain.
        factorised: 0-dim bool, whether the reduced system was positive definite; otherwise the step is not finite.
        extrinsic: (V, 6) float64 left twists of cam_from_rig, after those of the poses, or None without a rig.
    """

    pose: Tensor
    log_focal: Tensor
    alpha: Tensor
    inverse_depth: Tensor
    predicted_drop: Tensor
    factorised: Tensor
    extrinsic: Tensor | None = None


class Linearised(Protocol):
    """The normal equations at a state, to be solved for any damping."""

    @property
    def cost(self) -> Cost:
        """The robust cost there, a by-product."""


System = TypeVar("System", bound=Linearised)


class Solver(Protocol[System]):
    """Cost, linearisation and step of one problem; holds no state of the unknowns.

    Scales are those of the robust kernel, px.

    Attributes:
        anything_free: Whether there is an unknown.
        intrinsics_free: Whether log f and alpha are.
    """

    anything_free: bool
    intrinsics_free: tuple[bool, bool]

    def cost(self, state: State, scale_px: float) -> Cost:
        """The robust cost at a state."""

    def linearise(self, state: State, scale_px: float) -> System:
        """The normal equations at a state."""

    def step(self, system: System, damping: float) -> Step:
        """Solve the damped system."""

    def retract(self, state: State, step: Step) -> State:
        """The state after a step. Whatever the step does not touch keeps its bits."""

    def intrinsics_covariance(self, system: System, damping: float) -> Tensor:
        """(C, 2, 2) covariance of log f and alpha of each camera with everything else marginalised: 0 for what is held,
        NaN where the damped system is singular."""

    def extrinsic_covariance(self, system: System, damping: float) -> Tensor:
        """(V, 6, 6) covariance of the left twists of each camera of a rig, likewise."""

    def pose_covariance(self, system: System, damping: float, frame: int) -> Tensor:
        """(6, 6) covariance of the left twist of the pose of a frame, or of the rig pose behind it, likewise."""
