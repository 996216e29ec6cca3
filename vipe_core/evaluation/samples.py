"""Named sample videos with exact truth, rendered on demand and cached.

    python -m vipe_core.evaluation.samples OUT_DIR [NAME ...]

writes `OUT_DIR/NAME/video.mp4` (H.264) and `OUT_DIR/NAME/gt.npz`. The keys of gt.npz: `cam_to_world` (N, 4, 4) float64,
OpenCV axes, metres; `intrinsics` (fx, fy, cx, cy [, alpha]; four zeros for equirect) with half-pixel centres; `camera`;
`depth` (N, H/4, W/4) float16, 0 is sky; `depth_kind` z or ray; `dynamic` (N, H/4, W/4) bool; `fps`, `width`, `height`.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vipe_core.annotation import depth_kind_of
from vipe_core.cameras import Camera
from vipe_core.errors import ConfigError
from vipe_core.evaluation import synthetic
from vipe_core.evaluation.synthetic.crowd import CROWD_FPS, crowd
from vipe_core.evaluation.synthetic.paths import arc, handheld, look_at, through
from vipe_core.evaluation.synthetic.render import render_frames
from vipe_core.evaluation.synthetic.scene import Scene
from vipe_core.evaluation.synthetic.scenes import courtyard_scene, moving_ball_scene, room_scene
from vipe_core.video.encode import VideoWriter

_DEPTH_STEP = 4


@dataclass(frozen=True, slots=True)
class SamplePaths:
    """Where the files of a sample are: its H.264 `video` and the `truth` (gt.npz)."""

    video: Path
    truth: Path


@dataclass(frozen=True, slots=True)
class Sample:
    """Everything that determines a sample video.

    Attributes:
        world_from_cam: (N, 4, 4) poses, OpenCV axes, metres.
        noise: Sensor noise in 8-bit steps.
    """

    scene: Scene
    camera: Camera
    world_from_cam: NDArray[np.float64]
    fps: float = 24.0
    noise: float = 1.0
    seed: int = 0

    def digest(self) -> str:
        """Identifies the rendered bytes: the parameters, and the source text of the renderer itself."""
        digest = hashlib.sha256()
        sources = [Path(__file__), *sorted(Path(synthetic.__file__).parent.glob("*.py"))]
        for source in sources:
            digest.update(source.read_bytes())
        digest.update(repr((self.scene, self.camera, self.fps, self.noise, self.seed)).encode())
        digest.update(np.ascontiguousarray(self.world_from_cam).tobytes())
        return digest.hexdigest()[:16]


def _room_tour() -> Sample:
    """Handheld walk through the room: from the window past the table towards the bookcase, then round to the sofa."""
    n = 60
    eye = through([(4.9, 0.85, 1.50), (3.9, 0.95, 1.42), (2.6, 1.0, 1.36), (1.75, 1.45, 1.40), (1.6, 2.0, 1.46)], n)
    target = through([(2.3, 3.4, 0.85), (2.6, 3.6, 0.82), (3.2, 3.8, 0.85), (3.7, 3.7, 0.85), (4.1, 3.4, 0.80)], n)
    poses = handheld(look_at(eye, target), shift_m=0.008, angle_deg=0.5, seed=3)
    return Sample(room_scene(), Camera.pinhole_from_fov(60.0, 480, 360), poses, seed=1)


def _courtyard() -> Sample:
    """Down the street and sideways round the fountain's stone, at walking height."""
    n = 60
    eye = through([(-0.3, -4.0, 1.65), (-0.1, -1.2, 1.70), (0.2, 1.6, 1.66), (-0.5, 4.2, 1.72), (-1.5, 6.0, 1.66)], n)
    target = through([(0.3, 12.0, 1.9), (0.2, 13.0, 1.9), (0.8, 14.0, 1.8), (1.4, 15.0, 1.8), (2.2, 15.5, 1.9)], n)
    poses = handheld(look_at(eye, target), shift_m=0.012, angle_deg=0.4, seed=5)
    return Sample(courtyard_scene(), Camera.pinhole_from_fov(50.0, 480, 270), poses, seed=2)


def _moving_ball() -> Sample:
    """An arc round the table while a ball swings through the picture and a parcel slides along the wall."""
    n = 60
    poses = look_at(arc((3.0, 2.5, 1.40), 2.35, -100.0, -52.0, n), np.array([3.05, 2.7, 0.85]))
    poses = handheld(poses, shift_m=0.006, angle_deg=0.35, seed=7)
    return Sample(moving_ball_scene(), Camera.pinhole_from_fov(65.0, 480, 360), poses, seed=3)


def _wide_room() -> Sample:
    """The room through a wide-angle lens (unified model)."""
    n = 48
    eye = through([(4.6, 0.9, 1.4), (3.4, 1.0, 1.35), (2.2, 1.1, 1.4), (1.7, 1.7, 1.5)], n)
    target = through([(2.4, 3.6, 1.0), (3.0, 3.8, 1.0), (3.6, 3.9, 1.0)], n)
    poses = handheld(look_at(eye, target), shift_m=0.006, angle_deg=0.4, seed=9)
    return Sample(room_scene(), Camera("mei", (330.0, 330.0, 240.0, 180.0, 0.66), 480, 360), poses, seed=4)


def _pano_room() -> Sample:
    """The room as a panorama from a camera carried through it."""
    n = 48
    eye = through([(4.4, 1.1, 1.5), (3.2, 1.15, 1.45), (1.9, 1.4, 1.5), (1.5, 2.2, 1.55)], n)
    target = eye + through([(0.0, 1.0, 0.0), (0.15, 1.0, 0.02), (0.4, 1.0, -0.02)], n)
    poses = handheld(look_at(eye, target), shift_m=0.006, angle_deg=0.4, seed=11)
    return Sample(room_scene(), Camera("equirect", (), 768, 384), poses, seed=5)


def _crowd(seed: int) -> Sample:
    """People who cover 20 to 40 % of the picture, in a place and seen along a path that the seed draws."""
    drawn = crowd(seed)
    return Sample(drawn.scene, drawn.camera, drawn.world_from_cam, fps=CROWD_FPS, noise=1.5, seed=seed)


_CROWD_SEEDS = range(5)
_BUILDERS: dict[str, Callable[[], Sample]] = {
    "room_tour": _room_tour,
    "courtyard": _courtyard,
    "moving_ball": _moving_ball,
    "wide_room": _wide_room,
    "pano_room": _pano_room,
    **{f"crowd_{seed}": partial(_crowd, seed) for seed in _CROWD_SEEDS},
}
SAMPLE_NAMES: tuple[str, ...] = tuple(_BUILDERS)
DEMO_NAMES: tuple[str, ...] = ("room_tour", "courtyard", "moving_ball")


def sample(name: str, num_frames: int | None = None) -> Sample:
    """The definition of a named sample, optionally only its first `num_frames` frames.

    Raises:
        ConfigError: Unknown name.
    """
    builder = _BUILDERS.get(name)
    if builder is None:
        raise ConfigError(f"unknown sample {name!r}; known: {', '.join(SAMPLE_NAMES)}")
    whole = builder()
    return whole if num_frames is None else replace(whole, world_from_cam=whole.world_from_cam[:num_frames])


def write_sample(name: str, folder: str | Path, num_frames: int | None = None) -> SamplePaths:
    """Renders a sample into `folder` as video.mp4 and gt.npz; frames are streamed, never all in memory.

    Raises:
        ConfigError: Unknown name.
    """
    chosen = sample(name, num_frames)
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    paths = SamplePaths(folder / "video.mp4", folder / "gt.npz")
    camera = chosen.camera
    depth, dynamic = [], []
    frames = render_frames(
        chosen.scene, camera, chosen.world_from_cam, fps=chosen.fps, noise=chosen.noise, seed=chosen.seed
    )
    with VideoWriter(paths.video, chosen.fps) as writer:
        for frame in frames:
            writer.write(frame.rgb)
            depth.append(_quarter_depth(frame.depth))
            dynamic.append(_blocks(frame.dynamic).mean(axis=(1, 3)) >= 0.5)
    np.savez_compressed(
        paths.truth,
        cam_to_world=chosen.world_from_cam,
        intrinsics=np.array(camera.params if camera.params else (0.0, 0.0, 0.0, 0.0)),
        camera=np.array(camera.model),
        depth=np.stack(depth),
        depth_kind=np.array(depth_kind_of(camera)),
        dynamic=np.stack(dynamic),
        fps=np.array(chosen.fps),
        width=np.array(camera.width),
        height=np.array(camera.height),
    )
    return paths


def default_cache_dir() -> Path:
    """`$XDG_CACHE_HOME/vipe_core/samples` where that is set, else `.cache/samples` in the working directory."""
    base = os.environ.get("XDG_CACHE_HOME")
    return Path(base) / "vipe_core" / "samples" if base else Path(".cache") / "samples"


def sample_path(name: str, cache_dir: str | Path | None = None, num_frames: int | None = None) -> SamplePaths:
    """The cached files of a sample, rendered at the first call.

    The folder's name holds a digest of the parameters and of the renderer's source, so a stale file is never used; it
    appears by a rename, so two processes that render the same sample at once do no harm.

    Raises:
        ConfigError: Unknown name.
    """
    cache = Path(cache_dir) if cache_dir is not None else default_cache_dir()
    folder = cache / f"{name}-{sample(name, num_frames).digest()}"
    if not folder.is_dir():
        cache.mkdir(parents=True, exist_ok=True)
        work = Path(tempfile.mkdtemp(prefix=f".{name}-", dir=cache))
        try:
            write_sample(name, work, num_frames)
            try:
                work.rename(folder)
            except OSError:
                # Another process was faster; its files are the same.
                if not folder.is_dir():
                    raise
        finally:
            shutil.rmtree(work, ignore_errors=True)
    return SamplePaths(folder / "video.mp4", folder / "gt.npz")


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m vipe_core.evaluation.samples", description="Render sample videos.")
    parser.add_argument("out_dir", type=Path)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(SAMPLE_NAMES)}; default: all")
    arguments = parser.parse_args(argv)
    unknown = set(arguments.names) - set(SAMPLE_NAMES)
    if unknown:
        parser.error(f"unknown sample {sorted(unknown)[0]!r}; known: {', '.join(SAMPLE_NAMES)}")
    for name in arguments.names or SAMPLE_NAMES:
        paths = write_sample(name, arguments.out_dir / name)
        sys.stdout.write(f"{paths.video}\n{paths.truth}\n")
    return 0


def _blocks(image: NDArray[np.generic]) -> NDArray[np.generic]:
    """(H, W) -> (H/4, 4, W/4, 4); rows and columns that do not fill a block are dropped."""
    rows, columns = image.shape[0] // _DEPTH_STEP, image.shape[1] // _DEPTH_STEP
    whole = image[: rows * _DEPTH_STEP, : columns * _DEPTH_STEP]
    return whole.reshape(rows, _DEPTH_STEP, columns, _DEPTH_STEP)


def _quarter_depth(depth: NDArray[np.float32]) -> NDArray[np.float16]:
    """Depth at the centres of 4x4 blocks.

    The centre lies between four pixels. Their mean in inverse depth (which is linear on a plane) is exact on planes;
    where they straddle an edge, one of them is taken instead, so that no surface is invented between two others.
    """
    half = _DEPTH_STEP // 2
    four = _blocks(depth)[:, half - 1 : half + 1, :, half - 1 : half + 1].transpose(0, 2, 1, 3).reshape(-1, 4)
    low, high = four.min(axis=1), four.max(axis=1)
    smooth = (low > 0) & (high < 1.05 * low)
    mean = 4.0 / (1.0 / np.maximum(four, 1e-6)).sum(axis=1)
    rows, columns = depth.shape[0] // _DEPTH_STEP, depth.shape[1] // _DEPTH_STEP
    return np.where(smooth, mean, four[:, 3]).astype(np.float16).reshape(rows, columns)


if __name__ == "__main__":
    raise SystemExit(main())
