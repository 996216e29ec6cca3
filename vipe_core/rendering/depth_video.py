"""The depth of a sequence as a video."""

from __future__ import annotations

from contextlib import ExitStack, closing
from pathlib import Path

import numpy as np

from vipe_core.formats.frames import read_frames
from vipe_core.formats.reading import Artifacts
from vipe_core.rendering.depth_colours import DepthColours
from vipe_core.video.encode import VideoWriter


def export_depth_video(artifacts: Artifacts, out: str | Path, *, beside_rgb: bool = False) -> Path:
    """Write an H.264 mp4 at the frame rate of the sequence, coloured by the `DepthColours` of the whole clip.

    Args:
        out: File to write, ending in `.mp4`.
        beside_rgb: Put the frames to the left.

    Raises:
        FormatError: No depth or no rgb.
        ValueError: Another suffix.
    """
    out = Path(out)
    if out.suffix != ".mp4":
        raise ValueError(f"a depth video is an .mp4, got {out.name}")
    out.parent.mkdir(parents=True, exist_ok=True)
    colours = DepthColours.of(artifacts)
    with ExitStack() as stack:
        frames = stack.enter_context(closing(read_frames(artifacts)))
        aspect = artifacts.camera.pixel_aspect
        writer = stack.enter_context(VideoWriter(out, frame_rate(artifacts), pixel_aspect=aspect))
        for frame in frames:
            painted = colours.paint(frame.depth, kind=frame.kind, moving=frame.moving)
            writer.write(np.hstack([frame.rgb, painted]) if beside_rgb else painted)
    return out


def frame_rate(artifacts: Artifacts) -> float:
    """Frames per second of the sequence; 24 where nothing says."""
    fps = artifacts.info.get("fps")
    return float(fps) if isinstance(fps, (int, float)) and fps > 0 else 24.0
