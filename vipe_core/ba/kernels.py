"""Compiled loops over the cells of the edges: cost, normal equations, and the step of every inverse depth.

The algebra is that of `torch_solver.py`; what differs is the order of the work. A source frame is taken in tiles of
`TILE` cells, every edge of it one after the other, so that all intermediate rows stay in the first two cache levels and
nothing per edge and cell is ever stored: the step of the depths sees the measurements again instead.

Pinhole is the unified model with alpha = 0. Pixel arithmetic is in the dtype of the inverse depths, sums are in it
within a tile and in float64 across tiles. Frames are independent, so any split over threads gives the same bytes.

Everything is planar: a row of a tile is `TILE` consecutive numbers of a flat buffer, since loops over rows at constant
distances are the ones that compile to vector code.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from vipe_core.ba.kernel_inputs import Array, DepthPrior, Graph, Pose, Robust
from vipe_core.compilation import vectorised

TILE = 256
# Rows of an edge: 6 of its twist, log f, alpha, negative residual; where its two cameras have intrinsics of their own,
# these are the source's, and log f, alpha of the target's and a row of zeros follow.
ROWS, ROWS_APART = 9, 12
# Rows of a frame after those of its edges: log f, alpha and one more of each camera, the first one's is the residual's.
TAIL = 3

# Rows of the view buffer: homogeneous point, 1 / s, projection before focal length and centre, |X|, weighted residual,
# roots of the weights, argument of the robust kernel, larger weight; componentwise, the kernel's arguments by component
# and the weights. Zero weights where the point is not imaged.
_X, _Y, _Z, _INV, _PX, _PY, _NORM, _EU, _EV, _SU, _SV, _SQ, _WM, _QU, _QV, _WU, _WV = (k * TILE for k in range(17))
_VIEW_SIZE = 17 * TILE
# Least positive number that is not denormal in single precision.
_TINY = 1.2e-38
# Rows of the Jacobian buffer: ROWS_APART pairs (u, v), then the derivative by inverse depth, then J_X.
_RHS = 16 * TILE
_OF_TARGET = 18 * TILE
_BY_DEPTH = 24 * TILE
_BY_POINT = 26 * TILE
_JACOBIAN_SIZE = 32 * TILE


@vectorised
def _see(graph: Graph, pose: Pose, frame: int, order: int, start: int, n: int, view: Array) -> Any:
    """Fill the view of an edge's tile; returns the sum of the larger weights, imaged or not."""
    row, edge = pose.transform[order], graph.edge[order]
    target, weight = graph.target_px[edge][2 * start : 2 * (start + n)], graph.weight[edge][2 * start : 2 * (start + n)]
    rays, camera = pose.rays[graph.table[frame]], pose.camera[graph.target_camera[order]]
    rx, ry, rz = rays[0][start:], rays[1][start:], rays[2][start:]
    depth, least = pose.inverse_depth[frame][start:], pose.min_s[graph.table[frame]][start:]
    fx, fy, cx, cy, alpha = camera[0], camera[1], camera[2], camera[3], camera[4]
    r00, r01, r02, t0 = row[0], row[1], row[2], row[3]
    r10, r11, r12, t1 = row[4], row[5], row[6], row[7]
    r20, r21, r22, t2 = row[8], row[9], row[10], row[11]
    zero, one, tiny = view.dtype.type(0), view.dtype.type(1), view.dtype.type(1e-37)
    total = zero
    for p in range(n):
        a, b, c, d = rx[p], ry[p], rz[p], depth[p]
        x = r00 * a + r01 * b + r02 * c + t0 * d
        y = r10 * a + r11 * b + r12 * c + t1 * d
        z = r20 * a + r21 * b + r22 * c + t2 * d
        norm = math.sqrt(x * x + y * y + z * z)
        s = z + alpha * norm
        imaged = (s > least[p]) & (alpha * z + norm > zero)
        wu, wv, tu, tv = weight[2 * p], weight[2 * p + 1], target[2 * p], target[2 * p + 1]
        wu = zero if wu < zero else wu
        wv = zero if wv < zero else wv
        inverse = one / (s if imaged else one)
        px, py = x * inverse, y * inverse
        eu, ev = fx * px + cx - tu, fy * py + cy - tv
        # A component without weight has no say, whatever it holds.
        eu = eu if wu > zero else zero
        ev = ev if wv > zero else zero
        wm = wu if wu > wv else wv
        total += wm
        wu = wu if imaged else zero
        wv = wv if imaged else zero
        wm = wm if imaged else zero
        su, sv = math.sqrt(wu), math.sqrt(wv)
        eu, ev = eu * su, ev * sv
        view[_X + p], view[_Y + p], view[_Z + p], view[_INV + p] = x, y, z, inverse
        view[_PX + p], view[_PY + p], view[_NORM + p] = px, py, norm if imaged else one
        view[_EU + p], view[_EV + p], view[_SU + p], view[_SV + p] = eu, ev, su, sv
        view[_SQ + p] = (eu * eu + ev * ev) / (wm if wm > tiny else tiny)
        view[_WM + p] = wm
    return total


@vectorised
def _rho_sum(kernel: int, scale: Array, squared: Array, weight: Array, n: int) -> Any:
    """Sum of weight rho(squared) over a tile."""
    c2 = scale[0]
    zero, one, two = weight.dtype.type(0), weight.dtype.type(1), weight.dtype.type(2)
    total = zero
    if kernel == 0:
        for p in range(n):
            total += weight[p] * squared[p]
    elif kernel == 1:
        c = math.sqrt(c2)
        for p in range(n):
            s = squared[p]
            total += weight[p] * (two * c * math.sqrt(s) - c2 if s > c2 else s)
    elif kernel == 2:
        for p in range(n):
            total += weight[p] * c2 * math.log1p(squared[p] / c2)
    elif kernel == 3:
        for p in range(n):
            total += weight[p] * (squared[p] * c2 / (c2 + squared[p]))
    elif kernel == 4:
        third = c2 / weight.dtype.type(3)
        for p in range(n):
            s = squared[p]
            inside = one - s / c2 if s < c2 else s - s
            total += weight[p] * third * (one - inside * inside * inside)
    else:
        c, final2 = math.sqrt(c2), scale[1]
        wide, least = max(c2 - final2, weight.dtype.type(_TINY)), final2 / c2
        for p in range(n):
            s = squared[p]
            root = math.sqrt(s)
            share = (root * (two * c - root) - final2) / wide
            share = min(max(share, least), one) if root < c else one + (root - root)
            total += weight[p] * (s if s * c2 <= final2 * final2 else final2 * share)
    return total


@vectorised
def _by_component(view: Array, n: int) -> None:
    tiny = view.dtype.type(1e-37)
    for p in range(n):
        wu, wv = view[_SU + p] * view[_SU + p], view[_SV + p] * view[_SV + p]
        view[_QU + p] = view[_EU + p] * view[_EU + p] / (wu if wu > tiny else tiny)
        view[_QV + p] = view[_EV + p] * view[_EV + p] / (wv if wv > tiny else tiny)
        view[_WU + p], view[_WV + p] = wu, wv


@vectorised
def _cost_sum(robust: Robust, scale: Array, view: Array, n: int) -> tuple[float, float]:
    """Sums of the robust cost and of wmax over a tile."""
    kept = view.dtype.type(0)
    for p in range(n):
        kept += view[_WM + p]
    if not robust.componentwise:
        return _rho_sum(robust.kernel, scale, view[_SQ : _SQ + TILE], view[_WM : _WM + TILE], n), kept
    _by_component(view, n)
    of_u = _rho_sum(robust.kernel, scale, view[_QU : _QU + TILE], view[_WU : _WU + TILE], n)
    return of_u + _rho_sum(robust.kernel, scale, view[_QV : _QV + TILE], view[_WV : _WV + TILE], n), kept


@vectorised
def _root_slope(kernel: int, scale: Array, squared: Array, n: int) -> None:
    """sqrt(rho'(s)) in place of s."""
    zero, one, c2 = squared.dtype.type(0), squared.dtype.type(1), scale[0]
    if kernel == 1:
        for p in range(n):
            s = squared[p]
            squared[p] = math.sqrt(math.sqrt(c2 / (s if s > c2 else c2)))
    elif kernel == 2:
        for p in range(n):
            squared[p] = one / math.sqrt(one + squared[p] / c2)
    elif kernel == 3:
        for p in range(n):
            squared[p] = c2 / (c2 + squared[p])
    elif kernel == 4:
        for p in range(n):
            inside = one - squared[p] / c2
            squared[p] = zero if inside < zero else inside
    else:
        c, final2 = math.sqrt(c2), scale[1]
        wide = max(c2 - final2, squared.dtype.type(_TINY))
        most = wide / c
        for p in range(n):
            s = squared[p]
            root = math.sqrt(s)
            gap = min(max(c - root, zero), most)
            squared[p] = one if s * c2 <= final2 * final2 else math.sqrt(final2 * (gap / wide) / root)


@vectorised
def _reweigh(robust: Robust, scale: Array, view: Array, n: int) -> None:
    """Scale residuals and roots of weights by sqrt(rho'(s))."""
    if robust.kernel == 0:
        return
    if robust.componentwise:
        _by_component(view, n)
        _root_slope(robust.kernel, scale, view[_QU : _QU + TILE], n)
        _root_slope(robust.kernel, scale, view[_QV : _QV + TILE], n)
        for p in range(n):
            view[_EU + p] *= view[_QU + p]
            view[_SU + p] *= view[_QU + p]
            view[_EV + p] *= view[_QV + p]
            view[_SV + p] *= view[_QV + p]
        return
    _root_slope(robust.kernel, scale, view[_SQ : _SQ + TILE], n)
    for p in range(n):
        root = view[_SQ + p]
        view[_EU + p] *= root
        view[_EV + p] *= root
        view[_SU + p] *= root
        view[_SV + p] *= root


@vectorised
def _differentiate(
    graph: Graph, pose: Pose, frame: int, order: int, start: int, n: int, free: Array, view: Array, jacobian: Array
) -> None:
    """Scaled rows of a reweighed tile, with zeros after its last cell."""
    row, camera = pose.transform[order], pose.camera[graph.target_camera[order]]
    depth = pose.inverse_depth[frame][start:]
    fx, fy, alpha = camera[0], camera[1], camera[4]
    t0, t1, t2 = row[3], row[7], row[11]
    one = view.dtype.type(1)
    for p in range(n):
        gu, gv = view[_SU + p] * fx * view[_INV + p], view[_SV + p] * fy * view[_INV + p]
        x, y, z, px, py, d = view[_X + p], view[_Y + p], view[_Z + p], view[_PX + p], view[_PY + p], depth[p]
        bend = alpha / view[_NORM + p]
        hx, hy, hz = bend * x, bend * y, one + bend * z
        au, av = gu * px, gv * py
        u0, u1, u2 = gu - au * hx, -au * hy, -au * hz
        v0, v1, v2 = -av * hx, gv - av * hy, -av * hz
        jacobian[p], jacobian[TILE + p] = d * u0, d * v0
        jacobian[2 * TILE + p], jacobian[3 * TILE + p] = d * u1, d * v1
        jacobian[4 * TILE + p], jacobian[5 * TILE + p] = d * u2, d * v2
        jacobian[6 * TILE + p], jacobian[7 * TILE + p] = y * u2 - z * u1, y * v2 - z * v1
        jacobian[8 * TILE + p], jacobian[9 * TILE + p] = z * u0 - x * u2, z * v0 - x * v2
        jacobian[10 * TILE + p], jacobian[11 * TILE + p] = x * u1 - y * u0, x * v1 - y * v0
        jacobian[_RHS + p], jacobian[_RHS + TILE + p] = -view[_EU + p], -view[_EV + p]
        jacobian[_BY_DEPTH + p] = t0 * u0 + t1 * u1 + t2 * u2
        jacobian[_BY_DEPTH + TILE + p] = t0 * v0 + t1 * v1 + t2 * v2
        jacobian[_BY_POINT + p], jacobian[_BY_POINT + TILE + p] = u0, v0
        jacobian[_BY_POINT + 2 * TILE + p], jacobian[_BY_POINT + 3 * TILE + p] = u1, v1
        jacobian[_BY_POINT + 4 * TILE + p], jacobian[_BY_POINT + 5 * TILE + p] = u2, v2
    for k in range(2):
        if free[k]:
            rays = pose.rays_by_intrinsics[graph.table[frame], k]
            _intrinsic_rows(rays, camera, row, k, start, n, free[2], view, jacobian)
    if n < TILE:
        for r in range(26):
            for p in range(n, TILE):
                jacobian[r * TILE + p] = view.dtype.type(0)


@vectorised
def _intrinsic_rows(
    rays: Array, camera: Array, row: Array, k: int, start: int, n: int, apart: bool, view: Array, jacobian: Array
) -> None:
    """The row of log f (k = 0) or alpha (k = 1): J_X R d ray / dk + d project / dk, with `rays` (3, P) d ray / dk.

    Where cameras are apart, the first is in the row of the source's camera and the second in that of the target's.
    Both camera derivatives are multiples of f px: by 1 for log f, by -|X| / s for alpha.
    """
    rx, ry, rz = rays[0][start:], rays[1][start:], rays[2][start:]
    fx, fy = camera[0], camera[1]
    r00, r01, r02, r10, r11, r12 = row[0], row[1], row[2], row[4], row[5], row[6]
    r20, r21, r22 = row[8], row[9], row[10]
    by_point = jacobian[_BY_POINT : _BY_POINT + 6 * TILE]
    out = jacobian[(12 + 2 * k) * TILE : (14 + 2 * k) * TILE]
    # Written out twice: a compiler contracts sums of products in one piece otherwise, and results keep their bits.
    if not apart:
        for p in range(n):
            a, b, c = rx[p], ry[p], rz[p]
            x, y, z = r00 * a + r01 * b + r02 * c, r10 * a + r11 * b + r12 * c, r20 * a + r21 * b + r22 * c
            share = -view[_NORM + p] * view[_INV + p] if k == 1 else view.dtype.type(1)
            u = x * by_point[p] + y * by_point[2 * TILE + p] + z * by_point[4 * TILE + p]
            v = x * by_point[TILE + p] + y * by_point[3 * TILE + p] + z * by_point[5 * TILE + p]
            out[p] = u + share * (view[_SU + p] * fx * view[_PX + p])
            out[TILE + p] = v + share * (view[_SV + p] * fy * view[_PY + p])
        return
    for p in range(n):
        a, b, c = rx[p], ry[p], rz[p]
        x, y, z = r00 * a + r01 * b + r02 * c, r10 * a + r11 * b + r12 * c, r20 * a + r21 * b + r22 * c
        out[p] = x * by_point[p] + y * by_point[2 * TILE + p] + z * by_point[4 * TILE + p]
        out[TILE + p] = x * by_point[TILE + p] + y * by_point[3 * TILE + p] + z * by_point[5 * TILE + p]
    out = jacobian[_OF_TARGET + 2 * k * TILE : _OF_TARGET + (2 * k + 2) * TILE]
    for p in range(n):
        share = -view[_NORM + p] * view[_INV + p] if k == 1 else view.dtype.type(1)
        out[p] = share * (view[_SU + p] * fx * view[_PX + p])
        out[TILE + p] = share * (view[_SV + p] * fy * view[_PY + p])


@vectorised
def _gram(rows: Array, triples: int, length: int, total: Array, offset: int) -> None:
    """Add rows rows^T to the lower 3x3 blocks of a matrix, for 3 `triples` rows of `length` in a flat buffer.

    The matrix is `total` from `offset` on, row by row.
    """
    zero, width = rows.dtype.type(0), 3 * triples
    for i in range(triples):
        base = 3 * i * length
        a0, a1 = rows[base : base + length], rows[base + length : base + 2 * length]
        a2 = rows[base + 2 * length : base + 3 * length]
        for j in range(i + 1):
            other = 3 * j * length
            b0, b1 = rows[other : other + length], rows[other + length : other + 2 * length]
            b2 = rows[other + 2 * length : other + 3 * length]
            s00, s01, s02, s10, s11, s12, s20, s21, s22 = zero, zero, zero, zero, zero, zero, zero, zero, zero
            for p in range(length):
                x0, x1, x2, y0, y1, y2 = a0[p], a1[p], a2[p], b0[p], b1[p], b2[p]
                s00 += x0 * y0
                s01 += x0 * y1
                s02 += x0 * y2
                s10 += x1 * y0
                s11 += x1 * y1
                s12 += x1 * y2
                s20 += x2 * y0
                s21 += x2 * y1
                s22 += x2 * y2
            at = offset + 3 * i * width + 3 * j
            total[at] += s00
            total[at + 1] += s01
            total[at + 2] += s02
            total[at + width] += s10
            total[at + width + 1] += s11
            total[at + width + 2] += s12
            total[at + 2 * width] += s20
            total[at + 2 * width + 1] += s21
            total[at + 2 * width + 2] += s22


@vectorised
def _couple(
    jacobian: Array, free: Array, degree: int, slot: int, cameras: tuple[int, int], coupling: Array, curvature: Array
) -> None:
    """Rows of the elimination: products of an edge's rows with its derivative by inverse depth.

    Args:
        cameras: Of its source and its target.
    """
    du, dv = jacobian[_BY_DEPTH : _BY_DEPTH + TILE], jacobian[_BY_DEPTH + TILE : _BY_DEPTH + 2 * TILE]
    for r in range(6):
        u, v = jacobian[2 * r * TILE : (2 * r + 1) * TILE], jacobian[(2 * r + 1) * TILE : (2 * r + 2) * TILE]
        out = coupling[(6 * slot + r) * TILE : (6 * slot + r + 1) * TILE]
        for p in range(TILE):
            out[p] = u[p] * du[p] + v[p] * dv[p]
    for r in range(TAIL):
        if r == 2 or free[r]:
            u = jacobian[(12 + 2 * r) * TILE : (13 + 2 * r) * TILE]
            v = jacobian[(13 + 2 * r) * TILE : (14 + 2 * r) * TILE]
            at = 6 * degree + r + (TAIL * cameras[0] if free[2] and r < 2 else 0)
            out = coupling[at * TILE : (at + 1) * TILE]
            for p in range(TILE):
                out[p] += u[p] * du[p] + v[p] * dv[p]
    if free[2]:
        for r in range(2):
            if free[r]:
                u = jacobian[_OF_TARGET + 2 * r * TILE : _OF_TARGET + (2 * r + 1) * TILE]
                v = jacobian[_OF_TARGET + (2 * r + 1) * TILE : _OF_TARGET + (2 * r + 2) * TILE]
                at = 6 * degree + TAIL * cameras[1] + r
                out = coupling[at * TILE : (at + 1) * TILE]
                for p in range(TILE):
                    out[p] += u[p] * du[p] + v[p] * dv[p]
    for p in range(TILE):
        curvature[p] += du[p] * du[p] + dv[p] * dv[p]


@vectorised
def _prior_pull(prior: DepthPrior, depth: Array, frame: int, start: int, n: int, pull: Array, weight: Array) -> Any:
    """Information and information times (prior - state) of a tile; returns the cost."""
    zero = pull.dtype.type(0)
    total = zero
    for p in range(TILE):
        pull[p] = zero
        weight[p] = zero
    if len(prior.weight):
        value, information, current = prior.value[frame][start:], prior.weight[frame][start:], depth[frame][start:]
        for p in range(n):
            off = value[p] - current[p]
            off = off if information[p] > zero else zero
            weight[p] = information[p]
            pull[p] = information[p] * off
            total += information[p] * off * off
    return total


@vectorised
def evaluate(
    graph: Graph, pose: Pose, prior: DepthPrior, robust: Robust, scale: Array, begin: int, end: int, sums: Array
) -> None:
    """Robust cost of the frames begin:end.

    Args:
        scale: (2,) squares of the kernel's scale and of the one it ends at, px^2.
        sums: (N, 4) float64 zeros, filled with wmax rho(s), wmax of what is imaged, all wmax, and the prior's cost.
    """
    view, pull, weight = (
        np.empty(_VIEW_SIZE, pose.rays.dtype),
        np.empty(TILE, pose.rays.dtype),
        np.empty(TILE, pose.rays.dtype),
    )
    for frame in range(begin, end):
        cells = graph.num_cells[frame]
        for start in range(0, cells, TILE):
            n = min(TILE, cells - start)
            for order in range(graph.first[frame], graph.first[frame + 1]):
                sums[frame, 2] += _see(graph, pose, frame, order, start, n, view)
                cost, kept = _cost_sum(robust, scale, view, n)
                sums[frame, 0] += cost
                sums[frame, 1] += kept
            if graph.depth_free[frame]:
                sums[frame, 3] += _prior_pull(prior, pose.inverse_depth, frame, start, n, pull, weight)


@vectorised
def linearise(
    graph: Graph,
    pose: Pose,
    prior: DepthPrior,
    robust: Robust,
    scale: Array,
    free: Array,
    cameras: int,
    begin: int,
    end: int,
    sums: Array,
    direct: Array,
    offset: Array,
    eliminated: Array,
) -> None:
    """Cost and normal equations, in the twists of the edges, of the frames begin:end.

    Args:
        free: (3,) bool, whether log f and alpha move, and whether several cameras have them each for itself.
        cameras: How many do.
        sums: As in `evaluate`.
        direct: Float64 zeros, filled with the J^T J of every edge in order, 9x9 or of several cameras 12x12; only the
            lower 3x3 blocks.
        offset: (N + 1,) where the frames begin in `eliminated`.
        eliminated: Flat float64 zeros: per frame with D edges and free depths, (6 D + 3 cameras)^2 numbers that
            eliminating the undamped depths subtracts; rows are the twists of the edges, then log f and alpha of every
            camera and one more, which is the right-hand side of the first camera and zero of others. Where scale and
            shift of the prior are a frame's own, they and one more row of zeros follow.
    """
    dtype = pose.rays.dtype
    most = 0
    for frame in range(begin, end):
        most = max(most, graph.first[frame + 1] - graph.first[frame])
    view, jacobian = np.zeros(_VIEW_SIZE, dtype), np.zeros(_JACOBIAN_SIZE, dtype)
    own = TAIL if len(prior.coupling) else 0
    tail, rows = TAIL * cameras + own, ROWS_APART if free[2] else ROWS
    coupling = np.zeros((6 * most + tail) * TILE, dtype)
    curvature, pull = np.zeros(TILE, dtype), np.zeros(TILE, dtype)
    zero, one, tiny = dtype.type(0), dtype.type(1), dtype.type(_TINY)
    for frame in range(begin, end):
        first, last = graph.first[frame], graph.first[frame + 1]
        degree = last - first
        size = 6 * degree + tail
        depth_free, cells = graph.depth_free[frame], graph.num_cells[frame]
        for start in range(0, cells, TILE):
            n = min(TILE, cells - start)
            if depth_free:
                sums[frame, 3] += _prior_pull(prior, pose.inverse_depth, frame, start, n, pull, curvature)
                for p in range(6 * degree * TILE, size * TILE):
                    coupling[p] = zero
                for p in range(TILE):
                    coupling[(6 * degree + 2) * TILE + p] = pull[p]
                for k in range(2 if own else 0):
                    at = (6 * degree + TAIL * cameras + k) * TILE
                    for p in range(n):
                        coupling[at + p] = prior.coupling[frame, k, start + p]
            for order in range(first, last):
                sums[frame, 2] += _see(graph, pose, frame, order, start, n, view)
                cost, kept = _cost_sum(robust, scale, view, n)
                sums[frame, 0] += cost
                sums[frame, 1] += kept
                _reweigh(robust, scale, view, n)
                _differentiate(graph, pose, frame, order, start, n, free, view, jacobian)
                _gram(jacobian, rows // 3, 2 * TILE, direct, rows * rows * order)
                if depth_free:
                    ends = graph.source_camera[frame], graph.target_camera[order]
                    _couple(jacobian, free, degree, order - first, ends, coupling, curvature)
            if depth_free and degree:
                for p in range(TILE):
                    c = curvature[p]
                    curvature[p] = one / math.sqrt(c) if c > tiny else zero
                for r in range(size):
                    out = coupling[r * TILE : (r + 1) * TILE]
                    for p in range(TILE):
                        out[p] *= curvature[p]
                _gram(coupling, size // 3, TILE, eliminated, offset[frame])


@vectorised
def _follow(
    graph: Graph,
    pose: Pose,
    twist: Array,
    order: int,
    frame: int,
    start: int,
    n: int,
    view: Array,
    change: Array,
    sums: Array,
) -> None:
    """Add an edge's part in the step of the depths: sums rows are curvature, right-hand side, and what is left of it.

    Args:
        twist: (10,) step of the edge's twist, and of log f and alpha of its source's and its target's camera.
        change: Scratch for three rows.
    """
    row, camera = pose.transform[order], pose.camera[graph.target_camera[order]]
    depth = pose.inverse_depth[frame][start:]
    fx, fy, alpha = camera[0], camera[1], camera[4]
    t0, t1, t2 = row[3], row[7], row[11]
    a0, a1, a2, b0, b1, b2, df, da = twist[0], twist[1], twist[2], twist[3], twist[4], twist[5], twist[8], twist[9]
    zero, one = view.dtype.type(0), view.dtype.type(1)
    for p in range(3 * TILE):
        change[p] = zero
    for k in range(2):
        if twist[6 + k] != 0:
            rays = pose.rays_by_intrinsics[graph.table[frame], k]
            rx, ry, rz = rays[0][start:], rays[1][start:], rays[2][start:]
            step = twist[6 + k]
            for p in range(n):
                a, b, c = rx[p] * step, ry[p] * step, rz[p] * step
                change[p] += row[0] * a + row[1] * b + row[2] * c
                change[TILE + p] += row[4] * a + row[5] * b + row[6] * c
                change[2 * TILE + p] += row[8] * a + row[9] * b + row[10] * c
    for p in range(n):
        su, sv, inverse = view[_SU + p], view[_SV + p], view[_INV + p]
        x, y, z, px, py, d = view[_X + p], view[_Y + p], view[_Z + p], view[_PX + p], view[_PY + p], depth[p]
        norm = view[_NORM + p]
        bend = alpha / norm
        hx, hy, hz = bend * x, bend * y, one + bend * z
        gu, gv = su * fx * inverse, sv * fy * inverse
        slope = hx * t0 + hy * t1 + hz * t2
        ju, jv = gu * (t0 - px * slope), gv * (t1 - py * slope)
        m0 = a0 * d + b1 * z - b2 * y + change[p]
        m1 = a1 * d + b2 * x - b0 * z + change[TILE + p]
        m2 = a2 * d + b0 * y - b1 * x + change[2 * TILE + p]
        slope = hx * m0 + hy * m1 + hz * m2
        share = df - da * norm * inverse
        eu, ev = view[_EU + p], view[_EV + p]
        mu = gu * (m0 - px * slope) + su * fx * px * share
        mv = gv * (m1 - py * slope) + sv * fy * py * share
        sums[p] += ju * ju + jv * jv
        sums[TILE + p] -= ju * eu + jv * ev
        sums[2 * TILE + p] -= ju * (eu + mu) + jv * (ev + mv)


@vectorised
def back_substitute(
    graph: Graph,
    pose: Pose,
    prior: DepthPrior,
    robust: Robust,
    scale: Array,
    twist: Array,
    damping: Array,
    begin: int,
    end: int,
    shift: Array,
    step: Array,
    gain: Array,
) -> None:
    """The step of the free inverse depths of the frames begin:end, given that of everything else.

    Args:
        twist: (E, 10) step of the twists of the edges in order, each with those of log f and alpha of its source's and
            its target's camera.
        damping: (1,) Levenberg-Marquardt damping.
        shift: (N, 2) steps of scale and shift of the prior; (0, 2) where they are held.
        step: (N, P) filled where depths are free.
        gain: (N,) float64, filled with gradient times step.
    """
    dtype = pose.rays.dtype
    view, change, sums = np.zeros(_VIEW_SIZE, dtype), np.zeros(3 * TILE, dtype), np.zeros(3 * TILE, dtype)
    zero, one, tiny = dtype.type(0), dtype.type(1), dtype.type(_TINY)
    for frame in range(begin, end):
        first, last = graph.first[frame], graph.first[frame + 1]
        gain[frame], cells = 0, graph.num_cells[frame]
        if not graph.depth_free[frame] or first == last:
            continue
        for start in range(0, cells, TILE):
            n = min(TILE, cells - start)
            _prior_pull(prior, pose.inverse_depth, frame, start, n, sums[TILE : 2 * TILE], sums[:TILE])
            for p in range(TILE):
                sums[2 * TILE + p] = sums[TILE + p]
            if len(shift):
                by_scale, by_shift = prior.coupling[frame, 0][start:], prior.coupling[frame, 1][start:]
                for p in range(n):
                    sums[2 * TILE + p] += by_scale[p] * shift[frame, 0] + by_shift[p] * shift[frame, 1]
            for order in range(first, last):
                _see(graph, pose, frame, order, start, n, view)
                _reweigh(robust, scale, view, n)
                _follow(graph, pose, twist[order], order, frame, start, n, view, change, sums)
            out = step[frame][start : start + n]
            total = zero
            for p in range(n):
                c = sums[p]
                q = one / (c * (one + damping[0])) if c > tiny else zero
                out[p] = sums[2 * TILE + p] * q
                total += sums[TILE + p] * out[p]
            gain[frame] += total
