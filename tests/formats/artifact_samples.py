"""Small annotations that the tests of the formats write and read back."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from vipe_core.annotation import MEASURED, UNOBSERVED, Annotation, DenseFrame, Provenance, Quality
from vipe_core.cameras import Camera

WIDTH, HEIGHT = 48, 32
CAMERAS = {
    "pinhole": Camera("pinhole", (40.5, 40.25, 24.0, 16.0), WIDTH, HEIGHT),
    "mei": Camera("mei", (40.5, 40.25, 24.0, 16.0, 0.75), WIDTH, HEIGHT),
    "equirect": Camera("equirect", (), WIDTH, HEIGHT),
}


def depth_of(index: int) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    depth = np.linspace(1, 3, WIDTH * HEIGHT, dtype=np.float32).reshape(HEIGHT, WIDTH) + index
    depth[:2, :3] = 0
    return depth


def make_annotation(
    model: str = "pinhole", num_frames: int = 7, name: str = "clip", dense_frames: int | None = None
) -> Annotation:
    def dense() -> Iterator[DenseFrame]:
        for index in range(num_frames if dense_frames is None else dense_frames):
            rgb = np.full((HEIGHT, WIDTH, 3), 20 + 10 * index, np.uint8)
            depth = depth_of(index)
            kind = np.where(depth > 0, MEASURED, UNOBSERVED).astype(np.uint8)
            yield DenseFrame(index, rgb, depth, (depth > 0).astype(np.float32), (depth > 1).astype(np.uint8), kind)

    angles = np.linspace(0, 0.5, num_frames)
    poses = np.tile(np.eye(4), (num_frames, 1, 1))
    poses[:, 0, 0] = poses[:, 2, 2] = np.cos(angles)
    poses[:, 0, 2] = np.sin(angles)
    poses[:, 2, 0] = -np.sin(angles)
    poses[:, :3, 3] = np.random.default_rng(0).normal(size=(num_frames, 3))
    quality = Quality(
        "doubtful", ("few_keyframes",), 0.5, 0.9, 0.8, 2.5, float("nan"), np.full(num_frames, 0.9, np.float32)
    )
    provenance = Provenance("0.1", "classical", "abc", "cpu", {"torch": "2"}, {"flow": "dis"}, {}, {"name": "clip.mp4"})
    return Annotation(
        name=name,
        world_from_cam=poses,
        camera=CAMERAS[model],
        timestamps_s=np.cumsum(np.linspace(0.03, 0.05, num_frames)),
        fps=30000 / 1001,
        keyframes=np.array([0, num_frames - 1], dtype=np.int64),
        scale="relative",
        depth_kind="ray" if model == "equirect" else "z",
        quality=quality,
        provenance=provenance,
        dense=dense,
        timings_s={"slam": 1.0},
    )
