"""One picture of a result: its first and last frame over their depth, beside the cloud with the camera path."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vipe_core.cameras import Camera
from vipe_core.formats.frames import ArtifactFrame, read_frames, spread
from vipe_core.formats.fused import fuse_cloud
from vipe_core.formats.reading import Artifacts
from vipe_core.fusion import PointCloud
from vipe_core.rendering.canvas import BACKGROUND, Canvas, fitted, grid, label, save
from vipe_core.rendering.cloud_picture import Path3D, render_cloud
from vipe_core.rendering.depth_colours import DepthColours, paint_confidence
from vipe_core.rendering.viewpoints import Stage, foreground

FOV_DEG = 42.0
ZOOM = 1.04
_FRUSTUM = 0.055  # of the extent of the scene
_MOST_FRUSTA = 7
_TILE_PX = 320
_GAP, _MARGIN = 6, 8
_VIEW = (1000, 700)


def write_overview(artifacts: Artifacts, out: str | Path, *, truth: NDArray[np.float64] | None = None) -> Path:
    """Write a `.jpg` or `.png`; of a sequence with cuts it shows the longest shot.

    Args:
        truth: (N, 4, 4) true poses in the world of the sequence: their path is drawn in white.

    Raises:
        FormatError: No depth or no rgb.
    """
    artifacts = artifacts.longest_shot()
    if truth is not None and artifacts.part is not None:
        truth = truth[artifacts.part.start : artifacts.part.stop]
    cloud, stage = scene(artifacts)
    with closing(read_frames(artifacts, spread(artifacts.num_frames, 2).__contains__)) as frames:
        ends = list(frames)
    viewer = Camera.pinhole_from_fov(FOV_DEG, *_VIEW)
    view = render_cloud(
        cloud,
        stage.around(*stage.best(viewer), viewer, zoom=ZOOM),
        viewer,
        paths=paths(artifacts, stage, truth=truth),
    )
    if truth is not None:
        view = label(view, "white: ground truth")
    return save(overview(ends, DepthColours.of(artifacts), view), Path(out))


def scene(artifacts: Artifacts) -> tuple[PointCloud, Stage]:
    """What is drawn of a sequence, and where to look at it from."""
    cloud = fuse_cloud(artifacts)
    return cloud.where(foreground(cloud, artifacts.world_from_cam)), Stage.of(cloud, artifacts.world_from_cam)


def paths(
    artifacts: Artifacts, stage: Stage, *, truth: NDArray[np.float64] | None = None, upto: int | None = None
) -> list[Path3D]:
    """The camera path of a sequence as it is drawn on a stage, over the true one."""
    frustum = _FRUSTUM * stage.extent
    eyes = artifacts.world_from_cam[:, :3, 3]
    length = float(np.linalg.norm(np.diff(eyes, axis=0), axis=1).sum())
    # As many as stand apart from each other.
    number = min(_MOST_FRUSTA, 2 + int(length / (3 * frustum)))
    drawn = [Path3D(artifacts.world_from_cam, artifacts.camera, frustum, num_frusta=number, upto=upto)]
    if truth is not None:
        white = (236, 240, 245)
        drawn.insert(0, Path3D(truth, artifacts.camera, 0.0, num_frusta=0, colour=white, width=2.2))
    return drawn


def tiles(frame: ArtifactFrame, colours: DepthColours, width: int = _TILE_PX) -> list[Canvas]:
    """A frame, its depth, and its confidence where there is one."""
    depth = colours.paint(frame.depth, kind=frame.kind, moving=frame.moving)
    pictures = [label(fitted(frame.rgb, width), f"frame {frame.index}"), label(fitted(depth, width), "depth")]
    if frame.confidence is not None:
        pictures.append(label(fitted(paint_confidence(frame.confidence), width), "confidence"))
    return pictures


def overview(frames: Sequence[ArtifactFrame], colours: DepthColours, cloud: Canvas) -> Canvas:
    """The first and the last of some frames over their depth, and a picture of the cloud at the same height."""
    ends = [tiles(frame, colours)[:2] for frame in (frames[0], frames[-1])]
    left = grid([list(pair) for pair in zip(*ends, strict=True)], _GAP)
    height = left.shape[0]
    right = fitted(cloud, round(cloud.shape[1] * height / cloud.shape[0]))
    canvas = np.empty((height + 2 * _MARGIN, left.shape[1] + _GAP + right.shape[1] + 2 * _MARGIN, 3), np.uint8)
    canvas[:] = BACKGROUND
    canvas[_MARGIN : _MARGIN + height, _MARGIN : _MARGIN + left.shape[1]] = left
    # Rounding may leave the cloud a row short or long.
    rows = min(height, right.shape[0])
    canvas[_MARGIN : _MARGIN + rows, _MARGIN + left.shape[1] + _GAP : -_MARGIN] = right[:rows]
    return canvas
