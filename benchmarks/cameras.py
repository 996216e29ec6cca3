"""What each choice of camera makes of a video whose lens is bent, and of one whose lens is not.

    python -m benchmarks.cameras [SEQUENCE ...] [--cameras NAME ...] [--json FILE]

A sequence is the name of a sample, of a folder of the shared data, or a folder with gt.npz and pictures. Poses and
intrinsics only. The first camera is the baseline: the columns `x` say how many times larger its errors are.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.cpu_time import measure
from benchmarks.sequences import DATA, find_sequence
from vipe_core.evaluation.truth import Estimate, evaluate, read_truth
from vipe_core.pipeline.annotator import Annotator
from vipe_core.pipeline.presets import CAMERAS

_SEQUENCES = ("wide_angle", "room_handheld")


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


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("sequences", nargs="*", default=_SEQUENCES, metavar="SEQUENCE")
    parser.add_argument("--cameras", nargs="+", default=CAMERAS, choices=CAMERAS, metavar="NAME")
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the shared data")
    parser.add_argument("--json", type=Path, help="also write the figures to this file")
    arguments = parser.parse_args(argv)

    table = Table(title="Choices of camera")
    table.add_column("sequence")
    table.add_column("camera")
    table.add_column("taken")
    for column in ("alpha", "ATE %", "x", "FOV off deg", "x", "CPU-s/frame"):
        table.add_column(column, justify="right")
    table.add_column("reliable")
    runs: list[CameraRun] = []
    for name in arguments.sequences:
        found = [_run(name, camera, arguments.data) for camera in arguments.cameras]
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
    if arguments.json:
        arguments.json.write_text(json.dumps([asdict(run) for run in runs], indent=1) + "\n")
    return 0


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
