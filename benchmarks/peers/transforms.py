"""Rigid transforms as matrices with the names of lietorch, for solvers of others where its extension is not built."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from vipe_core.geometry import se3


class Transforms:
    """What peers' solvers use of lietorch's SE3, as matrices (..., 4, 4) with `batch_dims` leading dimensions that
    rows share with them."""

    batch_dims = 1
    manifold_dim = 6

    def __init__(self, data: Tensor) -> None:
        self.data = data

    @property
    def shape(self) -> torch.Size:
        return self.data.shape[:-2]

    @property
    def device(self) -> torch.device:
        return self.data.device

    def inv(self) -> Transforms:
        return type(self)(se3.inverse(self.data))

    def view(self, shape: tuple[int, ...]) -> Transforms:
        return type(self)(self.data.reshape(*shape, 4, 4))

    def retr(self, twist: Tensor) -> Transforms:
        return type(self)(se3.exp(twist) @ self.data)

    def adjT(self, rows: Tensor) -> Tensor:  # noqa: N802 - its name
        return self._rows_times(rows, se3.adjoint(self.data))

    def __getitem__(self, index: Any) -> Transforms:
        return type(self)(self.data[index])

    def __mul__(self, other: Any) -> Any:
        if isinstance(other, Transforms):
            return type(self)(self.data @ other.data)
        return self._rows_times(other, self.data.mT)

    def _rows_times(self, rows: Tensor, matrices: Tensor) -> Tensor:
        """(batch, ..., k) rows times one (k, k) matrix per element of the batch."""
        size, batch = rows.shape[-1], rows.shape[: self.batch_dims]
        product = rows.reshape(*batch, -1, size) @ matrices.reshape(*batch, size, size)
        return product.view(rows.shape)


def scatter_sum(src: Tensor, index: Tensor, dim: int = -1, dim_size: int | None = None) -> Tensor:
    """torch_scatter's."""
    size = int(index.max()) + 1 if dim_size is None else dim_size
    shape = list(src.shape)
    shape[dim] = size
    return torch.zeros(shape, dtype=src.dtype, device=src.device).index_add_(dim, index, src)
