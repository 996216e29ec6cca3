"""The scale of the residuals of a state: what a robust kernel should take for ordinary, and the largest of them."""

from __future__ import annotations

import math
from collections.abc import Iterator

import torch
from torch import Tensor

from vipe_core.ba.problem import Edges, Options, Problem, RobustKernel, State
from vipe_core.ba.reprojection import reproject

# Scale over standard deviation at which a kernel on the norm of a two-dimensional Gaussian residual keeps 95 % of the
# efficiency of least squares: the c that solves (E[w + r w' / 2])^2 = 0.95 E[r^2 w^2] / 2 for the kernel's weight w(r).
_EFFICIENT_RATIO = {"none": 1.0, "huber": 1.50, "cauchy": 2.55, "geman_mcclure": 4.10, "tukey": 5.12, "truncated": 3.08}
# The norm of a two-dimensional Gaussian is Rayleigh distributed; its median over the standard deviation of a component.
_RAYLEIGH_MEDIAN = math.sqrt(2 * math.log(2))
_BATCH_CELLS = 1 << 18
_MAX_SAMPLES = 1 << 18


def residual_sigma_px(problem: Problem, state: State) -> float:
    """Standard deviation of a component of the residuals, as far as their smaller half tells; NaN without any.

    The weighted median of the residual norms over that of a unit Gaussian, so up to half of the weight may be outliers.
    A large problem is sampled: evenly spaced edges, all of their cells.
    """
    count = len(problem.edges.source)
    sampled = max(1, min(count, _MAX_SAMPLES // max(problem.grid.num_cells, 1)))
    chosen = torch.linspace(0, count - 1, sampled).round().long() if count else torch.empty(0, dtype=torch.int64)
    parts = [(squared.flatten(), weight.flatten()) for squared, weight in _squared(problem, state, chosen)]
    if not parts:
        return math.nan
    squared, weight = (torch.cat(part) for part in zip(*parts, strict=True))
    squared, order = squared.sort()
    below = weight[order].double().cumsum(0)
    if not below[-1] > 0:
        return math.nan
    return math.sqrt(float(squared[torch.searchsorted(below, below[-1:] / 2)])) / _RAYLEIGH_MEDIAN


def robust_scale_px(
    problem: Problem, state: State, kernel: RobustKernel, bounds_px: tuple[float, float] = (0.5, 20.0)
) -> float:
    """`Options.robust_scale_px` for a kernel from the residuals of a state.

    95 % efficient if the residuals were Gaussian but for outliers.

    Args:
        bounds_px: The least and the largest answer. Matching is hardly ever better than a few tenths of a pixel, and
            the scale of a state far from the truth says nothing of the noise.

    Returns:
        The lower bound where nothing is measured.
    """
    sigma = residual_sigma_px(problem, state)
    low, high = bounds_px
    return min(max(_EFFICIENT_RATIO[kernel] * sigma, low), high) if math.isfinite(sigma) else low


def largest_residual_px(problem: Problem, state: State, *, componentwise: bool = False) -> float:
    """The largest root of the robust kernel's argument s over all measurements; 0 without any."""
    everything = torch.arange(len(problem.edges.source))
    parts = [
        float(torch.where(weight > 0, squared, 0).max())
        for squared, weight in _squared(problem, state, everything, componentwise=componentwise)
    ]
    return math.sqrt(max(parts, default=0.0))


def _squared(
    problem: Problem, state: State, chosen: Tensor, *, componentwise: bool = False
) -> Iterator[tuple[Tensor, Tensor]]:
    """Squared residual s = r^T W r / wmax and wmax (0 where not projected), (n, P) each, of some edges in batches.

    Componentwise, s is the larger of the two.
    """
    edges, device = problem.edges, state.inverse_depth.device
    batch_size = max(_BATCH_CELLS // max(problem.grid.num_cells, 1), 1)
    for start in range(0, len(chosen), batch_size):
        here = chosen[start : start + batch_size].to(edges.source.device)
        batch = Edges(edges.source[here], edges.target[here], edges.target_px[here], edges.weight[here])
        px, projected = reproject(
            problem.camera_model,
            problem.grid,
            state,
            batch.source,
            batch.target,
            Options().min_depth_ratio,
            problem.rig,
        )
        weight = batch.weight.to(device).clamp_min(0)
        error = torch.where(weight > 0, px - batch.target_px.to(device), 0)
        largest = weight.amax(-1)
        squared = (weight * error * error).sum(-1) / torch.where(largest > 0, largest, 1)
        if componentwise:
            squared = error.square().amax(-1)
        yield squared, torch.where(projected, largest, 0)
