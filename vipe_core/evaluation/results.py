"""One sequence's figures as plain numbers, and the files that keep them between runs.

A finished sequence is two files: NAME.json with its figures and NAME.npz with the paths that plots are drawn from. The
figures carry the key of everything that they depend on, so a run with the same key finds them and need not repeat them.
"""

from __future__ import annotations

import json
import math
import zipfile
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from vipe_core.evaluation.consistency import SampsonErrors, ShuttleErrors
from vipe_core.evaluation.truth import SequenceReport
from vipe_core.formats.atomic import complete_file

Array = NDArray[Any]


@dataclass(frozen=True, slots=True)
class Paths:
    """What a plot of a sequence shows.

    Attributes:
        estimate: (N, 4, 4) world_from_cam.
        reference: (N, 4, 4) of the same frames: the truth, or the backward run in the order of the video.
        kind: Which of the two it is.
        times_s: (N,).
    """

    estimate: Array
    reference: Array
    kind: Literal["truth", "backward"]
    times_s: Array


@dataclass(frozen=True, slots=True)
class SequenceResult:
    """The row of one sequence.

    Attributes:
        name: Name in its dataset.
        group: Group that it is averaged in.
        key: Hash of all that the figures depend on.
        error: None, or {"code", "message"} of what ended it; then there are no figures.
        frames: Frames of the video that were used.
        figures: Metric -> value; None where a metric means nothing for this sequence. See `flat_figures`.
        reliable: The engine's own verdict; None for results that were only scored.
        cpu_s: CPU seconds of the engine, decoders included; None for results that were only scored.
        notes: What a reader of the figures must know.
    """

    name: str
    group: str
    key: str
    error: dict[str, str] | None = None
    frames: int = 0
    figures: dict[str, float | None] = field(default_factory=dict)
    reliable: str | None = None
    cpu_s: float | None = None
    notes: tuple[str, ...] = ()


def flat_figures(
    report: SequenceReport | None = None, shuttle: ShuttleErrors | None = None, sampson: SampsonErrors | None = None
) -> dict[str, float | None]:
    """The figures by name; metres, degrees, pixels; shares of 1 unless the name says percent."""
    figures: dict[str, float | None] = {}
    if report is not None:
        path, camera, depth = report.trajectory, report.camera, report.depth
        figures |= {
            "coverage": report.coverage,
            "ate_m": path.ate_rmse,
            "ate_percent": path.ate_percent,
            "rte_m": path.rte_rmse,
            "rte_percent": path.rte_percent,
            "rre_deg": path.rre_rmse_deg,
            "rotation_deg": path.rotation_rmse_deg,
            "path_m": path.path_length,
            "fov_deg": None if camera is None else camera.fov_x_deg,
        }
        if depth is not None:
            figures |= {
                "rel_abs": depth.abs_rel,
                "log_rmse": depth.log_rmse,
                "delta125": depth.delta125,
                "depth_scale": depth.scale,
                "depth_shift": depth.shift,
                "depth_density": depth.density,
                "depth_pose_ratio": report.depth_pose_ratio,
            }
        if report.mask is not None:
            figures |= {
                "mask_iou": report.mask.iou,
                "mask_recall": report.mask.recall,
                "mask_false_alarms": report.mask.false_alarms,
            }
    if shuttle is not None:
        figures |= {
            "s_ate": shuttle.ate,
            "s_rte": shuttle.rte,
            "s_rre_deg": shuttle.rre_deg,
            "s_fov_deg": shuttle.fov_deg,
        }
    if sampson is not None:
        figures |= {
            "sampson_px": sampson.mean_px,
            "sampson_median_px": sampson.median_px,
            "sampson_matches": float(sampson.matches),
        }
    return {
        name: None if value is None or not math.isfinite(value) else float(value) for name, value in figures.items()
    }


def mean_figures(results: list[SequenceResult]) -> dict[str, float | None]:
    """The plain mean over the sequences that have a figure; failed sequences have none, and are counted elsewhere."""
    names = dict.fromkeys(name for result in results for name in result.figures)
    means: dict[str, float | None] = {}
    for name in names:
        values = [value for result in results if (value := result.figures.get(name)) is not None]
        means[name] = float(np.mean(values)) if values else None
    return means


def save_result(folder: Path, stem: str, result: SequenceResult, paths: Paths | None) -> None:
    """Writes the paths, then the figures: a sequence whose figures are there is complete."""
    folder.mkdir(parents=True, exist_ok=True)
    if paths is not None:
        with complete_file(folder / f"{stem}.npz") as temporary, temporary.open("wb") as file:
            np.savez(
                file,
                estimate=paths.estimate,
                reference=paths.reference,
                kind=np.array(paths.kind),
                times_s=paths.times_s,
            )
    with complete_file(folder / f"{stem}.json") as temporary:
        temporary.write_text(json.dumps(asdict(result), indent=2) + "\n", encoding="utf-8")


def load_result(folder: Path, stem: str) -> SequenceResult | None:
    """The stored row, or None where there is none that can be read."""
    try:
        stored = json.loads((folder / f"{stem}.json").read_text(encoding="utf-8"))
        return SequenceResult(**(stored | {"notes": tuple(stored["notes"])}))
    except (OSError, ValueError, KeyError, TypeError):
        return None


def load_paths(folder: Path, stem: str) -> Paths | None:
    """The stored paths, or None where there are none."""
    try:
        with np.load(folder / f"{stem}.npz", allow_pickle=False) as file:
            kind: Literal["truth", "backward"] = "truth" if str(file["kind"]) == "truth" else "backward"
            return Paths(file["estimate"], file["reference"], kind, file["times_s"])
    except (OSError, ValueError, KeyError, zipfile.BadZipFile):
        return None
