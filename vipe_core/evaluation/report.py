"""The report of an evaluation: one table in Markdown with its figures beside it, and the same as JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from vipe_core.evaluation.results import SequenceResult, mean_figures
from vipe_core.formats.atomic import complete_file
from vipe_core.slam.settings import EnergyTerms

# The rows of the paper's table 4, the whole energy last.
ABLATION: dict[str, EnergyTerms] = {
    "dense": EnergyTerms(sparse_tracks=False, depth_prior=False, motion_masks=False),
    "dense-depth": EnergyTerms(sparse_tracks=False, motion_masks=False),
    "dense-sparse-depth": EnergyTerms(motion_masks=False),
    "dense-depth-masks": EnergyTerms(sparse_tracks=False),
    "all": EnergyTerms(),
}
_TERM_HEADINGS = {"dense_flow": "dense", "sparse_tracks": "sparse", "depth_prior": "depth", "motion_masks": "masks"}


@dataclass(frozen=True, slots=True)
class Column:
    """A figure in tables: `figure` of a row times `factor`, with `digits` after the point, or in all where it is a
    length of any size (`significant`)."""

    figure: str
    heading: str
    digits: int
    factor: float = 1.0
    significant: bool = False


def columns(results: Sequence[SequenceResult], unit: tuple[str, float] = ("m", 1.0)) -> list[Column]:
    """The columns that any of the rows has a figure for, in the order of the paper's tables.

    Args:
        unit: Of lengths, and how many metres it is.
    """
    name, metres = unit
    possible = (
        Column("ate_m", f"ATE [{name}]", 3, 1 / metres, True),
        Column("ate_percent", "ATE [% of path]", 3),
        Column("rte_m", f"RTE [{name}]", 3, 1 / metres, True),
        Column("rre_deg", "RRE [deg]", 3),
        Column("rotation_deg", "rotation [deg]", 3),
        Column("fov_deg", "Focal [deg]", 2),
        Column("coverage", "posed [%]", 1, 100),
        Column("rel_abs", "RelAbs", 3),
        Column("log_rmse", "LogRMSE", 3),
        Column("delta125", "delta 1.25 [%]", 1, 100),
        Column("depth_pose_ratio", "depth/pose", 3),
        Column("mask_iou", "mask IoU [%]", 1, 100),
        Column("mask_false_alarms", "masked static [%]", 1, 100),
        Column("s_ate", "S-ATE [x1e-2]", 3, 1e2),
        Column("s_rte", "S-RTE [x1e-4]", 3, 1e4),
        Column("s_rre_deg", "S-RRE [deg]", 3),
        Column("s_fov_deg", "S-Focal [deg]", 2),
        Column("sampson_px", "Sampson [px]", 3),
        Column("sampson_median_px", "Sampson median [px]", 3),
    )
    there = {name for result in results for name in result.figures}
    return [column for column in possible if column.figure in there]


_EXPLAINED = {
    "ate_m": "ATE: RMS distance of the camera centres after the least-squares Sim(3) alignment.",
    "rte_m": "RTE, RRE: RMS translation and rotation error of the motion between consecutive frames.",
    "rotation_deg": "rotation: RMS rotation error after the best constant rotation.",
    "fov_deg": "Focal: absolute difference of the horizontal fields of view.",
    "rel_abs": "RelAbs, LogRMSE, delta 1.25: depth of static pixels, all pixels of a sequence weighing the same, after"
    " one alignment per sequence: {alignment}.",
    "depth_pose_ratio": "depth/pose: depth scale over pose scale, 1 when both are in the same units.",
    "mask_iou": "mask IoU, masked static: masks of moving things against the true ones, all pixels of all frames; the"
    " share of static pixels that are masked.",
    "s_ate": "S-ATE, S-RTE, S-RRE, S-Focal: the run over the video against the run over its reverse, both paths scaled"
    " to length 1, after a rigid alignment.",
    "sampson_px": "Sampson: distance to the epipolar line, to first order, of matches in consecutive frames; mean over"
    " the matches of a pair, then over pairs (the median is over medians).",
}
ALIGNMENTS = {
    "metric": "none",
    "scale": "the median of truth / estimate",
    "scale_shift": "scale and shift with the least absolute error",
}


@dataclass(frozen=True, slots=True)
class Heading:
    """What a report says before its table.

    Attributes:
        title: First line.
        text: Paragraphs: dataset, protocol and what else a reader must know.
        facts: Name -> value: preset, configuration hash, engine version, device ...
        unit: Of lengths, and how many metres it is.
        alignment: Of depth; a key of `ALIGNMENTS`.
    """

    title: str
    text: tuple[str, ...]
    facts: Mapping[str, str]
    unit: tuple[str, float] = ("m", 1.0)
    alignment: str = "scale"


def table_rows(results: Sequence[SequenceResult], shown: Sequence[Column]) -> list[list[str]]:
    """A row per sequence and the means: of each group where there are several, and of all. Failed sequences show their
    code."""
    rows = []
    for result in results:
        if result.error is not None:
            rows.append([result.name, "failed", *[""] * len(shown), result.error["code"], ""])
            continue
        per_frame = "-" if result.cpu_s is None or not result.frames else f"{result.cpu_s / result.frames:.2f}"
        cells = [_cell(result.figures.get(column.figure), column) for column in shown]
        rows.append([result.name, str(result.frames), *cells, result.reliable or "-", per_frame])
    groups = list(dict.fromkeys(result.group for result in results))
    for group in groups if len(groups) > 1 else []:
        rows.append(_mean_row(f"mean of {group}", [r for r in results if r.group == group], shown))
    if len(results) > 1:
        rows.append(_mean_row("mean", results, shown))
    return rows


def table_headings(shown: Sequence[Column]) -> list[str]:
    return ["sequence", "frames", *(column.heading for column in shown), "reliable", "CPU s/frame"]


def ablation_rows(by_name: Mapping[str, Sequence[SequenceResult]], shown: Sequence[Column]) -> list[list[str]]:
    """A row per variant of `ABLATION`: its terms, and the means over the sequences that every variant finished."""
    common = common_names(by_name)
    rows = []
    for name, results in by_name.items():
        terms = asdict(ABLATION[name])
        means = mean_figures([result for result in results if result.name in common])
        marks = ["x" if terms[term] else "" for term in _TERM_HEADINGS]
        rows.append([*marks, *(_cell(means.get(column.figure), column) for column in shown), str(len(common))])
    return rows


def ablation_headings(shown: Sequence[Column]) -> list[str]:
    return [*_TERM_HEADINGS.values(), *(column.heading for column in shown), "sequences"]


def common_names(by_name: Mapping[str, Sequence[SequenceResult]]) -> set[str]:
    """Sequences that no variant failed on: means over others would not compare."""
    finished = [{result.name for result in results if result.error is None} for results in by_name.values()]
    return set.intersection(*finished) if finished else set()


def write_report(
    out: Path, heading: Heading, results: Sequence[SequenceResult], pictures: Mapping[str, str]
) -> tuple[Path, Path]:
    """Writes report.md and report.json into `out`.

    Args:
        pictures: Name of a sequence -> its figure, relative to `out`.
    """
    shown = columns(results, heading.unit)
    parts = [_top(heading), _markdown(table_headings(shown), table_rows(results, shown)), _explained(shown, heading)]
    failed = [result for result in results if result.error is not None]
    if failed:
        lines = [f"- {r.name}: {r.error['message']} [{r.error['code']}]" for r in failed if r.error is not None]
        parts.append("## Failed\n\n" + "\n".join(lines))
    notes = [f"- {result.name}: {'; '.join(result.notes)}" for result in results if result.notes]
    if notes:
        parts.append("## Notes\n\n" + "\n".join(notes))
    if pictures:
        parts.append("## Figures\n\n" + "\n\n".join(f"![{name}]({path})" for name, path in pictures.items()))
    document = {
        "title": heading.title,
        "text": list(heading.text),
        "facts": dict(heading.facts),
        "depth_alignment": heading.alignment,
        "rows": [asdict(result) for result in results],
        "means": {
            group: mean_figures([result for result in results if result.group == group])
            for group in dict.fromkeys(result.group for result in results)
        },
        "mean": mean_figures(list(results)),
        "failed": len(failed),
    }
    return _write(out, "\n\n".join(part for part in parts if part), document)


def write_ablation(out: Path, heading: Heading, by_name: Mapping[str, Sequence[SequenceResult]]) -> tuple[Path, Path]:
    """Writes report.md and report.json of an ablation into `out`; each variant has its own report in a folder of its
    name."""
    every = [result for results in by_name.values() for result in results]
    shown = columns(every, heading.unit)
    links = "\n".join(f"- [{name}]({name}/report.md)" for name in by_name)
    common = common_names(by_name)
    left_out = sorted({result.name for result in every} - common)
    parts = [
        _top(heading),
        _markdown(ablation_headings(shown), ablation_rows(by_name, shown)),
        f"Left out, as not every variant finished them: {', '.join(left_out)}." if left_out else "",
        _explained(shown, heading),
        "## Variants\n\n" + links,
    ]
    document = {
        "title": heading.title,
        "text": list(heading.text),
        "facts": dict(heading.facts),
        "depth_alignment": heading.alignment,
        "sequences": sorted(common),
        "variants": {
            name: {
                "terms": asdict(ABLATION[name]),
                "mean": mean_figures([result for result in results if result.name in common]),
            }
            for name, results in by_name.items()
        },
    }
    return _write(out, "\n\n".join(part for part in parts if part), document)


def _write(out: Path, text: str, document: Mapping[str, Any]) -> tuple[Path, Path]:
    markdown, data = out / "report.md", out / "report.json"
    with complete_file(markdown) as partial:
        partial.write_text(text + "\n", encoding="utf-8")
    with complete_file(data) as partial:
        partial.write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")
    return markdown, data


def _top(heading: Heading) -> str:
    facts = ", ".join(f"{name} {value}" for name, value in heading.facts.items())
    return "\n\n".join((f"# {heading.title}", *heading.text, f"Made with: {facts}."))


def _explained(shown: Sequence[Column], heading: Heading) -> str:
    lines = [_EXPLAINED[column.figure] for column in shown if column.figure in _EXPLAINED]
    alignment = ALIGNMENTS[heading.alignment]
    return "\n".join(f"- {line.format(alignment=alignment)}" for line in lines)


def _mean_row(name: str, results: Sequence[SequenceResult], shown: Sequence[Column]) -> list[str]:
    finished = [result for result in results if result.error is None]
    means = mean_figures(finished)
    count = f"{len(finished)}/{len(results)}" if len(finished) < len(results) else str(len(results))
    label = f"{name} ({count})"
    return [label, "", *(_cell(means.get(column.figure), column) for column in shown), "", ""]


def _cell(value: float | None, column: Column) -> str:
    if value is None:
        return "-"
    return f"{value * column.factor:.{column.digits}{'g' if column.significant else 'f'}}"


def _markdown(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    escaped = [[cell.replace("|", "\\|") for cell in row] for row in rows]
    rule = ["---", *["---:"] * (len(headings) - 1)]
    return "\n".join("| " + " | ".join(row) + " |" for row in (headings, rule, *escaped))
