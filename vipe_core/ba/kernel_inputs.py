"""What the compiled loops over cells are given (`kernels.py`): arrays by their names."""

from __future__ import annotations

from typing import Any, NamedTuple

from numpy.typing import NDArray

Array = NDArray[Any]


class Graph(NamedTuple):
    """Edges in order of (source, target): `edge` (E,) numbers the problem's, those of frame i are first[i]:first[i+1].

    target_px and weight are (E, 2 P) in the problem's order, (u, v) alternating; depth_free (N,) bool; num_cells (N,)
    at most P. Which rays and intrinsics are meant say table (N,), source_camera (N,) and, in order, target_camera (E,).
    """

    first: Array
    edge: Array
    target_px: Array
    weight: Array
    depth_free: Array
    num_cells: Array
    table: Array
    source_camera: Array
    target_camera: Array


class Pose(NamedTuple):
    """A state: transform (E, 12) rows of [R | t] in order, rays (T, 3, P), their derivatives (T, 2, 3, P).

    min_s (T, P), inverse_depth (N, P), camera (C, 5) with (fx, fy, cx, cy, alpha), all of one dtype.
    """

    transform: Array
    rays: Array
    rays_by_intrinsics: Array
    min_s: Array
    inverse_depth: Array
    camera: Array


class Robust(NamedTuple):
    """A kernel of `robust.CODE`, on the norm of a residual or on each component."""

    kernel: int
    componentwise: bool


class DepthPrior(NamedTuple):
    """Value and information, (N, P), or (0, P) without a prior.

    Where a frame's scale and shift of it are its own (`depth_prior.py`), value is with them; coupling (N, 2, P) is the
    derivative of the information times value by both, zero for the one that is held, else (0, 2, P).
    """

    value: Array
    weight: Array
    coupling: Array
