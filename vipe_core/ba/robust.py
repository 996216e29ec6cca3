"""Robust kernels on a squared residual s (px^2): the cost rho(s), with rho(s) ~ s near zero, and its slope."""

from __future__ import annotations

import torch
from torch import Tensor

from vipe_core.ba.problem import RobustKernel


def cost(kernel: RobustKernel, scale_px: float, squared: Tensor) -> Tensor:
    """rho(s), px^2, elementwise."""
    c2 = scale_px * scale_px
    if kernel == "none":
        return squared
    if kernel == "huber":
        return torch.where(squared <= c2, squared, 2 * scale_px * squared.sqrt() - c2)
    if kernel == "cauchy":
        return c2 * torch.log1p(squared / c2)
    if kernel == "tukey":
        return c2 / 3 * (1 - (1 - squared / c2).clamp_min(0) ** 3)
    return squared * (c2 / (c2 + squared))


def root_slope(kernel: RobustKernel, scale_px: float, squared: Tensor) -> Tensor | None:
    """sqrt(rho'(s)): what residual and Jacobian are multiplied with (iteratively reweighted least squares).

    None means one everywhere.
    """
    c2 = scale_px * scale_px
    if kernel == "none":
        return None
    if kernel == "huber":
        return (c2 / squared.clamp_min(c2)).sqrt().sqrt()
    if kernel == "cauchy":
        return (squared / c2 + 1).rsqrt()
    if kernel == "tukey":
        return (1 - squared / c2).clamp_min(0)
    return (squared / c2 + 1).reciprocal()
