"""Pose graph over similarities: spreads what a loop closure contradicts over the links around it.

A video has no absolute scale, so drift bends the scale as well as the path: every node has one of its own
(Strasdat et al., Scale Drift-Aware Large Scale Monocular SLAM, RSS 2010).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.linalg import spsolve
from scipy.spatial.transform import Rotation

from vipe_core.geometry.sim3 import Sim3

_ITERATIONS = 20
_CONVERGED = 1e-6
# Information of staying put, beside links of about one: it keeps a node that nothing links to.
_DAMPING = 1e-6


@dataclass(frozen=True, slots=True)
class SimLink:
    """A measured similarity `target_from_source` between two nodes with the information `weight` per component."""

    source: int
    target: int
    target_from_source: Sim3
    weight: float


def relax(nodes: Sequence[Sim3], links: Sequence[SimLink]) -> list[Sim3]:
    """Gauss-Newton on the links' errors (translation, rotation vector, log scale).

    Args:
        nodes: node_from_world. The first one is held.
        links: Between nodes, by number.

    Returns:
        The nodes at the least weighted squared error.
    """
    current = list(nodes)
    for _ in range(_ITERATIONS):
        step = _step(current, links)
        current = [_moved(node, twist) for node, twist in zip(current, step, strict=True)]
        if float(np.abs(step).max()) < _CONVERGED:
            break
    return current


def _step(nodes: Sequence[Sim3], links: Sequence[SimLink]) -> NDArray[np.float64]:
    """(K, 7) left perturbations of the nodes.

    With E = S_target S_source^-1 M^-1 near the identity, log E changes by the target's perturbation less Ad_M times
    the source's.
    """
    rows: list[NDArray[np.int64]] = []
    columns: list[NDArray[np.int64]] = []
    values: list[NDArray[np.float64]] = []
    errors = np.zeros(7 * len(links))
    block = np.repeat(np.arange(7), 7), np.tile(np.arange(7), 7)
    for row, link in enumerate(links):
        root = float(np.sqrt(link.weight))
        between = nodes[link.target] @ nodes[link.source].inverse()
        error = between @ link.target_from_source.inverse()
        errors[7 * row : 7 * row + 7] = root * np.concatenate(
            [error.translation, Rotation.from_matrix(error.rotation).as_rotvec(), [np.log(error.scale)]]
        )
        for node, slope in ((link.target, np.eye(7)), (link.source, -_adjoint(link.target_from_source))):
            rows.append(7 * row + block[0])
            columns.append(7 * node + block[1])
            values.append(root * slope.reshape(-1))
    size = 7 * len(nodes)
    index = np.concatenate(rows), np.concatenate(columns)
    jacobian = coo_array((np.concatenate(values), index), shape=(7 * len(links), size)).tocsc()[:, 7:]
    held = coo_array((np.full(size - 7, _DAMPING), (np.arange(size - 7),) * 2), shape=(size - 7,) * 2)
    solution = spsolve((jacobian.T @ jacobian + held).tocsc(), -(jacobian.T @ errors))
    return np.concatenate([np.zeros(7), solution]).reshape(-1, 7)


def _moved(node: Sim3, twist: NDArray[np.float64]) -> Sim3:
    turn = Rotation.from_rotvec(twist[3:6]).as_matrix()
    return Sim3(float(np.exp(twist[6])), turn, twist[:3]) @ node


def _adjoint(transform: Sim3) -> NDArray[np.float64]:
    """(7, 7) on (translation, rotation, log scale)."""
    x, y, z = transform.translation
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    adjoint = np.zeros((7, 7))
    adjoint[:3, :3] = transform.scale * transform.rotation
    adjoint[:3, 3:6] = skew @ transform.rotation
    adjoint[:3, 6] = -transform.translation
    adjoint[3:6, 3:6] = transform.rotation
    adjoint[6, 6] = 1.0
    return adjoint
