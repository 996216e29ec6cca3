"""Rotation matrices and quaternions (x, y, z, w), batched in torch."""

from __future__ import annotations

import torch
from torch import Tensor


def matrix_from_quaternion(quaternion: Tensor) -> Tensor:
    """Rotation matrices of quaternions of any length but zero.

    Args:
        quaternion: (..., 4) in the order x, y, z, w.

    Returns:
        (..., 3, 3) rotation matrices.
    """
    x, y, z, w = (quaternion / quaternion.norm(dim=-1, keepdim=True)).unbind(-1)
    return torch.stack(
        (
            torch.stack((1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)), dim=-1),
            torch.stack((2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)), dim=-1),
            torch.stack((2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)), dim=-1),
        ),
        dim=-2,
    )


def quaternion_from_matrix(rotation: Tensor) -> Tensor:
    """Unit quaternions of rotation matrices, accurate at every angle.

    The rows of 4 q q^T are all linear in the matrix; the one with the largest diagonal entry is free of cancellation.

    Args:
        rotation: (..., 3, 3) rotation matrices.

    Returns:
        (..., 4) in the order x, y, z, w, with w >= 0.
    """
    m00, m01, m02 = rotation[..., 0, :].unbind(-1)
    m10, m11, m12 = rotation[..., 1, :].unbind(-1)
    m20, m21, m22 = rotation[..., 2, :].unbind(-1)
    rows = torch.stack(
        (
            torch.stack((1 + m00 - m11 - m22, m01 + m10, m02 + m20, m21 - m12), dim=-1),
            torch.stack((m01 + m10, 1 - m00 + m11 - m22, m12 + m21, m02 - m20), dim=-1),
            torch.stack((m02 + m20, m12 + m21, 1 - m00 - m11 + m22, m10 - m01), dim=-1),
            torch.stack((m21 - m12, m02 - m20, m10 - m01, 1 + m00 + m11 + m22), dim=-1),
        ),
        dim=-2,
    )
    largest = rows.diagonal(dim1=-2, dim2=-1).argmax(dim=-1)
    quaternion = torch.take_along_dim(rows, largest[..., None, None], dim=-2).squeeze(-2)
    quaternion = quaternion / quaternion.norm(dim=-1, keepdim=True)
    return torch.where(quaternion[..., 3:] < 0, -quaternion, quaternion)
