"""Ground truth on disk (gt.npz), and one sequence's estimate compared with it."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vipe_core.annotation import DepthKind
from vipe_core.cameras import Camera, CameraModel
from vipe_core.errors import ConfigError, FormatError
from vipe_core.evaluation.metrics import (
    CameraErrors,
    DepthErrors,
    TrajectoryErrors,
    camera_errors,
    convert_depth,
    depth_errors,
    depth_pose_scale_ratio,
    sample_depth,
    trajectory_errors,
)
from vipe_core.formats import Artifacts

_MODELS: dict[str, CameraModel] = {"pinhole": "pinhole", "mei": "mei", "equirect": "equirect"}
_KINDS: dict[str, DepthKind] = {"z": "z", "ray": "ray"}


@dataclass(frozen=True, slots=True)
class GroundTruth:
    """The truth of one video; keys of the file as in `vipe_core.evaluation.samples`.

    Attributes:
        world_from_cam: (N, 4, 4) float64, OpenCV axes, metres.
        frame_index: (N,) int64: which frame of the video each row belongs to.
        depth: (N, h, w) float16 of kind `depth_kind`, 0 where unknown; None where the file has none.
        dynamic: (N, h, w) bool; all false where the file does not say.
    """

    world_from_cam: NDArray[np.float64]
    frame_index: NDArray[np.int64]
    camera: Camera
    depth: NDArray[np.float16] | None
    depth_kind: DepthKind
    dynamic: NDArray[np.bool_] | None


@dataclass(frozen=True, slots=True)
class SequenceReport:
    """All errors of one sequence. Static pixels only where depth is concerned.

    Attributes:
        coverage: Share of the true frames that the estimate has a pose for.
        depth_pose_ratio: Depth scale over pose scale, 1 when both are in the same units.
    """

    coverage: float
    trajectory: TrajectoryErrors
    camera: CameraErrors | None
    depth: DepthErrors | None
    depth_pose_ratio: float | None


def read_truth(path: str | Path) -> GroundTruth:
    """Reads a gt.npz.

    Raises:
        FormatError: The file is missing, damaged or lacks a key.
    """
    path = Path(path)
    try:
        with np.load(path, allow_pickle=False) as file:
            values = {key: file[key] for key in file.files if key not in ("meta", "notes", "filenames")}
        model = _MODELS[str(values["camera"])]
        poses = values["cam_to_world"].astype(np.float64)
        params = () if model == "equirect" else tuple(float(x) for x in values["intrinsics"])
        camera = Camera(model, params, int(values["width"]), int(values["height"]))
        depth = values.get("depth")
        kind = _KINDS[str(values.get("depth_kind", "z"))]
    except FileNotFoundError as error:
        raise FormatError(f"{path.name}: no such file in {path.parent.name}") from error
    except (KeyError, OSError, ValueError, EOFError, zipfile.BadZipFile, ConfigError) as error:
        raise FormatError(f"{path.parent.name}/{path.name}: not a readable ground truth file ({error})") from error
    index = values.get("frame_index", np.arange(len(poses))).astype(np.int64)
    return GroundTruth(poses, index, camera, depth, kind, values.get("dynamic"))


def evaluate_artifacts(artifacts: Artifacts, truth: GroundTruth) -> SequenceReport:
    """Compares artifacts on disk with the truth; reads one depth map at a time.

    Raises:
        FormatError: The artifacts are damaged, or share fewer than two frames with the truth.
    """
    rows = _matching(artifacts.frame_index, truth, artifacts.name)
    estimate = artifacts.world_from_cam[rows[:, 0]]
    depth = None
    if artifacts.has_depth and truth.depth is not None:
        depth = depth_errors(_depth_pairs(artifacts, truth, rows))
    camera = artifacts.camera
    if (camera.width, camera.height) != (truth.camera.width, truth.camera.height):
        camera = camera.resized(truth.camera.width, truth.camera.height)
    return _report(estimate, camera, depth, truth, rows[:, 1])


def evaluate_static_guess(truth: GroundTruth, fov_x_deg: float = 60.0) -> SequenceReport:
    """The trivial answer to compare with: a camera that never moves, a default lens, and one depth everywhere."""
    rows = np.arange(len(truth.world_from_cam))
    estimate = np.repeat(np.eye(4)[None], len(rows), axis=0)
    camera = truth.camera
    if camera.model != "equirect":
        camera = Camera.pinhole_from_fov(fov_x_deg, camera.width, camera.height)
    depth = None
    if truth.depth is not None:
        ones = np.ones(truth.depth.shape[1:], np.float32)
        depth = depth_errors((ones, *_true_depth(truth, int(row))) for row in rows)
    return _report(estimate, camera, depth, truth, rows)


def _report(
    estimate: NDArray[np.float64],
    camera: Camera,
    depth: DepthErrors | None,
    truth: GroundTruth,
    rows: NDArray[np.int64],
) -> SequenceReport:
    trajectory = trajectory_errors(estimate, truth.world_from_cam[rows], truth.frame_index[rows])
    return SequenceReport(
        coverage=len(rows) / len(truth.world_from_cam),
        trajectory=trajectory,
        camera=camera_errors(camera, truth.camera),
        depth=depth,
        depth_pose_ratio=depth_pose_scale_ratio(depth, trajectory),
    )


def _matching(frame_index: Sequence[int] | NDArray[np.int64], truth: GroundTruth, name: str) -> NDArray[np.int64]:
    """(K, 2) rows of estimate and truth that belong to the same frame."""
    row_of = {int(frame): row for row, frame in enumerate(truth.frame_index)}
    rows = [(k, row_of[int(frame)]) for k, frame in enumerate(frame_index) if int(frame) in row_of]
    if len(rows) < 2:
        raise FormatError(f"{name}: fewer than two frames are in the ground truth; is it of another video?")
    return np.array(rows, dtype=np.int64)


def _true_depth(truth: GroundTruth, row: int) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    assert truth.depth is not None
    depth = truth.depth[row].astype(np.float32)
    static = np.ones(depth.shape, np.bool_) if truth.dynamic is None else ~truth.dynamic[row]
    return depth, static


def _depth_pairs(
    artifacts: Artifacts, truth: GroundTruth, rows: NDArray[np.int64]
) -> Iterator[tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]]:
    true_row = dict(rows.tolist())
    with artifacts.open_depth() as reader:
        for k, estimate in enumerate(reader):
            if k not in true_row:
                continue
            depth, static = _true_depth(truth, true_row[k])
            sampled = sample_depth(estimate, *depth.shape)
            # The estimate's kind is made the truth's with the true camera: its error is judged apart.
            yield convert_depth(sampled, truth.camera, artifacts.depth_kind, truth.depth_kind), depth, static
