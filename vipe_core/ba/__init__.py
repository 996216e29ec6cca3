"""Dense bundle adjustment: the problem, its plan, and its solvers."""

from vipe_core.ba.levenberg import newton_step, pose_covariance
from vipe_core.ba.operator import solve
from vipe_core.ba.problem import (
    Edges,
    Free,
    Grid,
    Options,
    Points,
    Priors,
    Problem,
    Result,
    Rig,
    RobustKernel,
    State,
    Status,
)
from vipe_core.ba.reprojection import reproject, residuals
from vipe_core.ba.scale import largest_residual_px, residual_sigma_px, robust_scale_px
from vipe_core.ba.solver import Step

__all__ = [
    "Edges",
    "Free",
    "Grid",
    "Options",
    "Points",
    "Priors",
    "Problem",
    "Result",
    "Rig",
    "RobustKernel",
    "State",
    "Status",
    "Step",
    "largest_residual_px",
    "newton_step",
    "pose_covariance",
    "reproject",
    "residual_sigma_px",
    "residuals",
    "robust_scale_px",
    "solve",
]
