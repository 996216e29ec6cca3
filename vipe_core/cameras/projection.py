"""Rays and pixels of every camera model, with the derivatives that bundle adjustment needs (torch, any dtype, batched).

Parameters are `Camera.index_params` (integer pixel indices): `pinhole` (fx, fy, cx, cy), `mei` (fx, fy, cx, cy, alpha),
`equirect` (width, height). Where they are (K,), a parameter may also be a tensor that broadcasts with what is asked.

Unified model (Mei & Rives 2007; k or xi elsewhere, alpha here). A point X projects through

    s = z + alpha |X|,      u = fx x / s + cx,      v = fy y / s + cy

and a pixel with normalised coordinates m = ((u - cx) / fx, (v - cy) / fy), r^2 = |m|^2 has the unit ray

    g = sqrt(1 + (1 - alpha^2) r^2),      eta = (alpha + g) / (1 + r^2),      ray = (eta m, eta - alpha)

alpha = 0 is the pinhole camera, except that a pinhole ray is not normalised but has z = 1. The image of a point is
defined where s > 0, and for alpha > 1 only on the near side of the sphere, z > -|X| / alpha.

Intrinsics are differentiated with respect to log f (fx and fy grow by the same factor) and, for `mei`, alpha.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from vipe_core.cameras.camera import CameraModel
from vipe_core.errors import ConfigError

# The squared root g of the unified model at which a pixel of a camera with alpha > 1 is taken to be off its image disk.
_MIN_DISK = 1e-6
# Directions this close to the plane (or cone) that has no image are not imaged: keeps pixels finite.
_MIN_SLOPE = 1e-9


def _require_derivable(model: CameraModel) -> None:
    """Raises:
    ConfigError: A lens with measured distortion, which only `Camera` projects with.
    """
    if model in ("opencv", "opencv_fisheye"):
        raise ConfigError(f"pictures of a camera {model!r} must be resampled before they are adjusted")


def _normalised(params: Tensor, px: Tensor) -> tuple[Tensor, Tensor]:
    u, v = px.unbind(-1)
    return (u - params[2]) / params[0], (v - params[3]) / params[1]


def unproject(model: CameraModel, params: Tensor, px: Tensor) -> Tensor:
    """Rays through pixels.

    Args:
        model: Camera model.
        params: (K,) parameters, see the module.
        px: (..., 2) index coordinates (u, v).

    Returns:
        (..., 3) rays in the camera frame: z = 1 for `pinhole`, unit length otherwise.
    """
    _require_derivable(model)
    if model == "equirect":
        u, v = px.unbind(-1)
        theta = ((u + 0.5) / params[0] - 0.5) * (2 * math.pi)
        phi = (v + 0.5) / params[1] * math.pi
        return torch.stack((phi.sin() * theta.sin(), -phi.cos(), phi.sin() * theta.cos()), dim=-1)
    mx, my = _normalised(params, px)
    if model == "pinhole":
        return torch.stack((mx, my, torch.ones_like(mx)), dim=-1)
    alpha = params[4]
    r2 = mx * mx + my * my
    eta = (alpha + (1 + (1 - alpha * alpha) * r2).clamp_min(_MIN_DISK).sqrt()) / (1 + r2)
    return torch.stack((eta * mx, eta * my, eta - alpha), dim=-1)


def on_image_disk(model: CameraModel, params: Tensor, px: Tensor) -> Tensor:
    """(...) bool: whether a ray exists. Only a unified camera with alpha > 1 has pixels that see nothing."""
    if model != "mei":
        return torch.ones_like(px[..., 0], dtype=torch.bool)
    mx, my = _normalised(params, px)
    return 1 + (1 - params[4] ** 2) * (mx * mx + my * my) > _MIN_DISK


def unproject_jacobian(model: CameraModel, params: Tensor, px: Tensor) -> Tensor:
    """(..., 3, n) derivative of `unproject` with respect to the n free intrinsics: log f, and alpha for `mei`."""
    if model == "equirect":
        return px.new_zeros(*px.shape[:-1], 3, 0)
    mx, my = _normalised(params, px)
    if model == "pinhole":
        return torch.stack((-mx, -my, torch.zeros_like(mx)), dim=-1)[..., None]
    alpha = params[4]
    r2 = mx * mx + my * my
    g = (1 + (1 - alpha * alpha) * r2).clamp_min(_MIN_DISK).sqrt()
    eta = (alpha + g) / (1 + r2)
    eta_logf = (2 * r2 * eta - (1 - alpha * alpha) * r2 / g) / (1 + r2)
    eta_alpha = (1 - alpha * r2 / g) / (1 + r2)
    by_logf = torch.stack(((eta_logf - eta) * mx, (eta_logf - eta) * my, eta_logf), dim=-1)
    by_alpha = torch.stack((eta_alpha * mx, eta_alpha * my, eta_alpha - 1), dim=-1)
    return torch.stack((by_logf, by_alpha), dim=-1)


def depth_factor(model: CameraModel, params: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    """s = z + alpha |X| of points, and whether the model images them.

    Args:
        model: `pinhole` or `mei`.
        params: (K,) parameters.
        points: (..., 3) in the camera frame, any scale.

    Returns:
        s (...), and bool (...).
    """
    z = points[..., 2]
    least = _MIN_SLOPE * points.abs().amax(dim=-1)
    if model == "pinhole":
        return z, z > least
    alpha = params[4]
    norm = points.norm(dim=-1)
    s = z + alpha * norm
    return s, (s > least) & ((alpha <= 1) | (alpha * z > -norm))


def project(model: CameraModel, params: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels of points.

    Args:
        model: Camera model.
        params: (K,) parameters, see the module.
        points: (..., 3) in the camera frame; only the direction counts.

    Returns:
        px (..., 2) index coordinates, finite everywhere, and valid (...) bool: the model images this direction. Pixels
        outside of the image are valid.
    """
    _require_derivable(model)
    x, y, z = points.unbind(-1)
    if model == "equirect":
        norm = points.norm(dim=-1)
        valid = norm > 0
        theta = torch.atan2(x, torch.where(valid, z, torch.ones_like(z)))
        phi = torch.atan2((x * x + z * z).sqrt(), torch.where(valid, -y, torch.ones_like(y)))
        u = (theta / (2 * math.pi) + 0.5) * params[0] - 0.5
        v = phi / math.pi * params[1] - 0.5
        return torch.stack((u, v), dim=-1), valid
    s, valid = depth_factor(model, params, points)
    s = torch.where(valid, s, torch.ones_like(s))
    return torch.stack((params[0] * x / s + params[2], params[1] * y / s + params[3]), dim=-1), valid


def project_jacobian(model: CameraModel, params: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    """Derivatives of `project`, meaningful where it is valid.

    Args:
        model: `pinhole` or `mei`.
        params: (K,) parameters.
        points: (..., 3).

    Returns:
        by_point (..., 2, 3), and by_intrinsics (..., 2, n) with respect to (log f, alpha).
    """
    s, valid = depth_factor(model, params, points)
    s = torch.where(valid, s, torch.ones_like(s))
    xy = points[..., :2] / s[..., None]
    slope = torch.zeros_like(points)
    slope[..., 2] = 1
    centred = xy * params[:2]
    intrinsics = [centred]
    if model == "mei":
        norm = points.norm(dim=-1, keepdim=True)
        slope = slope + params[4] * points / norm
        intrinsics.append(-centred * norm / s[..., None])
    identity = torch.eye(2, 3, dtype=points.dtype, device=points.device)
    by_point = (params[:2] / s[..., None])[..., None] * (identity - xy[..., None] * slope[..., None, :])
    return by_point, torch.stack(intrinsics, dim=-1)
