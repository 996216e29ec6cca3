"""What each choice of camera makes of a video whose lens is bent, and of one whose lens is not.

    python -m benchmarks.cameras [SEQUENCE ...] [--cameras NAME ...] [--json FILE] [--predictions FOLDER]

A sequence is the name of a sample, of a folder of the shared data, or a folder with gt.npz and pictures. Poses and
intrinsics only. The first camera is the baseline: the columns `x` say how many times larger its errors are.

Panoramas have a table of their own, with the distances of every frame: their mean relative error on the pixels with a
true distance, after one scale for the video, of all of them and of those that are measured (not filled in), with the
share that is. CPU-seconds are of poses and distances. With --predictions they are written as files for
`shared/bench/score.py` too.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from benchmarks.cpu_time import measure
from benchmarks.processes import cpu_s
from benchmarks.sequences import DATA, find_sequence
from vipe_core.annotation import MEASURED
from vipe_core.evaluation.truth import Estimate, SequenceReport, evaluate, read_truth
from vipe_core.formats.scorer_npz import reduce_depth
from vipe_core.pipeline.annotator import Annotator
from vipe_core.pipeline.presets import CAMERAS

_SEQUENCES = ("wide_angle", "room_handheld", "pano_walk", "erp_cern")
_FLAT = tuple(camera for camera in CAMERAS if camera != "equirect")
# Every so many pixels of a distance map go into the file for the scorer.
_SCORED_STEP = 4


@dataclass(frozen=True, slots=True)
class CameraRun:
    """What one choice of camera came to.

    Attributes:
        asked: The choice.
        model: What was taken.
        alpha: Bend of the lens; None for a pinhole.
    """

    sequence: str
    asked: str
    model: str
    alpha: float | None
    ate_percent: float | None
    fov_error_deg: float | None
    verdict: str
    cpu_s_per_frame: float


@dataclass(frozen=True, slots=True)
class PanoramaRun:
    """What a panorama came to.

    Attributes:
        size: (width, height) of the pictures.
        rotation_deg: RMS error of the rotations after the best constant one.
        abs_rel: Mean relative error of the distances where the truth has one; None where there is no truth.
        measured: Share of the pixels with a true distance (of all, without one) where it is measured, not filled in.
        measured_abs_rel: `abs_rel` on these.
        density: Share of the pixels with a true distance that have an estimate.
    """

    sequence: str
    size: tuple[int, int]
    ate_percent: float | None
    rotation_deg: float | None
    abs_rel: float | None
    measured: float
    measured_abs_rel: float | None
    density: float | None
    verdict: str
    cpu_s_per_frame: float


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("sequences", nargs="*", default=_SEQUENCES, metavar="SEQUENCE")
    parser.add_argument("--cameras", nargs="+", default=_FLAT, choices=_FLAT, metavar="NAME")
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the shared data")
    parser.add_argument("--json", type=Path, help="also write the figures to this file")
    parser.add_argument("--predictions", type=Path, metavar="FOLDER", help="also write what score.py reads")
    arguments = parser.parse_args(argv)

    round_about = [name for name in arguments.sequences if _is_panorama(name, arguments.data)]
    flat = [name for name in arguments.sequences if name not in round_about]
    runs: list[CameraRun | PanoramaRun] = []
    if flat:
        runs += _compared(flat, arguments.cameras, arguments.data)
    if round_about:
        runs += _panoramas(round_about, arguments.data, arguments.predictions)
    if arguments.json:
        arguments.json.write_text(json.dumps([asdict(run) for run in runs], indent=1) + "\n")
    return 0


def _compared(names: Sequence[str], cameras: Sequence[str], data: Path) -> list[CameraRun]:
    """Every choice of camera for every sequence, as a table."""
    table = Table(title="Choices of camera")
    table.add_column("sequence")
    table.add_column("camera")
    table.add_column("taken")
    for column in ("alpha", "ATE %", "x", "FOV off deg", "x", "CPU-s/frame"):
        table.add_column(column, justify="right")
    table.add_column("reliable")
    runs: list[CameraRun] = []
    for name in names:
        found = [_run(name, camera, data) for camera in cameras]
        for run in found:
            table.add_row(
                run.sequence if run is found[0] else "",
                run.asked,
                run.model,
                "" if run.alpha is None else f"{run.alpha:.2f}",
                _number(run.ate_percent),
                _ratio(found[0].ate_percent, run.ate_percent),
                _number(run.fov_error_deg),
                _ratio(found[0].fov_error_deg, run.fov_error_deg),
                f"{run.cpu_s_per_frame:.2f}",
                run.verdict,
            )
        table.add_section()
        runs.extend(found)
    Console(width=110).print(table)
    return runs


def _panoramas(names: Sequence[str], data: Path, predictions: Path | None) -> list[PanoramaRun]:
    """Poses and distances of panoramas, as a table."""
    table = Table(title="Panoramas")
    table.add_column("sequence")
    table.add_column("pixels")
    for column in ("ATE %", "rotation deg", "AbsRel", "measured", "its AbsRel", "density", "CPU-s/frame"):
        table.add_column(column, justify="right")
    table.add_column("reliable")
    runs = [_panorama(name, data, predictions) for name in names]
    for run in runs:
        table.add_row(
            run.sequence,
            f"{run.size[0]}x{run.size[1]}",
            _number(run.ate_percent),
            _number(run.rotation_deg),
            _number(run.abs_rel),
            f"{run.measured:.3f}",
            _number(run.measured_abs_rel),
            _number(run.density),
            f"{run.cpu_s_per_frame:.2f}",
            run.verdict,
        )
    Console(width=110).print(table)
    return runs


def _is_panorama(name: str, data: Path) -> bool:
    camera = read_truth(find_sequence(name, data).truth).camera
    return camera is not None and camera.model == "equirect"


def _panorama(name: str, data: Path, predictions: Path | None) -> PanoramaRun:
    sequence = find_sequence(name, data)
    truth = read_truth(sequence.truth)
    annotator = Annotator("panorama", threads=1)
    before_s = cpu_s()
    annotation = annotator.annotate(sequence.video)
    depth: list[NDArray[np.float32]] = []
    kinds: list[NDArray[np.bool_]] = []
    with closing(annotation.dense()) as frames:
        for frame in frames:
            depth.append(reduce_depth(frame.depth, _SCORED_STEP))
            share = cv2.resize((frame.kind == MEASURED).astype(np.float32), depth[-1].shape[::-1])
            kinds.append(np.asarray(share > 0.5))
    spent_s = cpu_s() - before_s
    index = np.arange(annotation.num_frames)
    poses, camera = annotation.world_from_cam, annotation.camera

    def report(maps: list[NDArray[np.float32]] | None) -> SequenceReport:
        return evaluate(Estimate(sequence.name, poses, index, camera, maps, annotation.depth_kind), truth)

    everywhere = report(depth)
    measured = report([np.where(kind, values, 0) for kind, values in zip(kinds, depth, strict=True)])
    if predictions is not None:
        predictions.mkdir(parents=True, exist_ok=True)
        np.savez_compressed(
            predictions / f"{sequence.name}.npz",
            cam_to_world=poses,
            intrinsics=np.zeros(4),
            camera=np.array("equirect"),
            depth=np.stack(depth).astype(np.float16),
            depth_kind=np.array(annotation.depth_kind),
        )
    return PanoramaRun(
        sequence=sequence.name,
        size=(camera.width, camera.height),
        ate_percent=everywhere.trajectory.ate_percent,
        rotation_deg=everywhere.trajectory.rotation_rmse_deg,
        abs_rel=None if everywhere.depth is None else everywhere.depth.abs_rel,
        measured=float(np.mean(kinds)) if measured.depth is None else measured.depth.density,
        measured_abs_rel=None if measured.depth is None else measured.depth.abs_rel,
        density=None if everywhere.depth is None else everywhere.depth.density,
        verdict=annotation.quality.reliable,
        cpu_s_per_frame=spent_s / annotation.num_frames,
    )


def _run(name: str, camera: str, data: Path) -> CameraRun:
    sequence = find_sequence(name, data)
    measured = measure(Annotator(camera=camera, threads=1), sequence.video)
    annotation = measured.annotation
    index = np.arange(annotation.num_frames)
    estimate = Estimate(sequence.name, annotation.world_from_cam, index, annotation.camera)
    report = evaluate(estimate, read_truth(sequence.truth))
    print(f"{sequence.name} {camera}: ATE {report.trajectory.ate_percent} %", file=sys.stderr, flush=True)
    return CameraRun(
        sequence=sequence.name,
        asked=camera,
        model=annotation.camera.model,
        alpha=annotation.camera.params[4] if annotation.camera.model == "mei" else None,
        ate_percent=report.trajectory.ate_percent,
        fov_error_deg=None if report.camera is None else report.camera.fov_x_deg,
        verdict=annotation.quality.reliable,
        cpu_s_per_frame=measured.cpu_s_per_frame,
    )


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.3f}"


def _ratio(baseline: float | None, value: float | None) -> str:
    return "" if baseline is None or value is None or not value > 0 else f"{baseline / value:.1f}"


if __name__ == "__main__":
    sys.exit(main())
