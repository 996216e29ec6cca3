"""Speed on a CPU: frames per second and CPU-seconds per frame of every stage, beside COLMAP on the same clip.

    python -m benchmarks.cpu_pipeline [SEQUENCE ...] [--every N] [--no-peer] [--cache FOLDER] [--threads N]

A sequence is the name of a sample, of a folder of the shared data, or a folder with pictures and gt.npz; the default is
a sample of the project's own. Ours is poses and intrinsics of every frame, without depth; decoder processes count.
COLMAP is pycolmap with SIFT, sequential matching, and both mappers; writing its images does not count. With the
default --every 1 both are given the same frames. The ratio is of CPU-seconds per posed frame.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table

from benchmarks.cpu_time import Measured, measure
from benchmarks.peers.colmap import ColmapRun, ColmapSettings, run_colmap
from benchmarks.sequences import DATA, BenchSequence, find_sequence
from vipe_core.cameras import Camera
from vipe_core.errors import VipeError
from vipe_core.evaluation.truth import Estimate, SequenceReport, evaluate, read_truth
from vipe_core.pipeline.annotator import Annotator
from vipe_core.pipeline.warmup import warm_up

_DEFAULT = ("room_tour",)


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("sequences", nargs="*", default=_DEFAULT, metavar="SEQUENCE")
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the shared data")
    parser.add_argument("--every", type=int, default=1, help="give COLMAP every n-th frame only")
    parser.add_argument("--no-peer", action="store_true", help="ours alone")
    parser.add_argument("--cache", type=Path, help="keep COLMAP's results in this folder, and take them from there")
    parser.add_argument("--threads", type=int, default=1, help="of either")
    arguments = parser.parse_args(argv)

    annotator = Annotator(threads=arguments.threads)
    with tempfile.TemporaryDirectory(prefix="vipe-warm-") as folder:
        warm_up(annotator, Path(folder))
    console, failed = Console(width=120), 0
    for name in arguments.sequences:
        try:
            sequence = find_sequence(name, arguments.data)
            ours = measure(annotator, sequence.video)
            peers = []
            if not arguments.no_peer:
                settings = ColmapSettings(every=arguments.every, threads=arguments.threads)
                peers = run_colmap(sequence.video, settings=settings, cache=arguments.cache)
            _print(console, sequence, ours, peers)
        except VipeError as error:
            failed += 1
            print(f"{name}: {error}", file=sys.stderr)
    return 1 if failed else 0


def _print(console: Console, sequence: BenchSequence, ours: Measured, peers: Sequence[ColmapRun]) -> None:
    camera, frames = ours.annotation.camera, ours.annotation.num_frames
    title = f"{sequence.name}: {frames} frames of {camera.width}x{camera.height}"
    stages = Table(title=f"{title}, by stage")
    for heading in ("stage", "CPU-s", "CPU-s/frame", "share"):
        stages.add_column(heading, justify="left" if heading == "stage" else "right")
    for stage, spent_s in ours.stage_cpu_s.items():
        stages.add_row(stage, f"{spent_s:.2f}", f"{spent_s / frames:.4f}", f"{spent_s / ours.cpu_s:.0%}")
    stages.add_row("all", f"{ours.cpu_s:.2f}", f"{ours.cpu_s_per_frame:.4f}", "", style="bold")
    console.print(stages)

    table = Table(title=f"{title}, poses and intrinsics")
    for heading in ("", "posed", "CPU-s", "per posed frame", "wall s", "frames/s", "ATE %", "FOV deg"):
        table.add_column(heading, justify="right" if heading else "left")
    annotation = ours.annotation
    report = _report(sequence, Estimate("ours", annotation.world_from_cam, range(frames), annotation.camera))
    table.add_row(
        "ours", f"{frames}/{frames}", *_costs(frames, ours.cpu_s, ours.wall_s), *_errors(report, annotation.camera)
    )
    for run in peers:
        posed = len(run.frame_index)
        cells = [f"{posed}/{run.num_frames}", *_costs(posed, run.cpu_s, run.wall_s)]
        found = None
        if run.camera is not None and posed > 1:
            estimate = Estimate(run.mapper, run.world_from_cam, run.frame_index, run.camera)
            found = _report(sequence, estimate)
        table.add_row(f"COLMAP {run.mapper}", *cells, *_errors(found, run.camera))
    console.print(table)
    rates = {run.mapper: run.cpu_s_per_posed_frame for run in peers}
    known = {mapper: rate for mapper, rate in rates.items() if rate is not None}
    if known:
        fastest = min(known, key=lambda mapper: known[mapper])
        ratio = known[fastest] / ours.cpu_s_per_frame
        console.print(f"{sequence.name}: CPU-seconds per posed frame, COLMAP {fastest} / ours: {ratio:.1f}\n")


def _report(sequence: BenchSequence, estimate: Estimate) -> SequenceReport:
    return evaluate(estimate, read_truth(sequence.truth))


def _costs(posed: int, cpu_s: float, wall_s: float) -> tuple[str, str, str, str]:
    return f"{cpu_s:.1f}", f"{cpu_s / posed:.3f}" if posed else "-", f"{wall_s:.1f}", f"{posed / wall_s:.2f}"


def _errors(report: SequenceReport | None, camera: Camera | None) -> tuple[str, str]:
    """ATE in percent of the path; the field of view and its error."""
    if report is None or camera is None:
        return "-", "-"
    ate = report.trajectory.ate_percent
    error = "" if report.camera is None else f" ({report.camera.fov_x_deg:.2f} off)"
    return "-" if ate is None else f"{ate:.3f}", f"{camera.fov_x_deg:.2f}{error}"


if __name__ == "__main__":
    raise SystemExit(main())
