"""What a rig makes of its views, against the best of them by itself: rendered recordings with exact truth.

    python -m benchmarks.rigs [CASE ...] [--frames N] [--draws N] [--json FILE]

`ring` is four cameras back to back that do not overlap, `stereo` two side by side, `bent` two fisheye lenses side by
side, and `straight` the ring on a path without a turn, which leaves extrinsics unobserved. Each is annotated view by
view (the best counts), as a rig with the extrinsics as they are, and with all extrinsics but the first turned by two
degrees about random axes: held as they were given, and refined, once per draw of the axes. Poses only. Rigs are given
their cameras. Errors of the scale are of the metres that the size of the rig tells; the sigma is that of the worst
extrinsic rotation.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from scipy.spatial.transform import Rotation

from benchmarks.processes import cpu_s
from vipe_core.annotation import Annotation, Quality, Reliability
from vipe_core.cameras import Camera
from vipe_core.cameras.calibration import Calibration
from vipe_core.cameras.rig import Rig, RigView, angle_between_deg
from vipe_core.evaluation.synthetic.clip import SyntheticClip, render_rig, sample_camera
from vipe_core.evaluation.synthetic.paths import handheld, look_at, through
from vipe_core.evaluation.synthetic.scenes import room_scene
from vipe_core.geometry import umeyama
from vipe_core.geometry.arrays import exp
from vipe_core.pipeline.rig_annotator import RigAnnotator
from vipe_core.video.source import Frame, FrameStream, VideoInfo

_WIDTH, _HEIGHT, _FPS = 256, 192, 24.0
_NOISE = 2.0
_WRONG_DEG = 2.0
CASES = ("ring", "stereo", "bent", "straight")


@dataclass(frozen=True, slots=True)
class RigRun:
    """One row.

    Attributes:
        ate_percent: Of the worst view of the run, of its path.
        scale_error_percent: None where the scale is relative.
        extrinsic_error_deg: Of the worst view; None without a rig.
        extrinsic_sigma_deg: As the result states it, of the worst view; None where extrinsics were not refined.
        verdict: Of the worst view, with its reasons.
    """

    case: str
    run: str
    ate_percent: float
    scale: str
    scale_error_percent: float | None
    extrinsic_error_deg: float | None
    extrinsic_sigma_deg: float | None
    verdict: str
    cpu_s_per_frame: float


class _InMemory:
    """A rendered clip as a video."""

    def __init__(self, name: str, clip: SyntheticClip) -> None:
        count, height, width = clip.rgb.shape[:3]
        self._rgb = clip.rgb
        self.info = VideoInfo(name, name, width, height, clip.fps, count, count / clip.fps, 0, "none", "rgb24", 0)

    def frames(self, size: tuple[int, int] | None = None, start: int = 0, stop: int | None = None) -> FrameStream:
        for index, rgb in list(enumerate(self._rgb))[start:stop]:
            picture = rgb if size is None else cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
            yield Frame(index, index / self.info.fps, np.asarray(picture, np.uint8))


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("cases", nargs="*", default=CASES, metavar="CASE", help=f"of {', '.join(CASES)}")
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--draws", type=int, default=3, help="of the axes that extrinsics are turned about")
    parser.add_argument("--json", type=Path, help="also write the figures to this file")
    arguments = parser.parse_args(argv)
    table = Table(title="Rigs")
    for column in ("case", "run"):
        table.add_column(column)
    for column in ("ATE %", "scale off %", "extrinsics off deg", "sigma deg", "CPU-s/frame"):
        table.add_column(column, justify="right")
    table.add_column("reliable")
    runs: list[RigRun] = []
    for case in arguments.cases:
        if case not in CASES:
            parser.error(f"unknown case {case!r}; known: {', '.join(CASES)}")
        for run in _runs(case, arguments.frames, arguments.draws):
            print(f"{run.case} {run.run}: ATE {run.ate_percent:.4f} %", file=sys.stderr, flush=True)
            table.add_row(
                run.case,
                run.run,
                f"{run.ate_percent:.3f}",
                "relative" if run.scale_error_percent is None else f"{run.scale_error_percent:.2f}",
                "" if run.extrinsic_error_deg is None else f"{run.extrinsic_error_deg:.3f}",
                "" if run.extrinsic_sigma_deg is None else f"{run.extrinsic_sigma_deg:.3f}",
                f"{run.cpu_s_per_frame:.2f}",
                run.verdict,
            )
            runs.append(run)
        table.add_section()
    Console(width=150).print(table)
    if arguments.json:
        arguments.json.write_text(json.dumps([asdict(run) for run in runs], indent=1) + "\n")
    return 0


def _runs(case: str, num_frames: int, draws: int) -> Iterator[RigRun]:
    mounts = _pair(0.12) if case in ("stereo", "bent") else _ring(4, 0.15)
    fov_deg = 70.0 if case == "stereo" else 80.0
    camera = Camera.pinhole_from_fov(fov_deg, _WIDTH, _HEIGHT)
    if case == "bent":
        camera = sample_camera("opencv_fisheye", _WIDTH, _HEIGHT)
    path = _straight(num_frames) if case == "straight" else _path(num_frames)
    clips = render_rig(room_scene(), [camera] * len(mounts), mounts, path, fps=_FPS, noise=_NOISE)
    known = Calibration(camera)
    rig = Rig(tuple(RigView(f"view{k}", mount, known) for k, mount in enumerate(mounts)), metric=True)
    sources = [_InMemory(view.name, clip) for view, clip in zip(rig.views, clips, strict=True)]
    annotator = RigAnnotator(threads=1)
    alone = [_alone(annotator, case, source, clip, known) for source, clip in zip(sources, clips, strict=True)]
    yield min(alone, key=lambda run: run.ate_percent)
    yield _together(annotator, case, "rig, extrinsics as they are", rig, mounts, sources, clips)
    for draw in range(draws):
        turned = [_turned(number, view, draw) for number, view in enumerate(rig.views)]
        for done, refine in (("held", False), ("refined", True)):
            name = f"{_WRONG_DEG:g} deg off, {done}, draw {draw}"
            wrong = replace(rig, views=tuple(turned), refine=refine)
            yield _together(annotator, case, name, wrong, mounts, sources, clips)


def _alone(annotator: RigAnnotator, case: str, source: _InMemory, clip: SyntheticClip, known: Calibration) -> RigRun:
    before = cpu_s()
    annotation = annotator.annotate(source, calibration=known if known.camera.distorted else None)
    per_frame = (cpu_s() - before) / annotation.num_frames
    name = f"best view alone ({source.info.name})"
    ate = _ate_percent(annotation, clip)[0]
    return RigRun(case, name, ate, annotation.scale, None, None, None, annotation.quality.reliable, per_frame)


def _together(
    annotator: RigAnnotator,
    case: str,
    name: str,
    rig: Rig,
    mounts: Sequence[NDArray[np.float64]],
    sources: Sequence[_InMemory],
    clips: Sequence[SyntheticClip],
) -> RigRun:
    before = cpu_s()
    found = annotator.annotate_rig(rig, sources)
    per_frame = (cpu_s() - before) / (len(clips) * found.views[0].num_frames)
    fits = [_ate_percent(view, clip) for view, clip in zip(found.views, clips, strict=True)]
    # The first view holds the gauge: errors are those of the others beside it.
    between = [np.linalg.inv(found.rig.views[0].rig_from_cam) @ view.rig_from_cam for view in found.rig.views]
    truth = [np.linalg.inv(mounts[0]) @ mount for mount in mounts]
    scale_error = abs(math.log(fits[0][1])) * 100 if found.views[0].scale == "metric" else None
    return RigRun(
        case,
        name,
        max(ate for ate, _ in fits),
        found.views[0].scale,
        scale_error,
        max(map(angle_between_deg, between, truth)),
        max((view.sigma.rotation_deg for view in found.rig.views if view.sigma), default=None),
        _worst([view.quality for view in found.views]),
        per_frame,
    )


def _ate_percent(annotation: Annotation, clip: SyntheticClip) -> tuple[float, float]:
    """RMS distance of the camera centres after the best similarity, of the path; and its scale."""
    actual, truth = annotation.world_from_cam[:, :3, 3], clip.world_from_cam[:, :3, 3]
    fit = umeyama(actual, truth)
    length = float(np.linalg.norm(np.diff(truth, axis=0), axis=1).sum())
    error = float(np.sqrt(np.square(fit.apply(actual) - truth).sum(axis=1).mean()))
    return 100 * error / length, fit.scale


def _path(num_frames: int) -> NDArray[np.float64]:
    """(N, 4, 4) world_from_rig: through the room, turning by 70 degrees, by hand."""
    eye = through([(2.0, 1.6, 1.3), (2.9, 1.5, 1.35), (3.9, 1.9, 1.25), (4.3, 2.7, 1.35)], num_frames)
    angle = np.radians(np.linspace(60, 130, num_frames))
    ahead = np.stack([np.cos(angle), np.sin(angle), np.full(num_frames, -0.1)], axis=-1)
    return handheld(look_at(eye, eye + ahead), shift_m=0.004, angle_deg=0.3, seed=1)


def _straight(num_frames: int) -> NDArray[np.float64]:
    """(N, 4, 4) world_from_rig: ahead on a line."""
    eye = np.linspace((1.5, 1.5, 1.3), (3.9, 2.3, 1.3), num_frames)
    return look_at(eye, eye + (eye[-1] - eye[0]))


def _worst(qualities: Sequence[Quality]) -> str:
    """The least reliable of the views, with everything that is said against any of them."""
    order: tuple[Reliability, ...] = ("no", "doubtful", "yes")
    reasons = sorted({reason for quality in qualities for reason in quality.reasons})
    return " ".join([min((quality.reliable for quality in qualities), key=order.index), *reasons])


def _ring(count: int, radius_m: float) -> list[NDArray[np.float64]]:
    """rig_from_cam of cameras around the vertical that look outwards."""
    mounts = []
    for view in range(count):
        mount = np.eye(4)
        mount[:3, :3] = Rotation.from_euler("y", 360 / count * view, degrees=True).as_matrix()
        mount[:3, 3] = radius_m * mount[:3, 2]
        mounts.append(mount)
    return mounts


def _pair(baseline_m: float) -> list[NDArray[np.float64]]:
    right = np.eye(4)
    right[0, 3] = baseline_m
    return [np.eye(4), right]


def _turned(number: int, view: RigView, draw: int) -> RigView:
    """The view with an error in its rotation, but the first."""
    if number == 0:
        return view
    axis = np.random.default_rng((draw, number)).normal(size=3)
    axis /= np.linalg.norm(axis)
    return replace(view, rig_from_cam=view.rig_from_cam @ exp(np.array([0, 0, 0, *(math.radians(_WRONG_DEG) * axis)])))


if __name__ == "__main__":
    sys.exit(main())
