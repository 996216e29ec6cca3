"""From sparse correspondences to a starting point for dense matching."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from vipe_core.ba.problem import Grid
from vipe_core.priors.protocols import Correspondences

# Correspondences that a cell's displacement is fitted to, and how far away the nearest of them may be.
_NEIGHBOURS = 10
_REACH_PX = 64.0
_FIT_WIDTH_PX = 12.0
# A correspondence this far from its neighbours' fit has half its say in the next one.
_OUTLIER_PX = 4.0


def displacement_guess(points: Correspondences, grid: Grid) -> NDArray[np.float32]:
    """(P, 2) where the cells are seen in the target, by a locally affine fit to correspondences near each; NaN far off.

    The fit leans towards a mere displacement where the correspondences about a cell are few or in a line.
    """
    cells = grid.sample_px().numpy().astype(np.float64)
    source = points.source_px.astype(np.float64)
    moved = points.target_px.astype(np.float64) - source
    # A list of ranks keeps the second axis even for a single correspondence.
    ranks = list(range(1, min(_NEIGHBOURS, len(source)) + 1))
    found = KDTree(source).query(cells, k=ranks)
    distance, nearest = np.asarray(found[0]), np.asarray(found[1])
    width = np.maximum(distance[:, [min(3, distance.shape[1] - 1)]], _FIT_WIDTH_PX)
    near = np.exp(-0.5 * np.square(distance / width))
    offset = source[nearest] - cells[:, None]
    design = np.concatenate([np.ones((*offset.shape[:2], 1)), offset], axis=-1)
    weight = near
    fit = np.zeros((len(cells), 3, 2))
    for _ in range(2):
        normal = np.einsum("nkd,nk,nke->nde", design, weight, design)
        normal[:, (1, 2), (1, 2)] += 2 * _FIT_WIDTH_PX**2 * weight.sum(axis=1, keepdims=True)
        fit = np.linalg.solve(normal, np.einsum("nkd,nk,nke->nde", design, weight, moved[nearest]))
        error = np.linalg.norm(design @ fit - moved[nearest], axis=-1)
        weight = near / (1 + np.square(error / _OUTLIER_PX))
    guess = cells + fit[:, 0]
    guess[distance[:, 0] > _REACH_PX] = np.nan
    return guess.astype(np.float32)
