"""Which part of a dataset is judged, and how: all of it, or as the paper does (section 4)."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vipe_core.cameras import Camera
from vipe_core.errors import ConfigError, FormatError
from vipe_core.evaluation.datasets.sequence import GroundTruthSequence, LazyDepth
from vipe_core.evaluation.truth import DepthFrames
from vipe_core.video.views import Crop

PROTOCOLS = ("all", "paper")
SINTEL_SEQUENCES = ("alley_2", "bamboo_1", "bamboo_2", "sleeping_1", "sleeping_2", "temple_2")
_TUM_FREIBURG1 = ("360", "desk", "desk2", "floor", "plant", "room", "rpy", "teddy", "xyz")
_TUM_FREIBURG3 = tuple(
    f"{what}_{how}" for what in ("sitting", "walking") for how in ("halfsphere", "rpy", "static", "xyz")
)


@dataclass(frozen=True, slots=True)
class Protocol:
    """How a dataset is judged.

    Attributes:
        name: `all` or `paper`.
        text: What it is, for the report.
        sequences: Names that are judged; all that are found if None.
        wanted: Whether a name that was found is judged.
        group: Name of the group that a sequence's figures are averaged in.
        max_frames: Only the first so many frames.
        crop: Size of the middle part of the picture that is used.
        with_depth: Whether depth is judged.
        max_depth_m: True depth beyond is not.
        unit: Unit of ATE and RTE in tables, with its length in metres.
    """

    name: str
    text: str
    sequences: tuple[str, ...] | None = None
    wanted: Callable[[str], bool] = lambda name: True
    group: Callable[[str], str] = lambda name: "all"
    max_frames: int | None = None
    crop: tuple[int, int] | None = None
    with_depth: bool = False
    max_depth_m: float | None = None
    unit: tuple[str, float] = ("m", 1.0)

    def choose(self, found: Sequence[str]) -> tuple[list[str], list[str]]:
        """The sequences of `found` that are judged, and those of the protocol that were not found."""
        if self.sequences is None:
            return [name for name in found if self.wanted(name)], []
        return [name for name in self.sequences if name in found], [
            name for name in self.sequences if name not in found
        ]

    def apply(self, sequence: GroundTruthSequence) -> GroundTruthSequence:
        """The sequence cut to the protocol's length and crop, its truth too."""
        return cropped(shortened(sequence, self.max_frames), self.crop)


def shortened(sequence: GroundTruthSequence, max_frames: int | None) -> GroundTruthSequence:
    """The first `max_frames` frames, with the rows of the truth that belong to them.

    Raises:
        FormatError: Fewer than two of these have a pose.
    """
    if max_frames is None:
        return sequence
    truth = sequence.truth
    rows = np.flatnonzero(truth.frame_index < max_frames)
    if len(rows) < 2:
        raise FormatError(f"{sequence.name}: fewer than two of the first {max_frames} frames have a true pose")
    kept = dataclasses.replace(
        truth,
        world_from_cam=truth.world_from_cam[rows],
        frame_index=truth.frame_index[rows],
        depth=None if truth.depth is None else _chosen(truth.depth, rows),
        dynamic=None if truth.dynamic is None else truth.dynamic[rows],
    )
    files, times_s = sequence.pictures.files, sequence.pictures.timestamps_s
    pictures = dataclasses.replace(
        sequence.pictures,
        files=None if files is None else files[:max_frames],
        timestamps_s=None if times_s is None else times_s[:max_frames],
        stop=max_frames if files is None else None,
    )
    return dataclasses.replace(sequence, pictures=pictures, truth=kept)


def cropped(sequence: GroundTruthSequence, size: tuple[int, int] | None) -> GroundTruthSequence:
    """The middle `size` = (width, height) pixels of every picture.

    Raises:
        ConfigError: The camera is not a pinhole whose picture the crop fits into, or there is depth of another size.
    """
    if size is None:
        return sequence
    truth, camera = sequence.truth, sequence.truth.camera
    if camera is None or camera.model != "pinhole" or size[0] > camera.width or size[1] > camera.height:
        raise ConfigError(
            f"{sequence.name}: a crop of {size[0]}x{size[1]} needs a calibrated pinhole at least as large"
        )
    crop = Crop.centred(*size, (camera.width, camera.height))
    fx, fy, cx, cy = camera.params
    depth = truth.depth
    if depth is not None:
        if depth.shape[1:] != (camera.height, camera.width):
            raise ConfigError(f"{sequence.name}: depth of another size than the picture cannot be cropped with it")
        depth = _cut(depth, crop)
    rows, columns = slice(crop.top, crop.top + crop.height), slice(crop.left, crop.left + crop.width)
    kept = dataclasses.replace(
        truth,
        camera=Camera("pinhole", (fx, fy, cx - crop.left, cy - crop.top), *size),
        depth=depth,
        dynamic=None if truth.dynamic is None else truth.dynamic[:, rows, columns],
    )
    return dataclasses.replace(sequence, pictures=dataclasses.replace(sequence.pictures, crop=size), truth=kept)


def protocol_of(dataset: str, name: str) -> Protocol:
    """The protocol called `name` of a dataset.

    Raises:
        ConfigError: There is none of that name, or the paper does not judge this dataset.
    """
    if name not in PROTOCOLS:
        raise ConfigError(f"unknown protocol {name!r}; on offer: {', '.join(PROTOCOLS)}")
    if name == "all":
        return Protocol("all", "Every sequence that was found, every frame, whole pictures.")
    if dataset not in _PAPER:
        raise ConfigError(f"the paper has no protocol for {dataset!r}; it has for: {', '.join(_PAPER)}")
    return _PAPER[dataset]


def _tum_group(name: str) -> str:
    found = re.search(r"freiburg(\d)", name)
    return f"Freiburg{found[1]}" if found else "other"


_PAPER: dict[str, Protocol] = {
    "tum": Protocol(
        "paper",
        "Table 1: Freiburg1 (static) and Freiburg3 (dynamic), whole pictures as published. The paper names the groups,"
        " not the sequences; these are the nine of Freiburg1 that visual SLAM is usually judged on and the eight of"
        " Freiburg3 with sitting and walking people, which have about 950 frames on average, as the paper says.",
        sequences=(
            *(f"rgbd_dataset_freiburg1_{what}" for what in _TUM_FREIBURG1),
            *(f"rgbd_dataset_freiburg3_{what}" for what in _TUM_FREIBURG3),
        ),
        group=_tum_group,
        unit=("cm", 0.01),
    ),
    "kitti": Protocol(
        "paper",
        "Table 2: the sequences with published poses, the middle 512x368 pixels of the first 1024 frames.",
        sequences=tuple(f"{number:02d}" for number in range(11)),
        max_frames=1024,
        crop=(512, 368),
    ),
    "sintel": Protocol(
        "paper",
        "Table 3: the six sequences of the paper, final pass; depth beyond 70 m is left out and estimates are cut"
        " to it, as in the protocol of CUT3R that the paper follows.",
        sequences=SINTEL_SEQUENCES,
        with_depth=True,
        max_depth_m=70.0,
    ),
    "eth3d": Protocol(
        "paper",
        "Table 3: the training sequences of the SLAM benchmark whose names do not hold `dark` (50 in the paper).",
        wanted=lambda name: "dark" not in name,
        with_depth=True,
        unit=("cm", 0.01),
    ),
}


def _chosen(depth: DepthFrames, rows: NDArray[np.int64]) -> LazyDepth:
    return LazyDepth((len(rows), *_map_size(depth)), lambda row: depth[int(rows[row])])


def _cut(depth: DepthFrames, crop: Crop) -> LazyDepth:
    def read(row: int) -> NDArray[Any]:
        return depth[row][crop.top : crop.top + crop.height, crop.left : crop.left + crop.width]

    return LazyDepth((depth.shape[0], crop.height, crop.width), read)


def _map_size(depth: DepthFrames) -> tuple[int, int]:
    height, width = depth.shape[1:]
    return height, width
