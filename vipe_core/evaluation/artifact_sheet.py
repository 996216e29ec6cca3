"""The contact sheet of a sequence on disk."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from vipe_core.errors import FormatError
from vipe_core.evaluation.picture import contact_sheet
from vipe_core.evaluation.truth import GroundTruth
from vipe_core.formats import Artifacts
from vipe_core.video import open_source

_MAX_FRAMES = 12  # enough to cover the map; each is held in memory once


def artifact_sheet(
    artifacts: Artifacts,
    out_png: str | Path,
    *,
    truth: GroundTruth | None = None,
    title: str | None = None,
    subtitle: str = "",
) -> Path:
    """Writes the contact sheet of a sequence with poses, depth and rgb.

    Args:
        truth: Drawn beside the path when it covers exactly the same frames.
        title: Default: the name of the sequence.

    Raises:
        FormatError: The sequence has no depth or no rgb video, or they are damaged.
    """
    if artifacts.rgb_path is None or not artifacts.has_depth:
        raise FormatError(f"{artifacts.name}: a picture needs the attributes depth and rgb")
    count = min(_MAX_FRAMES, artifacts.num_frames)
    wanted = np.unique(np.linspace(0, artifacts.num_frames - 1, count).round().astype(np.int64)).tolist()
    with artifacts.open_depth() as reader:
        depth = [reader.read(k) for k in wanted]
    chosen = set(wanted)
    rgb = [frame.rgb for frame in open_source(artifacts.rgb_path).frames() if frame.index in chosen]
    if len(rgb) != len(wanted):
        raise FormatError(f"rgb/{artifacts.name}.mp4: fewer frames than poses")
    same = truth is not None and np.array_equal(truth.frame_index, artifacts.frame_index)
    return contact_sheet(
        rgb,
        depth,
        artifacts.world_from_cam,
        out_png,
        gt_world_from_cam=truth.world_from_cam if truth is not None and same else None,
        title=artifacts.name if title is None else title,
        subtitle=subtitle,
        camera=artifacts.camera,
        depth_kind=artifacts.depth_kind,
        frame_index=wanted,
    )
