"""What knowing the camera is worth: clips of odd lenses, rendered with exact truth, with and without a calibration.

    python -m benchmarks.known_cameras [LENS ...] [--frames N] [--json FILE]

Each lens is run as the engine estimates it, with its true calibration held, and with one that is 2 % off in focal
length as a starting point. Depth is judged on every tenth frame, in the pixels of the clip, at the scale of the poses.
`unchanged` says whether a held calibration came back to the last bit, from the annotation and from the artifacts.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from vipe_core.annotation import Annotation, depth_kind_of
from vipe_core.cameras import Camera
from vipe_core.cameras.calibration import Calibration
from vipe_core.evaluation.metrics import convert_depth, trajectory_errors
from vipe_core.evaluation.synthetic import SyntheticClip, render_clip, room_scene, sample_camera
from vipe_core.evaluation.synthetic.paths import arc, handheld, look_at
from vipe_core.formats import read_artifacts, write_artifacts
from vipe_core.pipeline.annotator import Annotator

_WIDTH, _HEIGHT = 320, 240
_DEPTH_STEP = 10


def _lenses() -> dict[str, Camera]:
    width, height = _WIDTH, _HEIGHT
    return {
        "off_centre": Camera("pinhole", (0.9 * width, 0.9 * width, 0.58 * width, 0.58 * height), width, height),
        "oblong_pixels": Camera("pinhole", (0.8 * width, 0.96 * width, 0.53 * width, 0.48 * height), width, height),
        "wide_mei": Camera("mei", (0.7 * width, 0.7 * width, 0.46 * width, 0.55 * height, 0.66), width, height),
        "barrel": sample_camera("opencv", width, height),
        "fisheye": sample_camera("opencv_fisheye", width, height),
    }


@dataclass(frozen=True, slots=True)
class Known:
    """What one run came to.

    Attributes:
        use: `estimated`, `fixed` or `initial`.
        unchanged: Of `fixed`.
    """

    lens: str
    use: str
    model: str
    ate_percent: float
    rotation_deg: float
    residual_px: float
    fov_error_deg: float
    depth_percent: float
    unchanged: bool | None
    verdict: str


def main(argv: Sequence[str] | None = None) -> int:
    lenses = _lenses()
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("lenses", nargs="*", default=tuple(lenses), metavar="LENS", help=", ".join(lenses))
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--json", type=Path, help="also write the figures to this file")
    arguments = parser.parse_args(argv)
    if unknown := sorted(set(arguments.lenses) - set(lenses)):
        parser.error(f"no such lens: {', '.join(unknown)}; there are {', '.join(lenses)}")

    table = Table(title="Known cameras")
    for column in ("lens", "camera", "taken"):
        table.add_column(column)
    for column in ("ATE %", "rotation deg", "residual px", "FOV off deg", "depth off %"):
        table.add_column(column, justify="right")
    table.add_column("unchanged")
    table.add_column("reliable")
    runs: list[Known] = []
    for name in arguments.lenses:
        found = _runs(name, lenses[name], arguments.frames)
        for run in found:
            figures = (run.ate_percent, run.rotation_deg, run.residual_px, run.fov_error_deg, run.depth_percent)
            unchanged = "" if run.unchanged is None else "yes" if run.unchanged else "NO"
            shown = [f"{figure:.3f}" for figure in figures]
            table.add_row(run.lens if run is found[0] else "", run.use, run.model, *shown, unchanged, run.verdict)
        table.add_section()
        runs.extend(found)
    Console(width=120).print(table)
    if arguments.json:
        arguments.json.write_text(json.dumps([asdict(run) for run in runs], indent=1) + "\n")
    return 0


def _runs(name: str, camera: Camera, num_frames: int) -> list[Known]:
    # Around the table and back up from it: turning is what a wrong principal point bends.
    eye = arc((3.0, 2.5, 1.45), 1.9, -80.0, -25.0, num_frames)
    eye[:, 2] += np.linspace(-0.25, 0.25, num_frames)
    poses = handheld(look_at(eye, np.array([3.0, 2.5, 0.8])), shift_m=0.004, angle_deg=0.3)
    clip = render_clip(room_scene(), camera, poses, noise=2.0)
    off = Calibration(camera.zoomed(1.02), "initial")
    with tempfile.TemporaryDirectory(prefix="vipe-known-") as scratch:
        video = Path(scratch) / name
        video.mkdir()
        for index, rgb in enumerate(clip.rgb):
            cv2.imwrite(str(video / f"{index:04d}.png"), cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))
        return [
            _run(clip, name, video, Path(scratch) / use, use, known)
            for use, known in (("estimated", None), ("fixed", Calibration(camera)), ("initial", off))
        ]


def _run(clip: SyntheticClip, name: str, video: Path, out: Path, use: str, known: Calibration | None) -> Known:
    annotator = Annotator("classical_fast", None if known is not None or clip.camera.fov_x_deg < 90 else "auto")
    annotation = annotator.annotate(video, calibration=known)
    errors = trajectory_errors(annotation.world_from_cam, clip.world_from_cam)
    depth_percent = _depth_percent(annotation, clip, errors.scale or 1.0)
    unchanged = None
    if use == "fixed":
        write_artifacts(annotation, out, attributes=("pose", "intrinsics"))
        unchanged = annotation.camera == clip.camera == read_artifacts(out, annotation.name).camera
    print(f"{name} {use}: ATE {errors.ate_percent} %", file=sys.stderr, flush=True)
    return Known(
        lens=name,
        use=use,
        model=annotation.camera.model,
        ate_percent=errors.ate_percent or float("nan"),
        rotation_deg=errors.rotation_rmse_deg,
        residual_px=annotation.quality.residual_px,
        fov_error_deg=abs(annotation.camera.fov_x_deg - clip.camera.fov_x_deg),
        depth_percent=depth_percent,
        unchanged=unchanged,
        verdict=annotation.quality.reliable,
    )


def _depth_percent(annotation: Annotation, clip: SyntheticClip, scale: float) -> float:
    """Median relative error of depth, percent."""
    kind = depth_kind_of(clip.camera)
    errors: list[NDArray[np.float32]] = []
    with closing(annotation.dense()) as frames:
        for frame in frames:
            if frame.index % _DEPTH_STEP == 0:
                truth = convert_depth(clip.depth[frame.index], clip.camera, kind, annotation.depth_kind)
                there = (truth > 0) & (frame.depth > 0)
                errors.append(np.abs(scale * frame.depth[there] / truth[there] - 1))
    return 100 * float(np.median(np.concatenate(errors)))


if __name__ == "__main__":
    sys.exit(main())
