"""Cameras that only turn: rotations and focal length without any depth.

Where nothing shows parallax, the full adjustment is free to invent it. This fit has no positions to invent: a cell with
ray x of keyframe i is seen in j along R_j R_i^T x, whatever its depth. It also decides whether a clip is such a one.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from vipe_core.ba.problem import Grid
from vipe_core.cameras import CameraModel, projection
from vipe_core.geometry import se3
from vipe_core.priors.protocols import Match
from vipe_core.slam.adjustment import FocalPrior

Array = NDArray[Any]

_SUBSAMPLE = 3
_MIN_WEIGHT = 0.05
_SCALES = (16.0, 4.0, 1.0)
_ITERATIONS = 6
_ALIGN_ROUNDS = 5


@dataclass(frozen=True, slots=True)
class Link:
    """A measurement between two nodes, with the cells that count."""

    source: int
    target: int
    match: Match
    static: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class RotationFit:
    """The answer.

    Attributes:
        rotations: (M, 3, 3) float64 cam_from_world.
        intrinsics: (K,) index parameters.
        residual_px: Median residual of all measurements, pixels; NaN without any.
        log_focal_sigma: Formal 1-sigma of log f, NaN when it was held.
        inlier_ratio: (L,) share of the weight of each link within the robust scale.
    """

    rotations: NDArray[np.float64]
    intrinsics: NDArray[np.float64]
    residual_px: float
    log_focal_sigma: float
    inlier_ratio: NDArray[np.float64]


class RotationFitter:
    """Gauss-Newton on rotations (and log f) with an annealed Geman-McClure kernel."""

    def __init__(self, model: CameraModel, grid: Grid, robust_scale_px: float) -> None:
        rows = torch.arange(_SUBSAMPLE // 2, grid.height, _SUBSAMPLE)
        columns = torch.arange(_SUBSAMPLE // 2, grid.width, _SUBSAMPLE)
        self._cells = (rows[:, None] * grid.width + columns).reshape(-1)
        self._px = grid.sample_px()[self._cells]
        self._model = model
        self._scale_px = robust_scale_px

    def fit(
        self,
        rotations: Array,
        fixed: Sequence[int],
        links: Sequence[Link],
        intrinsics: Array,
        focal_prior: FocalPrior | None = None,
    ) -> RotationFit:
        """Fit the rotations of all nodes that are not `fixed`.

        Args:
            rotations: (M, 3, 3) start, cam_from_world.
            focal_prior: Frees the focal length under this prior; its sigma in the formal units of the measurements.
        """
        nodes = torch.from_numpy(np.array(rotations, dtype=np.float64))
        params = torch.from_numpy(np.array(intrinsics, dtype=np.float64))
        data = [self._measurements(link) for link in links]
        column = torch.full((len(nodes),), -1)
        free = [node for node in range(len(nodes)) if node not in set(fixed)]
        column[free] = 3 * torch.arange(len(free))
        size = 3 * len(free) + 1
        sigma = math.nan
        for scale in _SCALES:
            for _ in range(_ITERATIONS):
                hessian = torch.zeros(size, size, dtype=torch.float64)
                gradient = torch.zeros(size, dtype=torch.float64)
                for rows, _error, _weight, (i, j) in self._linearised(nodes, params, links, data, scale):
                    _accumulate(hessian, gradient, rows, int(column[i]), int(column[j]))
                if focal_prior is None:
                    hessian[-1], hessian[:, -1], gradient[-1] = 0, 0, 0
                    hessian[-1, -1] = 1
                else:
                    information = 1 / focal_prior.sigma**2
                    hessian[-1, -1] += information
                    gradient[-1] += information * (focal_prior.log_focal - float(params[0].log()))
                hessian.diagonal().add_(1e-9 * hessian.diagonal() + 1e-9)
                step = torch.linalg.solve(hessian, gradient)
                twist = torch.zeros(len(nodes), 6, dtype=torch.float64)
                twist[free, 3:] = step[:-1].reshape(-1, 3).clamp(-0.5, 0.5)
                nodes = se3.exp(twist)[:, :3, :3] @ nodes
                params[:2] *= step[-1].clamp(-0.2, 0.2).exp()
                if focal_prior is not None:
                    sigma = math.sqrt(max(float(torch.linalg.inv(hessian)[-1, -1]), 0.0))
                if float(step.abs().max()) < 1e-7:
                    break
        errors, inliers = [], []
        for _rows, error, weight, _ends in self._linearised(nodes, params, links, data, 1.0):
            used = weight > _MIN_WEIGHT
            errors.append(error[used])
            inside = float(weight[used & (error < self._scale_px)].sum())
            inliers.append(inside / max(float(weight[used].sum()), 1e-9))
        found = torch.cat(errors) if errors else torch.zeros(0)
        return RotationFit(
            rotations=nodes.numpy(),
            intrinsics=params.numpy(),
            residual_px=float(found.median()) if len(found) else math.nan,
            log_focal_sigma=sigma,
            inlier_ratio=np.array(inliers),
        )

    def chain(self, count: int, links: Sequence[Link], intrinsics: Array) -> NDArray[np.float64]:
        """(M, 3, 3) start: relative rotations by weighted alignment of rays, chained outwards from node 0."""
        params = torch.from_numpy(np.array(intrinsics, dtype=np.float64))
        nodes = np.tile(np.eye(3), (count, 1, 1))
        placed = {0}
        waiting = sorted(links, key=lambda link: (abs(link.source - link.target), link.source, link.target))
        while True:
            link = next((k for k in waiting if k.source in placed and k.target not in placed), None)
            if link is None:
                return nodes
            nodes[link.target] = self._aligned(link, params) @ nodes[link.source]
            placed.add(link.target)

    def _aligned(self, link: Link, params: Tensor) -> NDArray[np.float64]:
        """(3, 3) target_from_source that aligns the rays of a link best, reweighted against outliers."""
        target_px, weight = self._measurements(link)
        source = torch.nn.functional.normalize(projection.unproject(self._model, params, self._px), dim=-1)
        seen = torch.nn.functional.normalize(projection.unproject(self._model, params, target_px), dim=-1)
        confidence = weight.mean(-1)
        rotation = torch.eye(3, dtype=torch.float64)
        for _ in range(_ALIGN_ROUNDS):
            u, _, vh = torch.linalg.svd((seen * confidence[:, None]).T @ source)
            flip = torch.ones(3, dtype=torch.float64)
            flip[2] = torch.linalg.det(u @ vh).sign()
            rotation = u @ torch.diag(flip) @ vh
            angle = (seen - source @ rotation.T).norm(dim=-1)
            typical = angle[confidence > 0].median() if bool((confidence > 0).any()) else angle.new_tensor(1.0)
            confidence = weight.mean(-1) / (1 + (angle / (2 * typical + 1e-6)) ** 2) ** 2
        return rotation.numpy()

    def _measurements(self, link: Link) -> tuple[Tensor, Tensor]:
        cells = self._cells.numpy()
        target_px = torch.from_numpy(link.match.target_px[cells].astype(np.float64))
        weight = torch.from_numpy((link.match.weight[cells] * link.static[cells, None]).astype(np.float64))
        return target_px, weight

    def _linearised(
        self,
        nodes: Tensor,
        params: Tensor,
        links: Sequence[Link],
        data: Sequence[tuple[Tensor, Tensor]],
        scale: float,
    ) -> Iterator[tuple[Tensor, Tensor, Tensor, tuple[int, int]]]:
        """Per link: rows (2 P, 8) of [source twist, target twist, log f, -residual], scaled by the root of the weight;
        the residual norms (P,) px; the weights (P,); and the two nodes."""
        rays = projection.unproject(self._model, params, self._px)
        by_focal = projection.unproject_jacobian(self._model, params, self._px)[..., 0]
        for link, (target_px, weight) in zip(links, data, strict=True):
            relative = nodes[link.target] @ nodes[link.source].T
            points = rays @ relative.T
            px, valid = projection.project(self._model, params, points)
            by_point, by_intrinsics = projection.project_jacobian(self._model, params, points)
            residual = px - target_px
            error = residual.norm(dim=-1)
            kernel = 1 / (1 + (error / (scale * self._scale_px)) ** 2)
            root = (weight.sqrt() * kernel[:, None]) * valid[:, None]
            # d(exp(w) X) = w x X = -[X]x w for the target; the source turns the other way, seen through `relative`.
            by_target = -by_point @ se3.skew(points)
            focal = (by_point @ (by_focal @ relative.T)[..., None])[..., 0] + by_intrinsics[..., 0]
            rows = torch.cat((-by_target @ relative, by_target, focal[..., None], -residual[..., None]), dim=-1)
            rows = torch.where(root[..., None] > 0, rows * root[..., None], 0)
            usable = weight.mean(-1) * valid
            yield rows.reshape(-1, 8), error, usable, (link.source, link.target)


def _accumulate(hessian: Tensor, gradient: Tensor, rows: Tensor, source: int, target: int) -> None:
    """Add the normal equations of one link; a column of -1 is a fixed node."""
    product = rows.T @ rows
    blocks = [(start, at) for start, at in ((0, source), (3, target)) if at >= 0]
    spans = [(slice(start, start + 3), slice(at, at + 3)) for start, at in blocks]
    last = len(gradient) - 1
    spans.append((slice(6, 7), slice(last, last + 1)))
    for local_row, row in spans:
        gradient[row] += product[local_row, 7]
        for local_column, col in spans:
            hessian[row, col] += product[local_row, local_column]
