"""nvidia-vipe's own bundle adjustment on one of our problems, from an unpacked source distribution of it.

Its default solver (`ba.fused: false`) is Python over torch and SciPy; only its SE(3) type and scatter come from a
compiled extension. Where that is not built, they are replaced by `transforms.py`, and nothing else is: the terms, the
block matrices, the elimination and the sparse solve are its own. Needs `einops`.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import torch
from torch import Tensor

from benchmarks.peers.transforms import Transforms, scatter_sum
from vipe_core.ba import Grid, Problem, State


def load(folder: Path) -> dict[str, Any]:
    """Its solver's classes by name, from the unpacked source distribution.

    Raises:
        ImportError: Not its source, or `einops` is missing.
    """
    try:
        importlib.import_module("vipe_ext")
        sys.path.insert(0, str(folder))
    except ImportError:
        for name in ("vipe", "vipe.slam", "vipe.slam.ba", "vipe.slam.maths", "vipe.utils", "vipe.ext"):
            package = ModuleType(name)
            package.__path__ = [str(folder / name.replace(".", "/"))]
            sys.modules[name] = package
        stand_ins: dict[str, dict[str, Any]] = {
            "lietorch": {"SE3": Transforms, "Sim3": type("Sim3", (), {})},
            "scatter": {"scatter_add": scatter_sum},
            "slam_ext": {},
        }
        for name, members in stand_ins.items():
            module = ModuleType(f"vipe.ext.{name}")
            vars(module).update(members)
            sys.modules[module.__name__] = module
            setattr(sys.modules["vipe.ext"], name, module)
    found: dict[str, Any] = {}
    for name in ("slam.ba.solver", "slam.ba.terms", "slam.maths.retractor", "utils.cameras", "ext.lietorch"):
        found |= vars(importlib.import_module(f"vipe.{name}"))
    return found


def iteration(vipe: dict[str, Any], problem: Problem, state: State, damping: float) -> Callable[[], State]:
    """One Gauss-Newton iteration of a pinhole problem from a state, as often as called; each gives the state after."""
    grid, edges, free = problem.grid, problem.edges, problem.free
    assert isinstance(grid, Grid)
    device, count = state.inverse_depth.device, len(edges.source)
    target = ((edges.target_px - grid.offset) / grid.stride).float()
    weight = (edges.weight * grid.stride**2).float()
    view = torch.zeros(count, dtype=torch.int64, device=device)
    transform = vipe["SE3"]

    def run() -> State:
        poses = _pose_data(transform, state.cam_from_world.float().clone())
        intrinsics = state.intrinsics.float()[None].clone()
        intrinsics[:, 2:] -= grid.offset
        rig = _pose_data(transform, torch.eye(4, device=device)[None])
        variables = {"pose": poses, "dense_disp": state.inverse_depth.clone(), "intrinsics": intrinsics, "rig": rig}
        solver = vipe["Solver"]()
        solver.add_term(
            vipe["DenseDepthFlowTerm"](
                pose_i_inds=edges.source,
                pose_j_inds=edges.target,
                rig_i_inds=view,
                rig_j_inds=view,
                dense_disp_i_inds=edges.source,
                target=target,
                weight=weight,
                intrinsics=None,
                intrinsics_factor=float(grid.stride),
                rig=None,
                image_size=(grid.height, grid.width),
                camera_type=vipe["CameraType"].PINHOLE,
            )
        )
        solver.set_fixed("pose", torch.nonzero(~free.poses)[:, 0].to(device))
        solver.set_retractor("pose", vipe["PoseRetractor"]())
        solver.set_retractor("dense_disp", vipe["DenseDispRetractor"]())
        solver.set_retractor("intrinsics", vipe["IntrinsicsRetractor"](vipe["CameraType"].PINHOLE))
        for group in ("pose", "dense_disp", *(["intrinsics"] if free.focal else [])):
            solver.set_damping(group, damping, 0.0)
        solver.set_marginilized("dense_disp")
        solver.set_fixed("rig", None)
        if not free.focal:
            solver.set_fixed("intrinsics", None)
        solver.run_inplace(variables)
        intrinsics[:, 2:] += grid.offset
        return State(_matrices(poses).double(), variables["dense_disp"], intrinsics[0].double())

    return run


def _pose_data(transform: Any, matrices: Tensor) -> Any:
    if transform is Transforms:
        return transform(matrices)
    from vipe_core.geometry.quaternion import quaternion_from_matrix

    return transform(torch.cat((matrices[:, :3, 3], quaternion_from_matrix(matrices[:, :3, :3])), dim=-1))


def _matrices(poses: Any) -> Tensor:
    matrices: Tensor = poses.data if isinstance(poses, Transforms) else poses.matrix()
    return matrices
