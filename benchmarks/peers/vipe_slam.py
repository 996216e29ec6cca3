"""nvidia-vipe's own pose estimation on one of our clips, from an unpacked source distribution of it.

Its keyframe filter, encoders, factor graph, window, global passes and infill run as they are, with weights that are
given and a schedule in the place of its decisions: every n-th frame is a keyframe, none is dropped, and edges join each
keyframe with the three before it. Metric depth, masks and tracks are off. Where its compiled extension is there
(`vipe_ext`, built with nvcc) that is used; elsewhere the few functions of it that are called here are replaced by
torch, but for distances of frames, which decide nothing under this schedule: that says that the calls are right, and
nothing about speed. Needs `einops`.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from vipe_core.geometry import se3
from vipe_core.geometry.quaternion import matrix_from_quaternion, quaternion_from_matrix
from vipe_core.priors.droid.correlation import SIDE, windows_of_features, windows_of_volume

Clock = Callable[[str], AbstractContextManager[None]]

_WARMUP = 8


class _Pose:
    """What is used of lietorch's SE3: (..., 7) translation and quaternion (x, y, z, w)."""

    def __init__(self, data: Tensor) -> None:
        self.data = data

    @classmethod
    def _of(cls, matrix: Tensor) -> _Pose:
        return cls(torch.cat((matrix[..., :3, 3], quaternion_from_matrix(matrix[..., :3, :3])), dim=-1))

    @classmethod
    def exp(cls, twist: Tensor) -> _Pose:
        return cls._of(se3.exp(twist))

    @property
    def shape(self) -> torch.Size:
        return self.data.shape[:-1]

    @property
    def device(self) -> torch.device:
        return self.data.device

    def matrix(self) -> Tensor:
        return se3.compose(matrix_from_quaternion(self.data[..., 3:]), self.data[..., :3])

    def log(self) -> Tensor:
        return se3.log(self.matrix())

    def inv(self) -> _Pose:
        return self._of(se3.inverse(self.matrix()))

    def retr(self, twist: Tensor) -> _Pose:
        return self._of(se3.exp(twist) @ self.matrix())

    def view(self, shape: tuple[int, ...]) -> _Pose:
        return _Pose(self.data.view(*shape, 7))

    def adjT(self, rows: Tensor) -> Tensor:  # noqa: N802 - its name
        return (rows[..., None, :] @ se3.adjoint(self.matrix()))[..., 0, :]

    def __getitem__(self, index: Any) -> _Pose:
        return _Pose(self.data[index])

    def __mul__(self, other: Any) -> Any:
        if isinstance(other, _Pose):
            return self._of(self.matrix() @ other.matrix())
        return (self.matrix() @ other[..., None])[..., 0]


class _Config(dict[str, Any]):
    """What is used of OmegaConf's dictionary."""

    def __getattr__(self, name: str) -> Any:
        return self[name]


@dataclass(frozen=True, slots=True)
class VipeRun:
    """Frames, keyframes and edges of the global graph."""

    frames: int
    keyframes: int
    edges: int


def load(folder: Path) -> dict[str, Any]:
    """Its classes by name.

    Raises:
        ImportError: Not its source, or `einops` is missing.
    """
    root = folder if (folder / "vipe").is_dir() else folder / "sdist"
    sys.path.insert(0, str(root))
    packages = ["vipe", "vipe.slam", "vipe.slam.ba", "vipe.slam.maths", "vipe.slam.networks", "vipe.slam.components"]
    # Their own `__init__` import every network there is.
    for name in (*packages, "vipe.utils"):
        package = ModuleType(name)
        package.__path__ = [str(root / name.replace(".", "/"))]
        sys.modules[name] = package
    # What draws, logs, reads settings and estimates depth is not part of this.
    nothing: dict[str, dict[str, Any]] = {
        "rerun": {},
        "omegaconf": {"DictConfig": _Config},
        "omegaconf.dictconfig": {"DictConfig": _Config},
        "vipe.priors": {},
        "vipe.priors.depth": {"DepthEstimationInput": object, "DepthEstimationModel": object},
        "vipe.priors.depth.base": {"DepthType": SimpleNamespace(METRIC_DEPTH=None)},
        "vipe.utils.logging": {"pbar": iter},
        "vipe.utils.model_cache": {"ModelCache": object},
        "vipe.utils.visualization": {
            "POINTS_STENCIL": None,
            "draw_lines_batch": None,
            "draw_points_batch": None,
        },
        "vipe.slam.interface": {"SLAMMap": object},
        "vipe.slam.components.sparse_tracks": {"SparseTracks": object},
    }
    if importlib.util.find_spec("vipe_ext") is None:
        nothing |= {
            "vipe.ext": {},
            "vipe.ext.lietorch": {"SE3": _Pose, "Sim3": type("Sim3", (), {}), "cat": _cat},
            "vipe.ext.scatter": {"scatter_add": _scatter_add, "scatter_mean": _scatter_mean},
            "vipe.ext.slam_ext": {"frame_distance": _far_away},
            "vipe.ext.droid_net_ext": {
                "corr_index_forward": _look_up_volume,
                "altcorr_index_forward": _look_up_features,
            },
        }
    for name, members in nothing.items():
        module = ModuleType(name)
        vars(module).update(members)
        sys.modules[name] = module
        parent, _, last = name.rpartition(".")
        if parent:
            setattr(sys.modules[parent], last, module)
    found: dict[str, Any] = {}
    for name in ("buffer", "factor_graph", "frontend", "backend", "inner_filler", "motion_filter"):
        found |= vars(importlib.import_module(f"vipe.slam.components.{name}"))
    network = importlib.import_module("vipe.slam.networks.droid_net").DroidNet
    network.load_weights = lambda self: None  # They are given.
    return {**found, "DroidNet": network}


class VipeSlam:
    """Its SLAM for clips of one size, with weights by the names of the public checkpoint.

    Args:
        state: The network's tensors.
        size: (width, height) of the clips' working pictures, whole cells.
        focal_px: Of them, to start from.
        steps: Updates of the two global passes at the end.
    """

    def __init__(
        self,
        vipe: dict[str, Any],
        state: dict[str, Tensor],
        size: tuple[int, int],
        focal_px: float,
        steps: tuple[int, int],
        device: torch.device,
    ) -> None:
        self._vipe, self._size, self._focal_px, self._steps, self._device = vipe, size, focal_px, steps, device
        self._network = vipe["DroidNet"]().eval().to(device)
        self._network.load_state_dict(state)
        self._fused = device.type == "cuda"

    @torch.no_grad()
    def run(self, frames: Iterable[NDArray[np.uint8]], every: int, clock: Clock) -> VipeRun:
        """Pose frames (h, w, 3) of any size; decoding them counts as the first stage."""
        vipe, device = self._vipe, self._device
        tracks = SimpleNamespace(enabled=False)
        config = _Config(
            cross_view=False,
            has_init_pose=False,
            seq_init=False,
            warmup=_WARMUP,
            beta=0.3,
            keyframe_thresh=0.0,
            frontend_thresh=0.0,
            frontend_window=25,
            frontend_radius=2,
            frontend_nms=1,
            backend_thresh=0.0,
            backend_radius=2,
            backend_nms=3,
            optimize_intrinsics=True,
            optimize_rig_rotation=False,
            adaptive_cross_view=False,
            infill_chunk_size=16,
            infill_dense_disp=False,
        )
        kept: list[NDArray[np.uint8]] = []
        width, height = self._size
        reading, count = iter(frames), 0
        buffer = None
        select = vipe["MotionFilter"](self._network, tracks, float("inf"), device)
        while True:
            with clock("decode and encode"):
                rgb = next(reading, None)
                if rgb is None:
                    break
                kept.append(rgb)
                images = self._picture(rgb)
                # Its decision is replaced, not its work.
                select.thresh = -1.0 if count % every == 0 else float("inf")
                wanted = select.check(images, None)
            if buffer is None:
                buffer = self._buffer(height, width)
                frontend = vipe["SLAMFrontend"](self._network, buffer, config, device)
                backend = vipe["SLAMBackend"](self._network, buffer, config, device)
            if wanted:
                with clock("track"):
                    self._add(buffer, count, images, select.f_fmap, select.f_net, select.f_inp)
                    frontend.run()
            count += 1
        assert buffer is not None
        with clock("backend"):
            for steps in self._steps:
                backend.run(steps)
        keyframes = int(buffer.n_frames)
        edges = 0 if backend.last_graph is None else len(backend.last_graph)
        with clock("infill"):
            filler = vipe["InnerFiller"](self._network, buffer, config, device)
            filler.set_start_idx(keyframes)
            for index, rgb in enumerate(kept):
                images = self._picture(rgb)
                found = self._network.encode_features(images)
                state, context = self._network.encode_context(images)
                self._add(buffer, index, images, found, state, context)
                if filler.check() or index == count - 1:
                    filler.compute()
            filler.get_result()
        return VipeRun(count, keyframes, edges)

    def _picture(self, rgb: NDArray[np.uint8]) -> Tensor:
        """(1, 3, h, w) in 0..1 on the device, resized there as it does."""
        whole = torch.from_numpy(rgb).to(self._device).permute(2, 0, 1)[None].float() / 255
        width, height = self._size
        return torch.nn.functional.interpolate(whole, (height, width), mode="bilinear", align_corners=False)

    def _buffer(self, height: int, width: int) -> Any:
        vipe = self._vipe
        solver = _Config(dense_disp_alpha=0.001, fused=self._fused, intrinsics_damping_scale=1.0)
        buffer = vipe["GraphBuffer"](
            height=height,
            width=width,
            n_views=1,
            buffer_size=1024 if self._device.type == "cuda" else 64,
            init_disp=1.0,
            cross_view_idx=None,
            ba_config=solver,
            sparse_tracks=SimpleNamespace(enabled=False),
            camera_type=vipe["CameraType"].PINHOLE,
            device=self._device,
        )
        buffer.intrinsics[0] = torch.tensor([self._focal_px, self._focal_px, width / 2, height / 2])
        if self._device.type == "cpu":
            for name in ("fmaps", "nets", "inps"):  # Half precision is for GPUs.
                setattr(buffer, name, getattr(buffer, name).float())
        return buffer

    def _add(self, buffer: Any, index: int, images: Tensor, found: Tensor, state: Tensor, context: Tensor) -> None:
        at = buffer.n_frames
        buffer.tstamp[at] = index
        buffer.images[at] = images
        buffer.fmaps[at], buffer.nets[at], buffer.inps[at] = found, state, context
        buffer.n_frames = at + 1


def frames_of(video: Path) -> Iterable[NDArray[np.uint8]]:
    """(h, w, 3) frames in order, decoded as it decodes them."""
    capture = cv2.VideoCapture(str(video))
    try:
        while True:
            there, bgr = capture.read()
            if not there:
                return
            yield np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), np.uint8)
    finally:
        capture.release()


def _far_away(poses: Tensor, disps: Tensor, intrinsics: Tensor, ii: Tensor, *_: Any) -> Tensor:
    return torch.ones(len(ii), device=ii.device)


def _cat(poses: list[_Pose], dim: int) -> _Pose:
    return _Pose(torch.cat([pose.data for pose in poses], dim))


def _scatter_add(src: Tensor, index: Tensor, dim: int = -1, dim_size: int | None = None) -> Tensor:
    shape = list(src.shape)
    shape[dim] = int(index.max()) + 1 if dim_size is None else dim_size
    return torch.zeros(shape, dtype=src.dtype, device=src.device).index_add_(dim, index, src)


def _scatter_mean(src: Tensor, index: Tensor, dim: int = -1) -> Tensor:
    total = _scatter_add(src, index, dim)
    shape = [1] * src.ndim
    shape[dim] = -1
    return total / torch.bincount(index).view(shape).to(src.dtype)


def _look_up_volume(volume: Tensor, cells: Tensor, radius: int) -> tuple[Tensor]:
    """(E, 7, 7, h, w) of volumes (E, h, w, h', w') around cells (E, 2, h, w)."""
    edges, height, width = volume.shape[:3]
    at = cells.flatten(2).mT.contiguous()
    found = windows_of_volume(volume.flatten(1, 2), at)
    return (found.permute(0, 2, 1).reshape(edges, 2 * radius + 1, 2 * radius + 1, height, width),)


def _look_up_features(
    source: Tensor, pyramid: list[Tensor], cells: Tensor, ii: Tensor, jj: Tensor, radius: int
) -> tuple[Tensor]:
    """(1, E, 196, h, w) of products of features (1, F, h, w, C) around cells (1, E, h, w, 2)."""
    edges, height, width = cells.shape[1:4]
    queries = source[0][ii].flatten(1, 2)
    at = cells[0].flatten(1, 2)
    found = [windows_of_features(queries, level[0][jj], at / 2**number) for number, level in enumerate(pyramid)]
    # Ours carries the scale of both factors; its features have it already.
    joined = 16 * torch.cat(found, dim=-1)
    return (joined.permute(0, 2, 1).reshape(1, edges, len(pyramid) * SIDE**2, height, width),)
