"""Ground truth in one shape for every dataset, its own file format (gt.npz), and an estimate compared with it."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from vipe_core.annotation import DepthKind
from vipe_core.cameras import MODEL_CODE, Camera, CameraModel
from vipe_core.errors import ConfigError, FormatError
from vipe_core.evaluation.metrics import (
    CameraErrors,
    DepthAlignment,
    DepthErrors,
    MaskErrors,
    TrajectoryErrors,
    camera_errors,
    convert_depth,
    depth_errors,
    depth_pose_scale_ratio,
    mask_errors,
    sample_depth,
    trajectory_errors,
)
from vipe_core.formats import Artifacts

_MODELS: dict[str, CameraModel] = {model: model for model in MODEL_CODE}
_KINDS: dict[str, DepthKind] = {"z": "z", "ray": "ray"}
# Depth values that one comparison holds in memory; of longer or finer sequences every k-th row and column counts.
_MAX_DEPTH_VALUES = 20_000_000


class DepthFrames(Protocol):
    """Depth maps by number: an array, or a reader that opens a file for each."""

    @property
    def shape(self) -> tuple[int, ...]:
        """(N, h, w)."""

    def __getitem__(self, row: int, /) -> NDArray[Any]:
        """(h, w) depth of row `row` of the truth, 0 where unknown."""


@dataclass(frozen=True, slots=True)
class GroundTruth:
    """The truth of one video.

    Attributes:
        world_from_cam: (N, 4, 4) float64, OpenCV axes, metres.
        frame_index: (N,) int64: which frame of the video each row belongs to.
        camera: None where the dataset publishes no calibration of the pictures.
        depth: N maps of kind `depth_kind`, 0 where unknown, on any grid over the picture; None where there are none.
        dynamic: (N, h, w) bool, true on pixels that move by themselves; None where the dataset does not say.
        depth_camera: Of a depth sensor beside the camera, where its maps are not registered to the pictures; None where
            they are.
    """

    world_from_cam: NDArray[np.float64]
    frame_index: NDArray[np.int64]
    camera: Camera | None
    depth: DepthFrames | None
    depth_kind: DepthKind
    dynamic: NDArray[np.bool_] | None
    depth_camera: Camera | None = None


@dataclass(frozen=True, slots=True)
class Estimate:
    """What is compared with the truth.

    Attributes:
        name: For error messages.
        world_from_cam: (M, 4, 4) float64.
        frame_index: (M,) which frame of the video each pose belongs to.
        camera: At any resolution of the same pictures.
        depth: M depth maps in order, or None to leave depth out.
        depth_kind: Kind of these.
        masks: M masks (H, W) in order, non-zero where something moves by itself, or None to leave them out. They are
            asked for after the last depth map.
    """

    name: str
    world_from_cam: NDArray[np.float64]
    frame_index: Sequence[int] | NDArray[np.int64]
    camera: Camera
    depth: Iterable[NDArray[np.float32]] | None = None
    depth_kind: DepthKind = "z"
    masks: Iterable[NDArray[np.uint8]] | None = None


@dataclass(frozen=True, slots=True)
class SequenceReport:
    """All errors of one sequence. Static pixels only where depth is concerned.

    Attributes:
        coverage: Share of the true frames that the estimate has a pose for.
        depth_pose_ratio: Depth scale over pose scale, 1 when both are in the same units.
        mask: Of the masks of moving things, where there are any and the truth is known.
    """

    coverage: float
    trajectory: TrajectoryErrors
    camera: CameraErrors | None
    depth: DepthErrors | None
    depth_pose_ratio: float | None
    mask: MaskErrors | None = None


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
        sensor = values.get("shipped_intrinsics")
        depth_camera = (
            None if sensor is None else Camera("pinhole", tuple(map(float, sensor)), camera.width, camera.height)
        )
        depth = values.get("depth")
        kind = _KINDS[str(values.get("depth_kind", "z"))]
    except FileNotFoundError as error:
        raise FormatError(f"{path.name}: no such file in {path.parent.name}") from error
    except (KeyError, OSError, ValueError, EOFError, zipfile.BadZipFile, ConfigError) as error:
        raise FormatError(f"{path.parent.name}/{path.name}: not a readable ground truth file ({error})") from error
    index = values.get("frame_index", np.arange(len(poses))).astype(np.int64)
    return GroundTruth(poses, index, camera, depth, kind, values.get("dynamic"), depth_camera)


def sample_at_truth(depth: NDArray[np.float32], truth: GroundTruth) -> NDArray[np.float32]:
    """(h, w) a depth map of a picture, at the pixels of the true depth maps; 0 outside of the picture.

    The pixels of a depth sensor that looks beside the camera see what lies in their directions; the few centimetres
    between the two are left out.
    """
    assert truth.depth is not None
    height, width = truth.depth.shape[1:]
    if truth.depth_camera is None or truth.camera is None:
        return sample_depth(depth, height, width)
    camera = truth.camera.resized(depth.shape[1], depth.shape[0])
    px, imaged = camera.project(truth.depth_camera.resized(width, height).rays())
    at = np.where(imaged[..., None], px, -10).astype(np.float32)
    known = np.isfinite(depth) & (depth > 0)
    inverse = np.where(known, 1 / np.where(known, depth, 1), 0).astype(np.float32)
    found = cv2.remap(inverse, at[..., 0], at[..., 1], cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT)
    return np.where(found > 0, 1 / np.where(found > 0, found, 1), 0).astype(np.float32)


def evaluate(
    estimate: Estimate, truth: GroundTruth, alignment: DepthAlignment = "scale", max_depth: float | None = None
) -> SequenceReport:
    """Compares an estimate with the truth; takes one depth map and one mask at a time.

    Args:
        alignment, max_depth: As in `depth_errors`.

    Raises:
        FormatError: They share fewer than two frames.
    """
    rows = _matching(estimate.frame_index, truth, estimate.name)
    camera = estimate.camera
    if truth.camera is not None and (camera.width, camera.height) != (truth.camera.width, truth.camera.height):
        camera = camera.resized(truth.camera.width, truth.camera.height)
    depth = None
    if estimate.depth is not None and truth.depth is not None:
        depth = depth_errors(_depth_pairs(estimate, estimate.depth, truth, rows, camera), alignment, max_depth)
    mask = None
    if estimate.masks is not None and truth.dynamic is not None:
        mask = mask_errors(_mask_pairs(estimate.masks, truth.dynamic, rows))
    return _report(estimate.world_from_cam[rows[:, 0]], camera, depth, mask, truth, rows[:, 1])


def evaluate_artifacts(
    artifacts: Artifacts, truth: GroundTruth, alignment: DepthAlignment = "scale", max_depth: float | None = None
) -> SequenceReport:
    """Compares artifacts on disk with the truth; reads one depth map and one mask at a time.

    Args:
        alignment, max_depth: As in `depth_errors`.

    Raises:
        FormatError: The artifacts are damaged, or share fewer than two frames with the truth.
    """

    with ExitStack() as stack:
        depth = stack.enter_context(artifacts.open_depth()) if artifacts.has_depth and truth.depth is not None else None
        masked = artifacts.has_mask and truth.dynamic is not None
        masks = stack.enter_context(artifacts.open_mask()) if masked else None
        estimate = Estimate(
            artifacts.name,
            artifacts.world_from_cam,
            artifacts.frame_index,
            artifacts.camera,
            depth,
            artifacts.depth_kind,
            masks,
        )
        return evaluate(estimate, truth, alignment, max_depth)


def evaluate_static_guess(truth: GroundTruth, fov_x_deg: float = 60.0) -> SequenceReport:
    """The trivial answer to compare with: a camera that never moves, a default lens, and one depth everywhere."""
    rows = np.arange(len(truth.world_from_cam))
    estimate = np.repeat(np.eye(4)[None], len(rows), axis=0)
    camera = truth.camera
    if camera is None or camera.model != "equirect":
        width, height = (1, 1) if camera is None else (camera.width, camera.height)
        camera = Camera.pinhole_from_fov(fov_x_deg, width, height)
    depth = None
    if truth.depth is not None:
        step = _pixel_step(truth.depth, len(rows))
        maps = (_true_depth(truth, int(row), step) for row in rows)
        depth = depth_errors((np.ones(true.shape, np.float32), true, static) for true, static in maps)
    return _report(estimate, camera, depth, None, truth, rows)


def _report(
    estimate: NDArray[np.float64],
    camera: Camera,
    depth: DepthErrors | None,
    mask: MaskErrors | None,
    truth: GroundTruth,
    rows: NDArray[np.int64],
) -> SequenceReport:
    trajectory = trajectory_errors(estimate, truth.world_from_cam[rows], truth.frame_index[rows])
    return SequenceReport(
        coverage=len(rows) / len(truth.world_from_cam),
        trajectory=trajectory,
        camera=None if truth.camera is None else camera_errors(camera, truth.camera),
        depth=depth,
        depth_pose_ratio=depth_pose_scale_ratio(depth, trajectory),
        mask=mask,
    )


def _matching(frame_index: Sequence[int] | NDArray[np.int64], truth: GroundTruth, name: str) -> NDArray[np.int64]:
    """(K, 2) rows of estimate and truth that belong to the same frame."""
    row_of = {int(frame): row for row, frame in enumerate(truth.frame_index)}
    rows = [(k, row_of[int(frame)]) for k, frame in enumerate(frame_index) if int(frame) in row_of]
    if len(rows) < 2:
        raise FormatError(f"{name}: fewer than two frames are in the ground truth; is it of another video?")
    return np.array(rows, dtype=np.int64)


def _pixel_step(depth: DepthFrames, num_frames: int) -> int:
    """Every how many rows and columns to compare, to stay within `_MAX_DEPTH_VALUES`."""
    return max(1, math.ceil(math.sqrt(num_frames * math.prod(depth.shape[1:]) / _MAX_DEPTH_VALUES)))


def _true_depth(truth: GroundTruth, row: int, step: int) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    assert truth.depth is not None
    depth = np.asarray(truth.depth[row], dtype=np.float32)[::step, ::step]
    static = np.ones(depth.shape, np.bool_) if truth.dynamic is None else ~truth.dynamic[row][::step, ::step]
    return depth, static


def _depth_pairs(
    estimate: Estimate,
    maps: Iterable[NDArray[np.float32]],
    truth: GroundTruth,
    rows: NDArray[np.int64],
    camera: Camera,
) -> Iterator[tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]]:
    assert truth.depth is not None
    true_row = dict(rows.tolist())
    step = _pixel_step(truth.depth, len(rows))
    # The estimate's kind is made the truth's with the true camera: its error is judged apart.
    lens = camera if truth.camera is None else truth.camera
    for k, depth in enumerate(maps):
        if k not in true_row:
            continue
        sampled = convert_depth(sample_at_truth(depth, truth), lens, estimate.depth_kind, truth.depth_kind)
        yield sampled[::step, ::step], *_true_depth(truth, true_row[k], step)


def _mask_pairs(
    masks: Iterable[NDArray[np.uint8]], dynamic: NDArray[np.bool_], rows: NDArray[np.int64]
) -> Iterator[tuple[NDArray[np.uint8], NDArray[np.bool_]]]:
    true_row = dict(rows.tolist())
    for k, mask in enumerate(masks):
        if k in true_row:
            yield mask, np.asarray(dynamic[true_row[k]], dtype=np.bool_)
