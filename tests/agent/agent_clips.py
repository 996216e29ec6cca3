"""Tiny real media for the agent's tests: one clip that works, and everything that users drop into the same folder."""

from __future__ import annotations

from pathlib import Path

import av
import cv2
import numpy as np

from vipe_core.video.encode import VideoWriter


def write_assorted_inputs(folder: Path) -> None:
    """`good` and `one-frame` are videos; `corrupt`, `empty`, `text` and `audio` only have the name of one."""
    folder.mkdir()
    write_pan(folder / "good.mp4", 16)
    write_pan(folder / "one-frame.mp4", 1)
    whole = (folder / "good.mp4").read_bytes()
    (folder / "corrupt.mp4").write_bytes(whole[: len(whole) // 3])
    (folder / "empty.mp4").write_bytes(b"")
    (folder / "text.mp4").write_text("a shopping list\n" * 40)
    _write_audio(folder / "audio.mp4")


def write_pan(path: Path, frames: int, width: int = 128, height: int = 96) -> None:
    """A camera that moves sideways past a textured wall in front of another one."""
    rng = np.random.default_rng(7)
    near, far = (_texture(rng, 3 * width, height) for _ in range(2))
    with VideoWriter(path, 10.0) as writer:
        for index in range(frames):
            picture = far[:, index : index + width].copy()
            picture[height // 2 :] = near[height // 2 :, 4 * index : 4 * index + width]
            writer.write(np.ascontiguousarray(picture))


def _texture(rng: np.random.Generator, width: int, height: int) -> np.ndarray:
    picture = np.zeros((height, width, 3), np.float32)
    for cells in (4, 12, 36):
        noise = rng.uniform(0, 80, (cells, 3 * cells, 3)).astype(np.float32)
        picture += cv2.resize(noise, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.clip(picture, 0, 255).astype(np.uint8)


def _write_audio(path: Path) -> None:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("aac", rate=16000)
        for start in range(0, 16000, 1024):
            samples = (0.2 * np.sin(np.arange(start, start + 1024) * 0.1)).astype(np.float32)[None]
            frame = av.AudioFrame.from_ndarray(samples, format="fltp", layout="mono")
            frame.sample_rate, frame.pts = 16000, start
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
