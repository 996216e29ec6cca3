"""Tables for people: one row per video."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping
from typing import Any

from rich.console import Console
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

_LOG_WIDTH = 140
_ANY_WIDTH = 100_000
_VERDICT_STYLE = {"yes": "green", "doubtful": "yellow", "no": "red"}


def results_console() -> Console:
    """Standard output; a file or pipe is wide, so that little is wrapped in a log."""
    return Console(highlight=False, width=None if sys.stdout.isatty() else _LOG_WIDTH)


def print_table(table: Table) -> None:
    """To standard output; a file or pipe is as wide as the table, so that a row is a line."""
    console = results_console()
    if not sys.stdout.isatty():
        unbounded = console.options.update(width=_ANY_WIDTH)
        console.width = max(_LOG_WIDTH, Measurement.get(console, unbounded, table).maximum)
    console.print(table)


def _quality(quality: Mapping[str, Any] | None) -> Text:
    if not quality:
        return Text("-")
    verdict = str(quality["reliable"])
    reasons = ", ".join(quality["reasons"])
    text = verdict if not reasons else f"{verdict}: {reasons}"
    return Text(text, style=_VERDICT_STYLE.get(verdict, ""))


def annotation_table(
    rows: Iterable[Mapping[str, Any]], scores: Mapping[str, Mapping[str, float]] | None = None
) -> Table:
    """Rows have the fields of `VideoResult` (or of `vipectl annotate --json`).

    Args:
        rows: Succeeded and failed videos; a failed one shows its error across the columns.
        scores: Key -> {ate_pct, fov_err_deg} for videos with ground truth; adds two columns.
    """
    table = Table(show_edge=False, pad_edge=False, header_style="bold")
    table.add_column("video", overflow="fold")
    for title in ("frames", "size", "seconds", "frames/s", "focal px", "FOV", "path"):
        table.add_column(title, justify="right", no_wrap=True)
    if scores:
        table.add_column("ATE", justify="right", no_wrap=True)
        table.add_column("FOV err", justify="right", no_wrap=True)
    table.add_column("reliable")
    for row in rows:
        name = str(row.get("name") or row["key"])
        if row.get("error_code"):
            blanks = [""] * (7 + (2 if scores else 0))
            table.add_row(name, *blanks, Text(f"{row['status']}: {row['error_code']}", style="red"))
            continue
        frames, seconds = row["num_frames"], row["seconds"]
        focal = f"{row['camera_params'][0]:.1f}" if row["camera_params"] else "-"
        unit = " m" if row["scale"] == "metric" else ""
        cells = [
            name,
            str(frames),
            f"{row['width']}x{row['height']}",
            f"{seconds:.1f}",
            f"{frames / seconds:.2f}",
            focal,
            f"{row['fov_x_deg']:.1f}°",
            f"{row['trajectory_length']:.2f}{unit}",
        ]
        if scores:
            score = scores.get(name)
            cells += ["-", "-"] if score is None else [f"{score['ate_pct']:.2f}%", f"{score['fov_err_deg']:.2f}°"]
        table.add_row(*cells, _quality(row.get("quality")))
    return table


def stage_table(rows: Iterable[Mapping[str, Any]]) -> Table:
    """Where the time went, over all rows of `vipectl annotate`: stages in the order in which they run."""
    seconds: dict[str, float] = {}
    peak_bytes: dict[str, int] = {}
    for row in rows:
        for stage, spent_s in row["timings_s"].items():
            seconds[stage] = seconds.get(stage, 0.0) + spent_s
        for stage, peak in row["peak_bytes"].items():
            peak_bytes[stage] = max(peak_bytes.get(stage, 0), peak)
    table = Table(show_edge=False, pad_edge=False, header_style="bold")
    table.add_column("stage")
    for title in ("seconds", "share", *(["GPU memory"] if peak_bytes else [])):
        table.add_column(title, justify="right", no_wrap=True)
    total_s = sum(seconds.values()) or 1.0
    for stage, spent_s in seconds.items():
        peak = [f"{peak_bytes.get(stage, 0) / 1e9:.2f} GB"] if peak_bytes else []
        table.add_row(stage, f"{spent_s:.2f}", f"{100 * spent_s / total_s:.0f}%", *peak)
    return table
