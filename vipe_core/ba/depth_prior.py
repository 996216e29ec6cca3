"""Prior inverse depths, and their scale and shift where these are each frame's own.

What a network says of single pictures is off by another factor in each of them. So the prior of frame i may be
s m(p) + b, with s ~ N(1, sigma_s) and b ~ N(0, sigma_b) for itself:

    sum_p w (s m + b - d)^2 + ((s - 1) / sigma_s)^2 + (b / sigma_b)^2

For any depths, s and b are known in closed form, so they are no state: the cost is this minimum (variable projection).
A step is the one of depths, s and b together. With Q = 1 / C of the depths, U = -w [m 1], A = U^T U / w + diag(1 /
sigma^2) and S = A - U^T Q U, the depths' part of the inverse Hessian is no longer Q but

    Q + Q U S^-1 U^T Q

so a frame's elimination has as many more columns as unknowns: with S = L L^T, X is continued by X V^T, V = L^-1 U^T
sqrt(Q). Damping scales the Hessian of depths, s and b as a whole, as it does that of depths alone. The reduced system
of poses does not grow.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from vipe_core.ba.problem import Priors
from vipe_core.transfer import uploaded


class DepthPrior(NamedTuple):
    """Of F frames.

    Attributes:
        weight: (F, P) information.
        off: (F, P) s m + b minus the state's inverse depths; 0 without weight.
        cost: (F,) float64, of s and b.
        coupling: (F, k, P) float64, -U^T for the k that are free; None where there are none.
        curvature: (F, k, k) float64, A; likewise.
    """

    weight: Tensor
    off: Tensor
    cost: Tensor
    coupling: Tensor | None = None
    curvature: Tensor | None = None


def has_freedom(priors: Priors) -> bool:
    """Whether frames have a scale or a shift of their own."""
    given = priors.inverse_depth is not None and priors.inverse_depth_weight is not None
    return given and (priors.inverse_depth_scale_sigma > 0 or priors.inverse_depth_shift_sigma > 0)


def depth_prior(priors: Priors, inverse_depth: Tensor, frames: Tensor | slice) -> DepthPrior | None:
    """The prior of some of a state's (N, P) inverse depths, in their dtype; None without one."""
    if priors.inverse_depth is None or priors.inverse_depth_weight is None:
        return None
    depth = inverse_depth[frames]
    weight = priors.inverse_depth_weight[frames].to(depth)
    value = torch.where(weight > 0, priors.inverse_depth[frames].to(depth), 0)
    nothing = torch.zeros(len(depth), dtype=torch.float64, device=depth.device)
    if not has_freedom(priors):
        return DepthPrior(weight, value - depth, nothing)
    said = [
        (rows, sigma, expected)
        for rows, sigma, expected in (
            (value.double(), priors.inverse_depth_scale_sigma, 1.0),
            (torch.ones_like(value, dtype=torch.float64), priors.inverse_depth_shift_sigma, 0.0),
        )
        if sigma > 0
    ]
    basis = torch.stack([rows for rows, _, _ in said], dim=1)
    information = uploaded(torch.tensor([sigma**-2 for _, sigma, _ in said], dtype=torch.float64), basis.device)
    expected = uploaded(torch.tensor([mean for _, _, mean in said], dtype=torch.float64), basis.device)
    coupling = basis * weight[:, None]
    curvature = coupling @ basis.mT + torch.diag(information)
    held = 0 if priors.inverse_depth_scale_sigma > 0 else value
    pull = (coupling @ (depth - held).double()[..., None])[..., 0] + information * expected
    # Nothing here waits for a GPU.
    found = torch.cholesky_solve(pull[..., None], torch.linalg.cholesky_ex(curvature)[0])[..., 0]
    fitted = held + (found[:, None] @ basis)[:, 0].to(depth)
    cost = (information * (found - expected).square()).sum(-1)
    return DepthPrior(weight, torch.where(weight > 0, fitted - depth, 0), cost, coupling, curvature)


def eliminate(prior: DepthPrior | None, x: Tensor, root_q: Tensor) -> tuple[Tensor, Tensor | None]:
    """Factors of the elimination with scale and shift of the prior.

    Args:
        x: (F, rows, P) of the depths alone.
        root_q: (F, P).

    Returns:
        (F, rows, P + k), and V (F, k, P) or None where nothing more is eliminated.
    """
    if prior is None or prior.coupling is None or prior.curvature is None:
        return x, None
    scaled = prior.coupling * root_q[:, None]
    factor = torch.linalg.cholesky_ex(prior.curvature - scaled @ scaled.mT)[0]
    v = torch.linalg.solve_triangular(factor, scaled, upper=False).to(x)
    return torch.cat((x, x @ v.mT), dim=-1), v
