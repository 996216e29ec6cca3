"""Robust kernels on a squared residual s (px^2): the cost rho(s), with rho(s) ~ s near zero, and its slope.

Graduated non-convexity starts from a wider scale than the one it ends at. Most kernels are then only wider. Truncated
least squares, rho(s) = min(s, c^2), has a surrogate of its own (Yang et al. 2020, equation 13): with a scale u > c,
mu = c^2 / (u^2 - c^2), it is s up to c^4 / u^2, constant from u^2 on, and between them, concave and smooth,

    rho(s) = c^2 (r (2 u - r) - c^2) / (u^2 - c^2),    rho'(s) = c^2 (u - r) / (r (u^2 - c^2)),    r = sqrt(s)

At u^2 = 2 max s, where it is convex over all residuals, that is their first mu; dividing u^2 multiplies mu.
"""

from __future__ import annotations

import torch
from torch import Tensor

from vipe_core.ba.problem import RobustKernel

# As the compiled loops and the CUDA kernels call them.
CODE: dict[RobustKernel, int] = {
    "none": 0,
    "huber": 1,
    "cauchy": 2,
    "geman_mcclure": 3,
    "tukey": 4,
    "truncated": 5,
}


def cost(kernel: RobustKernel, scale_px: float, squared: Tensor, final_px: float | None = None) -> Tensor:
    """rho(s), px^2, elementwise; not finite where s is not.

    Args:
        scale_px: Of the kernel at present.
        squared: s.
        final_px: The scale that graduated non-convexity ends at; None is `scale_px`.
    """
    c2 = scale_px * scale_px
    if kernel == "none":
        return squared
    if kernel == "huber":
        return torch.where(squared <= c2, squared, 2 * scale_px * squared.sqrt() - c2)
    if kernel == "cauchy":
        return c2 * torch.log1p(squared / c2)
    if kernel == "tukey":
        return c2 / 3 * (1 - _inside(c2, squared) ** 3)
    if kernel == "truncated":
        inlier, final2, wide = _truncation(scale_px, final_px, squared)
        root = squared.sqrt()
        share = torch.where(root < scale_px, (root * (2 * scale_px - root) - final2) / wide, 1 + (root - root))
        return torch.where(inlier, squared, final2 * share.clamp(final2 / c2, 1))
    return squared * (c2 / (c2 + squared))


def root_slope(kernel: RobustKernel, scale_px: float, squared: Tensor, final_px: float | None = None) -> Tensor | None:
    """sqrt(rho'(s)): what residual and Jacobian are multiplied with (iteratively reweighted least squares).

    None means one everywhere. Arguments as in `cost`.
    """
    c2 = scale_px * scale_px
    if kernel == "none":
        return None
    if kernel == "huber":
        return (c2 / squared.clamp_min(c2)).sqrt().sqrt()
    if kernel == "cauchy":
        return (squared / c2 + 1).rsqrt()
    if kernel == "tukey":
        return _inside(c2, squared)
    if kernel == "truncated":
        inlier, final2, wide = _truncation(scale_px, final_px, squared)
        root = squared.sqrt()
        # Up to here it is less than where truncation begins.
        gap = (scale_px - root).clamp(0, wide / scale_px)
        return torch.where(inlier, 1, (final2 * (gap / wide) / root).sqrt())
    return (squared / c2 + 1).reciprocal()


def _inside(c2: float, squared: Tensor) -> Tensor:
    """1 - s / c^2, zero from s = c^2 on."""
    return torch.where(squared < c2, 1 - squared / c2, squared - squared)


def _truncation(scale_px: float, final_px: float | None, squared: Tensor) -> tuple[Tensor, float, float]:
    """Whether s is below all truncation, c^2, and u^2 - c^2."""
    c2, final2 = scale_px * scale_px, (final_px or scale_px) ** 2
    return squared * c2 <= final2 * final2, final2, max(c2 - final2, torch.finfo(torch.float32).tiny)
