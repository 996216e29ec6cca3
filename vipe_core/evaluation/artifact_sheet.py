"""The picture of a sequence on disk beside its ground truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from vipe_core.evaluation.truth import GroundTruth
from vipe_core.formats import Artifacts
from vipe_core.geometry import umeyama
from vipe_core.rendering.overview import write_overview


def artifact_sheet(artifacts: Artifacts, out: str | Path, *, truth: GroundTruth | None = None) -> Path:
    """Write the overview of a sequence with poses, depth and rgb.

    Args:
        truth: Its path is drawn, moved onto the estimate by a similarity, when it covers exactly the same frames.

    Raises:
        FormatError: The sequence has no depth or no rgb video, or they are damaged.
    """
    poses = None
    if truth is not None and np.array_equal(truth.frame_index, artifacts.frame_index):
        try:
            moved = umeyama(truth.world_from_cam[:, :3, 3], artifacts.world_from_cam[:, :3, 3])
        except ValueError:  # a camera that does not move has no path to be drawn
            moved = None
        poses = None if moved is None else moved.apply_to_poses(truth.world_from_cam)
    return write_overview(artifacts, out, truth=poses)
