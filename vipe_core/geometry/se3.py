"""Rigid transforms as (..., 4, 4) matrices and twists as (..., 6), batched in torch.

A twist is (translation, rotation). A transform is perturbed from the left, T <- exp(twist) T, so its translation part
is in the target frame. Every function is smooth at zero angle, also under automatic differentiation.
"""

from __future__ import annotations

import torch
from torch import Tensor

from vipe_core.geometry.quaternion import quaternion_from_matrix

# Below this squared angle the closed forms cancel and the series below are exact to double precision.
_SMALL_ANGLE_SQUARED = 1e-4


def skew(vector: Tensor) -> Tensor:
    """(..., 3) -> (..., 3, 3) matrix of the cross product: skew(a) b = a x b."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    entries = torch.stack((zero, -z, y, z, zero, -x, -y, x, zero), dim=-1)
    return entries.reshape(*vector.shape, 3)


def compose(rotation: Tensor, translation: Tensor) -> Tensor:
    """(..., 4, 4) transforms of rotations (..., 3, 3) and translations (..., 3)."""
    upper = torch.cat((rotation, translation[..., None]), dim=-1)
    lower = torch.zeros_like(upper[..., :1, :])
    lower[..., 3] = 1
    return torch.cat((upper, lower), dim=-2)


def _coefficients(angle_squared: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """sin(a)/a, (1 - cos(a))/a^2 and (a - sin(a))/a^3 of a squared angle."""
    small = angle_squared < _SMALL_ANGLE_SQUARED
    safe = torch.where(small, torch.ones_like(angle_squared), angle_squared)
    angle = safe.sqrt()
    s = angle_squared
    sinc = torch.where(small, 1 - s / 6 * (1 - s / 20 * (1 - s / 42)), angle.sin() / angle)
    cosc = torch.where(small, 0.5 - s / 24 * (1 - s / 30 * (1 - s / 56)), (1 - angle.cos()) / safe)
    third = torch.where(small, 1 / 6 - s / 120 * (1 - s / 42 * (1 - s / 72)), (angle - angle.sin()) / (safe * angle))
    return sinc, cosc, third


def exp(twist: Tensor) -> Tensor:
    """(..., 6) twists (translation, rotation in radians) -> (..., 4, 4) transforms."""
    linear, angular = twist[..., :3], twist[..., 3:]
    sinc, cosc, third = (c[..., None, None] for c in _coefficients((angular * angular).sum(-1)))
    cross = skew(angular)
    cross_squared = cross @ cross
    identity = torch.eye(3, dtype=twist.dtype, device=twist.device)
    rotation = identity + sinc * cross + cosc * cross_squared
    left_jacobian = identity + cosc * cross + third * cross_squared
    return compose(rotation, (left_jacobian @ linear[..., None])[..., 0])


def log_rotation(rotation: Tensor) -> Tensor:
    """(..., 3, 3) rotations -> (..., 3) axis times angle, the angle in [0, pi]."""
    quaternion = quaternion_from_matrix(rotation)
    vector, scalar = quaternion[..., :3], quaternion[..., 3:]
    norm_squared = (vector * vector).sum(-1, keepdim=True)
    # The half angle is in [0, pi/2]; its ratio to its sine tends to one at zero.
    small = norm_squared < 1e-12
    norm = torch.where(small, torch.ones_like(norm_squared), norm_squared).sqrt()
    ratio = torch.where(small, 1 + norm_squared / 6, torch.atan2(norm, scalar) / norm)
    return 2 * ratio * vector


def log(transform: Tensor) -> Tensor:
    """(..., 4, 4) transforms -> (..., 6) twists (translation, rotation); inverse of `exp` for angles up to pi."""
    angular = log_rotation(transform[..., :3, :3])
    angle_squared = (angular * angular).sum(-1)
    sinc, cosc, _ = _coefficients(angle_squared)
    small = angle_squared < _SMALL_ANGLE_SQUARED
    safe = torch.where(small, torch.ones_like(angle_squared), angle_squared)
    series = 1 / 12 + angle_squared / 720 * (1 + angle_squared / 42)
    # sinc / (2 cosc) = (a/2) cot(a/2), finite up to 2 pi.
    factor = torch.where(small, series, (1 - sinc / (2 * cosc)) / safe)[..., None, None]
    cross = skew(angular)
    identity = torch.eye(3, dtype=transform.dtype, device=transform.device)
    inverse_left_jacobian = identity - cross / 2 + factor * (cross @ cross)
    linear = (inverse_left_jacobian @ transform[..., :3, 3:])[..., 0]
    return torch.cat((linear, angular), dim=-1)


def inverse(transform: Tensor) -> Tensor:
    """Inverse of rigid transforms (..., 4, 4), without a linear solve."""
    rotation = transform[..., :3, :3].mT
    return compose(rotation, -(rotation @ transform[..., :3, 3:])[..., 0])


def relative(target_from_world: Tensor, source_from_world: Tensor) -> Tensor:
    """target_from_source of two transforms out of the same frame, (..., 4, 4)."""
    return target_from_world @ inverse(source_from_world)


def adjoint(transform: Tensor) -> Tensor:
    """(..., 6, 6) matrix with T exp(x) T^-1 = exp(adjoint(T) x)."""
    rotation = transform[..., :3, :3]
    coupling = skew(transform[..., :3, 3]) @ rotation
    upper = torch.cat((rotation, coupling), dim=-1)
    lower = torch.cat((torch.zeros_like(rotation), rotation), dim=-1)
    return torch.cat((upper, lower), dim=-2)


def interpolate(start: Tensor, end: Tensor, fraction: Tensor) -> Tensor:
    """The pose a `fraction` of the way along the constant twist from `start` to `end`.

    Args:
        start: (..., 4, 4) x_from_y.
        end: (..., 4, 4) x_from_y.
        fraction: (...) 0 gives `start`, 1 gives `end`; beyond is constant velocity.

    Returns:
        (..., 4, 4). The path is the same whether x or y is the moving frame.
    """
    return exp(fraction[..., None] * log(relative(end, start))) @ start


def interpolate_trajectory(times: Tensor, poses: Tensor, query_times: Tensor, *, extrapolate: bool = False) -> Tensor:
    """Poses at other times, along constant twists between neighbouring knots.

    Args:
        times: (N,) strictly increasing.
        poses: (N, 4, 4) knots.
        query_times: (Q,) any order.
        extrapolate: Outside of the knots go on at the velocity of the nearest two, instead of staying at the last one.

    Returns:
        (Q, 4, 4).
    """
    if len(times) == 1:
        return poses.expand(len(query_times), 4, 4).clone()
    right = torch.searchsorted(times, query_times).clamp(1, len(times) - 1)
    left = right - 1
    fraction = (query_times - times[left]) / (times[right] - times[left])
    if not extrapolate:
        fraction = fraction.clamp(0, 1)
    return interpolate(poses[left], poses[right], fraction.to(poses.dtype))
