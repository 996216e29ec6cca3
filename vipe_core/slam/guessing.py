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
# Cells on a side of the blocks that share a fit.
_BLOCK_CELLS = 2


def displacement_guess(points: Correspondences, grid: Grid) -> NDArray[np.float32]:
    """(P, 2) where the cells are seen in the target, by a locally affine fit to correspondences near each; NaN far off.

    The fit leans towards a mere displacement where the correspondences about a cell are few or in a line.
    """
    rows, columns = (np.arange(0, length, _BLOCK_CELLS) for length in (grid.height, grid.width))
    centre = 0.5 * (_BLOCK_CELLS - 1)
    v, u = np.meshgrid(rows + centre, columns + centre, indexing="ij")
    blocks = np.stack([u.reshape(-1), v.reshape(-1)], axis=-1) * grid.stride + grid.offset
    source = points.source_px.astype(np.float64)
    moved = points.target_px.astype(np.float64) - source
    # A list of ranks keeps the second axis even for a single correspondence.
    ranks = list(range(1, min(_NEIGHBOURS, len(source)) + 1))
    found = KDTree(source).query(blocks, k=ranks)
    distance, nearest = np.asarray(found[0]), np.asarray(found[1])
    width = np.maximum(distance[:, [min(3, distance.shape[1] - 1)]], _FIT_WIDTH_PX)
    near = np.exp(-0.5 * np.square(distance / width))
    offset = source[nearest] - blocks[:, None]
    design = np.concatenate([np.ones((*offset.shape[:2], 1)), offset], axis=-1)
    wanted = moved[nearest]
    weight = near
    fit = np.zeros((len(blocks), 3, 2))
    for _ in range(2):
        weighted = (design * weight[..., None]).transpose(0, 2, 1)
        normal = weighted @ design
        normal[:, (1, 2), (1, 2)] += 2 * _FIT_WIDTH_PX**2 * weight.sum(axis=1, keepdims=True)
        fit = np.linalg.solve(normal, weighted @ wanted)
        error = design @ fit - wanted
        weight = near / (1 + (np.square(error[..., 0]) + np.square(error[..., 1])) / _OUTLIER_PX**2)
    fit[distance[:, 0] > _REACH_PX] = np.nan
    # The fit is affine: it says of each cell of its block where that goes.
    row, column = np.divmod(np.arange(grid.num_cells), grid.width)
    block = row // _BLOCK_CELLS * len(columns) + column // _BLOCK_CELLS
    cells = grid.sample_px().numpy().astype(np.float64)
    away = cells - blocks[block]
    of_cell = fit[block]
    guess = cells + of_cell[:, 0] + away[:, :1] * of_cell[:, 1] + away[:, 1:] * of_cell[:, 2]
    return np.asarray(guess, np.float32)
