"""DROID-SLAM's own bundle adjustment on one of our problems, from a checkout of it; pinhole, with known intrinsics.

What it runs is a compiled function for CUDA, `ba_cuda`: kernels and a sparse solve on the host. On a GPU that is built
here (nvcc; Eigen's headers belong in its submodule `thirdparty/lietorch/eigen`). Elsewhere its solver of
training is what there is, `droid_slam/geom/ba.py`: Python over torch and a dense solve. Of that, its SE(3) type and
scatter are compiled, and replaced by `transforms.py`; the one line on stereo pairs, which names a GPU, is left out.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib.abc import InspectLoader
from importlib.machinery import ModuleSpec
from importlib.util import module_from_spec
from pathlib import Path
from types import ModuleType
from typing import Any

import torch
from torch import Tensor

from benchmarks.peers.transforms import Transforms, scatter_sum
from vipe_core.ba import Grid, Problem, State
from vipe_core.geometry.quaternion import matrix_from_quaternion, quaternion_from_matrix

# It scales weights by this.
_WEIGHT_SCALE = 1e-3
_LEAST_CURVATURE = 1e-6


class _Batched(Transforms):
    """One sequence, then its frames or edges."""

    batch_dims = 2


class _OnAnyDevice(InspectLoader):
    """A module of theirs, without what ties it to a GPU."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def is_package(self, fullname: str) -> bool:
        return False

    def get_source(self, fullname: str) -> str:
        source = self._path.read_text().replace("Gij.data[:, ii == jj] = torch.as_tensor(", "(")
        return source.replace('1.0], device="cuda"', "1.0]")


def _grid(problem: Problem) -> Grid:
    assert isinstance(problem.grid, Grid)
    return problem.grid


@dataclass(frozen=True, slots=True)
class Droid:
    """Its solver: the extension, or its Python function `BA`."""

    name: str
    extension: Any
    python: Any

    @staticmethod
    def load(folder: Path, device: torch.device) -> Droid:
        """From a checkout, for a device.

        Raises:
            OSError: Not its source.
            RuntimeError: On a GPU, the extension cannot be built.
        """
        if device.type == "cuda":
            from torch.utils import cpp_extension

            eigen = folder / "thirdparty" / "lietorch" / "eigen"
            build: Any = cpp_extension.load
            sources = [str(Path(__file__).with_name("droid_binding.cpp")), str(folder / "src" / "droid_kernels.cu")]
            flags = {"extra_cflags": ["-O3"], "extra_cuda_cflags": ["-O3"]}
            return Droid("DROID", build("droid_ba", sources, extra_include_paths=[str(eigen)], **flags), None)
        stand_ins: dict[str, dict[str, Any]] = {
            "lietorch": {"SE3": _Batched, "Sim3": type("Sim3", (), {})},
            "torch_scatter": {"scatter_sum": scatter_sum},
            "geom": {"__path__": [str(folder / "droid_slam" / "geom")]},
        }
        for name, members in stand_ins.items():
            sys.modules[name] = module = ModuleType(name)
            vars(module).update(members)
        for name in ("projective_ops", "chol", "ba"):
            loader = _OnAnyDevice(folder / "droid_slam" / "geom" / f"{name}.py")
            module = module_from_spec(ModuleSpec(f"geom.{name}", loader))
            sys.modules[module.__name__] = module
            setattr(sys.modules["geom"], name, module)
            loader.exec_module(module)
        return Droid("DROID (its Python)", None, vars(sys.modules["geom.ba"])["BA"])

    def iteration(self, problem: Problem, state: State, damping: float) -> Callable[[], State]:
        """One Gauss-Newton iteration from a state, as often as called; each gives the state after.

        The first frames are held and all others free, as it has them.
        """
        run = self._extension_step if self.extension is not None else self._python_step
        return lambda: run(problem, state, damping)

    def _measured(self, problem: Problem) -> tuple[Tensor, Tensor]:
        """Targets and weights (E, h, w, 2) on its grid."""
        grid, edges = _grid(problem), problem.edges
        shape = (len(edges.source), grid.height, grid.width, 2)
        target = ((edges.target_px - grid.offset) / grid.stride).float()
        return target.view(shape), (edges.weight * (grid.stride**2 / _WEIGHT_SCALE)).float().view(shape)

    def _camera(self, problem: Problem, state: State) -> Tensor:
        camera = state.intrinsics.float().clone()
        camera[2:] -= _grid(problem).offset
        return camera / _grid(problem).stride

    def _python_step(self, problem: Problem, state: State, damping: float) -> State:
        """Its damping is what it is."""
        grid, edges, count = _grid(problem), problem.edges, len(state.cam_from_world)
        target, weight = self._measured(problem)
        eta = torch.full((1, len(torch.unique(edges.source)), grid.height * grid.width), _LEAST_CURVATURE)
        poses, depths = self.python(
            target[None],
            weight[None],
            eta,
            _Batched(state.cam_from_world.float()[None]),
            state.inverse_depth.view(1, count, grid.height, grid.width),
            self._camera(problem, state).expand(1, count, 4),
            edges.source,
            edges.target,
            fixedp=int((~problem.free.poses).sum()),
        )
        return State(poses.data[0].double(), depths.view(count, -1), state.intrinsics)

    def _extension_step(self, problem: Problem, state: State, damping: float) -> State:
        grid, edges, count = _grid(problem), problem.edges, len(state.cam_from_world)
        device = state.inverse_depth.device
        target, weight = (each.permute(0, 3, 1, 2).contiguous() for each in self._measured(problem))
        world = state.cam_from_world
        poses = torch.cat((world[:, :3, 3], quaternion_from_matrix(world[:, :3, :3])), dim=-1).float().contiguous()
        depths = state.inverse_depth.clone().view(count, grid.height, grid.width)
        first = int((~problem.free.poses).sum())
        seen = torch.unique(torch.cat((torch.arange(first, count, device=device), edges.source)))
        self.extension.ba(
            poses,
            depths,
            self._camera(problem, state),
            torch.zeros_like(depths),
            target,
            weight,
            torch.full((len(seen), grid.height, grid.width), _LEAST_CURVATURE, device=device),
            edges.source,
            edges.target,
            first,
            count,
            1,
            damping,
            0.0,
            False,
        )
        moved = world.clone()
        moved[:, :3, :3] = matrix_from_quaternion(poses[:, 3:].double())
        moved[:, :3, 3] = poses[:, :3].double()
        return State(moved, depths.view(count, -1), state.intrinsics)
