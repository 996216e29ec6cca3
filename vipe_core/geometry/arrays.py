"""The SE3 functions that numpy callers need, as float64 arrays in and out."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from vipe_core.geometry import quaternion, se3

Float64Array = NDArray[np.float64]


def _tensor(values: ArrayLike) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float64))


def exp(twist: ArrayLike) -> Float64Array:
    """`se3.exp`: (..., 6) -> (..., 4, 4)."""
    return np.asarray(se3.exp(_tensor(twist)).numpy())


def log(transform: ArrayLike) -> Float64Array:
    """`se3.log`: (..., 4, 4) -> (..., 6)."""
    return np.asarray(se3.log(_tensor(transform)).numpy())


def inverse(transform: ArrayLike) -> Float64Array:
    """`se3.inverse`: (..., 4, 4) -> (..., 4, 4)."""
    return np.asarray(se3.inverse(_tensor(transform)).numpy())


def relative(target_from_world: ArrayLike, source_from_world: ArrayLike) -> Float64Array:
    """`se3.relative`: (..., 4, 4), (..., 4, 4) -> (..., 4, 4) target_from_source."""
    return np.asarray(se3.relative(_tensor(target_from_world), _tensor(source_from_world)).numpy())


def interpolate_trajectory(
    times: ArrayLike, poses: ArrayLike, query_times: ArrayLike, *, extrapolate: bool = False
) -> Float64Array:
    """`se3.interpolate_trajectory`: (N,), (N, 4, 4), (Q,) -> (Q, 4, 4)."""
    result = se3.interpolate_trajectory(_tensor(times), _tensor(poses), _tensor(query_times), extrapolate=extrapolate)
    return np.asarray(result.numpy())


def matrix_from_quaternion(xyzw: ArrayLike) -> Float64Array:
    """`quaternion.matrix_from_quaternion`: (..., 4) -> (..., 3, 3)."""
    return np.asarray(quaternion.matrix_from_quaternion(_tensor(xyzw)).numpy())


def quaternion_from_matrix(rotation: ArrayLike) -> Float64Array:
    """`quaternion.quaternion_from_matrix`: (..., 3, 3) -> (..., 4), x, y, z, w with w >= 0."""
    return np.asarray(quaternion.quaternion_from_matrix(_tensor(rotation)).numpy())
