"""Accuracy against ground truth, beside the trivial answer and COLMAP, with what is asked of each sequence.

    python -m benchmarks.accuracy [SEQUENCE ...] [--peers [--cache FOLDER]] [--artifacts ROOT] [--json FILE]

A sequence is the name of a sample, of a folder of the shared data, or a folder with gt.npz and pictures; the default is
every sequence that something is asked of. Ours is made anew (poses and intrinsics), or read from the artifacts below
ROOT (ViPE's layout, under the sequence's name or that of its pictures), with depth then. The trivial answer is a camera
that never moves, a field of view of 60 degrees and the same depth everywhere; for artifacts the `x` columns say how
many times smaller our errors are. With --peers, COLMAP gets the same frames of the sequences that are measured against
it, and its better mapper is shown; --cache keeps its results. Our field of view comes with its 95 % interval, marked
with a `!` where the truth is outside. Depth errors are of static pixels after one median scale; the IoU of the masks is
of all moving pixels, where the truth has any.
The status is 1 when something that is asked is not met.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from benchmarks.cpu_time import measure
from benchmarks.peers.colmap import ColmapRun, ColmapSettings, run_colmap
from benchmarks.sequences import DATA, SUITE, BenchSequence, Limit, find_sequence
from vipe_core.cameras import Camera
from vipe_core.errors import VipeError
from vipe_core.evaluation.truth import (
    Estimate,
    GroundTruth,
    SequenceReport,
    evaluate,
    evaluate_artifacts,
    evaluate_static_guess,
    read_truth,
)
from vipe_core.formats import list_sequences, read_artifacts
from vipe_core.pipeline.annotator import Annotator

_EVERY_FRAME = "every frame"
# A mapper that poses fewer frames than this share of the other's is not the better one, however small its error is.
_COMPARABLE = 0.9


@dataclass(frozen=True, slots=True)
class Ours:
    """Our answer to one sequence.

    Attributes:
        world_from_cam: (N, 4, 4).
        frame_index: (N,) frames of the video.
        verdict: `yes`, `doubtful` or `no`; empty where the artifacts do not say.
        reasons: Of the verdict.
        fov_interval_deg: In which the field of view lies with 95 %; None where the artifacts do not say.
        median_depth: Of one frame, in units of the path, to judge what a camera that stands still does; None unless it
            is needed.
        cpu_s_per_frame: None for artifacts.
    """

    world_from_cam: NDArray[np.float64]
    frame_index: NDArray[np.int64]
    camera: Camera
    report: SequenceReport
    verdict: str
    reasons: tuple[str, ...]
    fov_interval_deg: tuple[float, float] | None
    median_depth: float | None
    cpu_s_per_frame: float | None

    @property
    def drift_percent(self) -> float | None:
        """Largest distance from the first position, in percent of the median depth."""
        if self.median_depth is None:
            return None
        centres = self.world_from_cam[:, :3, 3]
        return 100 * float(np.linalg.norm(centres - centres[0], axis=1).max()) / self.median_depth


@dataclass(frozen=True, slots=True)
class Peer:
    """The answer of COLMAP's better mapper, and our errors on the frames that it posed."""

    run: ColmapRun
    report: SequenceReport
    ours_there: SequenceReport


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("sequences", nargs="*", metavar="SEQUENCE", help="default: all that something is asked of")
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the shared data")
    parser.add_argument("--artifacts", type=Path, metavar="ROOT", help="score these instead of annotating")
    parser.add_argument("--peers", action="store_true", help="run COLMAP where a sequence is measured against it")
    parser.add_argument("--cache", type=Path, help="folder where COLMAP's results are kept and found")
    parser.add_argument("--json", type=Path, help="also write the figures to this file")
    arguments = parser.parse_args(argv)

    names = arguments.sequences or SUITE
    with_depth = arguments.artifacts is not None
    table = _table(with_depth)
    figures: list[dict[str, Any]] = []
    failed = missed = 0
    for name in names:
        try:
            sequence = find_sequence(name, arguments.data)
            truth = read_truth(sequence.truth)
            ours = _annotated(sequence, truth) if not with_depth else _stored(arguments.artifacts, sequence, truth)
            limit, peer = sequence.limit, None
            if arguments.peers and limit.peer:
                peer = _peer(sequence, truth, ours, arguments.cache)
        except VipeError as error:
            failed += 1
            print(f"{Path(name).name}: {error}", file=sys.stderr)
            continue
        trivial = evaluate_static_guess(truth)
        checks = _checks(limit, ours, peer)
        missed += any(not met for _, met in checks)
        _add_rows(table, sequence.name, truth, ours, peer, trivial, checks, with_depth=with_depth)
        figures.append(_figures(sequence.name, ours, peer, checks))
        print(f"{sequence.name}: {_one_line(ours, checks)}", file=sys.stderr, flush=True)
    Console(width=200 if with_depth else 150).print(table)
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, indent=1, allow_nan=False) + "\n")
    return 1 if failed or missed else 0


def _annotated(sequence: BenchSequence, truth: GroundTruth) -> Ours:
    """Annotates the sequence and compares it with the truth."""
    # One thread: the figures are those of the bytes that everybody gets.
    measured = measure(Annotator(threads=1), sequence.video)
    annotation = measured.annotation
    index = np.arange(annotation.num_frames)
    estimate = Estimate(sequence.name, annotation.world_from_cam, index, annotation.camera)
    depth = None
    if sequence.limit.drift_percent is not None:
        frames = annotation.dense()
        depth = _median_depth(next(frames).depth)
        frames.close()
    quality = annotation.quality
    return Ours(
        annotation.world_from_cam,
        index,
        annotation.camera,
        evaluate(estimate, truth),
        quality.reliable,
        quality.reasons,
        quality.fov_interval_deg,
        depth,
        measured.cpu_s_per_frame,
    )


def _stored(root: Path, sequence: BenchSequence, truth: GroundTruth) -> Ours:
    """Compares artifacts with the truth."""
    known = list_sequences(root)
    pictures = "video" if sequence.pictures is None else sequence.pictures.stem
    artifacts = read_artifacts(root, pictures if sequence.name not in known and known == [pictures] else sequence.name)
    quality = artifacts.info.get("quality", {})
    depth = None
    if sequence.limit.drift_percent is not None and artifacts.has_depth:
        with artifacts.open_depth() as reader:
            depth = _median_depth(reader.read(0))
    return Ours(
        artifacts.world_from_cam,
        artifacts.frame_index,
        artifacts.camera,
        evaluate_artifacts(artifacts, truth),
        str(quality.get("reliable", "")),
        tuple(quality.get("reasons", ())),
        _interval(quality.get("fov_interval_deg")),
        depth,
        None,
    )


def _interval(stored: Any) -> tuple[float, float] | None:
    if not isinstance(stored, list) or len(stored) != 2 or None in stored:
        return None
    return float(stored[0]), float(stored[1])


def _median_depth(depth: NDArray[np.float32]) -> float | None:
    known = depth[np.isfinite(depth) & (depth > 0)]
    return float(np.median(known)) if known.size else None


def _peer(sequence: BenchSequence, truth: GroundTruth, ours: Ours, cache: Path | None) -> Peer | None:
    """COLMAP's better mapper: of those that pose about as many frames, the one with the smaller ATE."""
    runs = run_colmap(sequence.video, settings=ColmapSettings(), cache=cache)
    most = max(len(run.frame_index) for run in runs)
    found = []
    for run in runs:
        if run.camera is None or len(run.frame_index) < max(3, _COMPARABLE * most):
            continue
        report = evaluate(Estimate(run.mapper, run.world_from_cam, run.frame_index, run.camera), truth)
        kept = np.isin(ours.frame_index, run.frame_index)
        there = Estimate(sequence.name, ours.world_from_cam[kept], ours.frame_index[kept], ours.camera)
        found.append(Peer(run, report, evaluate(there, truth)))
    return min(found, key=lambda peer: peer.report.trajectory.ate_percent or 0.0, default=None)


def _checks(limit: Limit, ours: Ours, peer: Peer | None) -> list[tuple[str, bool]]:
    """What is asked, in words, and whether it is met. What COLMAP has not been run for is not asked."""
    path, fov = ours.report.trajectory, _fov_error(ours.report)
    asked: list[tuple[str, float | None, float | None]] = [
        ("ATE {:.3g}%", path.ate_percent, limit.ate_percent),
        ("FOV {:.3g}", fov, limit.fov_deg),
        ("rot {:.3g}", path.rotation_rmse_deg, limit.rotation_deg),
        ("drift {:.3g}%", ours.drift_percent, limit.drift_percent),
    ]
    if peer is not None:
        theirs = peer.report
        if limit.peer_ate:
            asked.append(
                ("ATE {:.3f}% (COLMAP)", peer.ours_there.trajectory.ate_percent, theirs.trajectory.ate_percent)
            )
        if limit.peer_fov:
            asked.append(("FOV {:.2f} (COLMAP)", fov, _fov_error(theirs)))
    checks = [
        (text.format(most), value is not None and value <= most) for text, value, most in asked if most is not None
    ]
    if limit != Limit():
        checks.append((_EVERY_FRAME, ours.report.coverage == 1.0))
    if limit.reason is not None:
        checks.append((limit.reason, limit.reason in ours.reasons))
    return checks


def _table(with_depth: bool) -> Table:
    table = Table(title="Accuracy against ground truth; asked of each besides: every frame posed")
    headings = ["sequence", "posed", "ATE %", "RTE %", "RRE deg", "rot deg", "FOV", "true", "off", "95 %"]
    if with_depth:
        headings += ["AbsRel", "logRMSE", "d1.25", "depth/pose", "mask IoU", "x ATE", "x FOV", "x AbsRel"]
    headings += ["verdict", "CPU-s/fr.", "asked: at most", "met"]
    for heading in headings:
        words = heading in ("sequence", "verdict", "asked: at most", "met")
        table.add_column(heading, justify="left" if words else "right", no_wrap=heading != "asked: at most")
    return table


def _add_rows(
    table: Table,
    name: str,
    truth: GroundTruth,
    ours: Ours,
    peer: Peer | None,
    trivial: SequenceReport,
    checks: Sequence[tuple[str, bool]],
    *,
    with_depth: bool,
) -> None:
    true_fov = None if truth.camera is None or truth.camera.model == "equirect" else truth.camera.fov_x_deg
    report = ours.report
    frames = len(truth.world_from_cam)
    cells = [f"{round(report.coverage * frames)}/{frames}", *_pose_cells(report, ours.camera, true_fov)]
    cells.append(_interval_cell(ours.fov_interval_deg, true_fov))
    if with_depth:
        cells += [
            *_depth_cells(report),
            _times(report.trajectory.ate_rmse, trivial.trajectory.ate_rmse),
            _times(_fov_error(report), _fov_error(trivial)),
            _times(_abs_rel(report), _abs_rel(trivial)),
        ]
    misses = [text.split()[0] for text, met in checks if not met]
    met = "" if not checks else f"no: {', '.join(misses)}" if misses else "yes"
    asked = ", ".join(text for text, _ in checks if text != _EVERY_FRAME)
    table.add_row(name, *cells, ours.verdict, _number(ours.cpu_s_per_frame), asked, met)
    depth_columns = 8 if with_depth else 0
    if peer is not None:
        run = peer.run
        cells = [f"{len(run.frame_index)}/{run.num_frames}", *_pose_cells(peer.report, run.camera, true_fov)]
        cells += [""] * (1 + depth_columns)
        table.add_row(f"  COLMAP {run.mapper}", *cells, "", _number(run.cpu_s_per_posed_frame))
    static = _depth_cells(trivial) if with_depth else []
    table.add_row("  trivial", "", *_pose_cells(trivial, None, None), "", *static, style="dim")


def _pose_cells(report: SequenceReport, camera: Camera | None, true_fov: float | None) -> list[str]:
    path = report.trajectory
    return [
        _number(path.ate_percent, 3),
        _number(path.rte_percent),
        _number(path.rre_rmse_deg, 3),
        _number(path.rotation_rmse_deg, 3),
        "" if camera is None else f"{camera.fov_x_deg:.2f}",
        "" if camera is None else _number(true_fov),
        _number(_fov_error(report)),
    ]


def _interval_cell(interval: tuple[float, float] | None, true_fov: float | None) -> str:
    if interval is None:
        return ""
    outside = true_fov is not None and not interval[0] <= true_fov <= interval[1]
    return f"{interval[0]:.1f}-{interval[1]:.1f}{' !' if outside else ''}"


def _depth_cells(report: SequenceReport) -> list[str]:
    depth = report.depth
    return [
        _number(depth.abs_rel if depth else None, 3),
        _number(depth.log_rmse if depth else None, 3),
        _number(depth.delta125 if depth else None, 3),
        _number(report.depth_pose_ratio, 3),
        _number(report.mask.iou if report.mask else None, 3),
    ]


def _figures(name: str, ours: Ours, peer: Peer | None, checks: Sequence[tuple[str, bool]]) -> dict[str, Any]:
    """The row as plain values, for programs."""
    figures: dict[str, Any] = {
        "sequence": name,
        "ours": asdict(ours.report),
        "fov_x_deg": ours.camera.fov_x_deg,
        "fov_interval_deg": ours.fov_interval_deg,
        "verdict": ours.verdict,
        "reasons": list(ours.reasons),
        "drift_percent": ours.drift_percent,
        "cpu_s_per_frame": ours.cpu_s_per_frame,
        "asked": [{"limit": text, "met": met} for text, met in checks],
    }
    if peer is not None:
        figures["colmap"] = {
            "mapper": peer.run.mapper,
            "posed": len(peer.run.frame_index),
            "frames": peer.run.num_frames,
            "cpu_s_per_posed_frame": peer.run.cpu_s_per_posed_frame,
            "errors": asdict(peer.report),
            "ours_on_its_frames": asdict(peer.ours_there),
        }
    return figures


def _one_line(ours: Ours, checks: Sequence[tuple[str, bool]]) -> str:
    path = ours.report.trajectory
    said = ", ".join(f"{text}{'' if met else ' MISSED'}" for text, met in checks)
    return f"ATE {_number(path.ate_percent, 3)} %, FOV off {_number(_fov_error(ours.report))}; asked {said or '-'}"


def _fov_error(report: SequenceReport) -> float | None:
    return report.camera.fov_x_deg if report.camera else None


def _abs_rel(report: SequenceReport) -> float | None:
    return report.depth.abs_rel if report.depth else None


def _number(value: float | None, digits: int = 2) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _times(ours: float | None, trivial: float | None) -> str:
    return "-" if not ours or trivial is None else f"{trivial / ours:.1f}"


if __name__ == "__main__":
    raise SystemExit(main())
