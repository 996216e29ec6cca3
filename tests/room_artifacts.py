"""The exact room as an annotated sequence on disk, with a patch of picture that moves and whose depth is wrong."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from exact_room import POSES, depth_and_colour

from vipe_core.annotation import FILLED, MEASURED, MOVING, Annotation, DenseFrame, Provenance, Quality, Scale
from vipe_core.cameras import Camera
from vipe_core.evaluation.synthetic import sample_camera
from vipe_core.formats import Artifacts, read_artifacts, write_artifacts
from vipe_core.formats.artifacts import ALL_ATTRIBUTES, Attribute

CAMERAS = {
    "pinhole": Camera.pinhole_from_fov(70.0, 160, 120),
    "mei": Camera("mei", (95.0, 95.0, 80.0, 60.0, 0.7), 160, 120),
    "equirect": Camera("equirect", (), 240, 120),
    "opencv": sample_camera("opencv", 160, 120),
    "rational": Camera("opencv", (110.0, 110.0, 80.0, 60.0, 0.3, 0.05, 0, 0, 0, 0.45, 0.1, 0), 160, 120),
    "opencv_fisheye": sample_camera("opencv_fisheye", 160, 120),
}
MOVING_PATCH = (slice(30, 60), slice(20, 50))
FILLED_PATCH = (slice(90, 110), slice(60, 90))
FPS = 12.0


def write_room(
    root: Path,
    model: str = "pinhole",
    *,
    name: str = "room",
    scale: Scale = "metric",
    attributes: tuple[Attribute, ...] = ALL_ATTRIBUTES,
    measured: bool = True,
    cuts: tuple[int, ...] = (),
) -> Artifacts:
    """Write and read back. Without `measured` the camera stands still and all depth is filled in."""
    camera = CAMERAS[model]
    poses = np.stack(POSES if measured else [POSES[0]] * len(POSES))
    count = len(poses)

    def dense() -> Iterator[DenseFrame]:
        for index, pose in enumerate(poses):
            depth, rgb = depth_and_colour(camera, pose, "ray" if model == "equirect" else "z")
            confidence = np.full(depth.shape, 0.8, np.float32)
            kind = np.full(depth.shape, MEASURED, np.uint8)
            mask = np.zeros(depth.shape, np.uint8)
            depth[MOVING_PATCH], mask[MOVING_PATCH], kind[MOVING_PATCH] = 0.7, 1, MOVING
            depth[FILLED_PATCH], confidence[FILLED_PATCH], kind[FILLED_PATCH] = 0.5, 0, FILLED
            if not measured:
                confidence[:], kind[:] = 0, FILLED
            yield DenseFrame(index, rgb, depth, confidence, mask, kind)

    annotation = Annotation(
        name=name,
        world_from_cam=poses,
        camera=camera,
        timestamps_s=np.arange(count) / FPS,
        fps=FPS,
        keyframes=np.array([0, count - 1], np.int64),
        scale=scale,
        depth_kind="ray" if model == "equirect" else "z",
        quality=Quality("yes", (), 0.2, 0.9, 0.9, 5.0, 0.01, np.ones(count, np.float32), cuts=cuts),
        provenance=Provenance("0", "classical", "0", "cpu", {}, {}, {}, {}),
        dense=dense,
    )
    write_artifacts(annotation, root, attributes=attributes)
    return read_artifacts(root, name)
