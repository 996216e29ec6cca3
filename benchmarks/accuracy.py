"""Accuracy of finished annotations against ground truth, next to the trivial answer in the same table.

    python benchmarks/accuracy.py SEQ_DIR [SEQ_DIR ...] --artifacts ROOT

Each SEQ_DIR holds a gt.npz; the artifacts below ROOT (ViPE's layout) are found under the directory's name, or under
`video` when the video file was annotated under its own name and there is only one. The trivial answer is a camera that
never moves, a field of view of 60 degrees and the same depth everywhere; the last columns say how many times smaller
our errors are. Depth errors are of static pixels after one median scale.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table

from vipe_core.errors import VipeError
from vipe_core.evaluation.truth import SequenceReport, evaluate_artifacts, evaluate_static_guess, read_truth
from vipe_core.formats import list_sequences, read_artifacts


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("sequences", nargs="+", type=Path, metavar="SEQ_DIR")
    parser.add_argument("--artifacts", required=True, type=Path, metavar="ROOT")
    arguments = parser.parse_args(argv)

    table = Table(title="Accuracy against ground truth")
    headings = ("sequence", "frames", "ATE %", "RTE %", "RRE deg", "rot deg", "FOV deg", "AbsRel", "logRMSE", "d1.25")
    for heading in (*headings, "depth/pose", "x ATE", "x FOV", "x AbsRel"):
        table.add_column(heading, justify="left" if heading == "sequence" else "right")
    failed = 0
    for folder in arguments.sequences:
        name = folder.resolve().name
        try:
            truth = read_truth(folder / "gt.npz")
            ours = evaluate_artifacts(
                read_artifacts(arguments.artifacts, _stored_name(arguments.artifacts, name)), truth
            )
        except VipeError as error:
            failed += 1
            print(f"{name}: {error}", file=sys.stderr)
            continue
        trivial = evaluate_static_guess(truth)
        table.add_row(name, str(len(truth.world_from_cam)), *_cells(ours), *_ratios(ours, trivial))
        table.add_row("  trivial", "", *_cells(trivial), "", "", "", style="dim")
    Console(width=150).print(table)
    return 1 if failed else 0


def _stored_name(root: Path, name: str) -> str:
    known = list_sequences(root)
    return "video" if name not in known and known == ["video"] else name


def _number(value: float | None, digits: int = 2) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _cells(report: SequenceReport) -> list[str]:
    path, camera, depth = report.trajectory, report.camera, report.depth
    return [
        _number(path.ate_percent),
        _number(path.rte_percent),
        _number(path.rre_rmse_deg, 3),
        _number(path.rotation_rmse_deg),
        _number(camera.fov_x_deg if camera else None),
        _number(depth.abs_rel if depth else None, 3),
        _number(depth.log_rmse if depth else None, 3),
        _number(depth.delta125 if depth else None, 3),
        _number(report.depth_pose_ratio, 3),
    ]


def _ratios(ours: SequenceReport, trivial: SequenceReport) -> list[str]:
    def fov(report: SequenceReport) -> float | None:
        return report.camera.fov_x_deg if report.camera else None

    def abs_rel(report: SequenceReport) -> float | None:
        return report.depth.abs_rel if report.depth else None

    return [
        _times(ours.trajectory.ate_rmse, trivial.trajectory.ate_rmse),
        _times(fov(ours), fov(trivial)),
        _times(abs_rel(ours), abs_rel(trivial)),
    ]


def _times(ours: float | None, trivial: float | None) -> str:
    return "-" if not ours or trivial is None else f"{trivial / ours:.1f}"


if __name__ == "__main__":
    raise SystemExit(main())
