"""A live progress bar of a job, fed over REST."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

if TYPE_CHECKING:
    from services.client import Client

TERMINAL = {"succeeded", "succeeded_with_errors", "failed", "cancelled"}
_PLAIN_INTERVAL_S = 15.0


def describe(job: dict[str, Any]) -> str:
    """One line: state, videos, frames, rate and remaining time."""
    progress = job["progress"]
    settled = progress["videos_succeeded"] + progress["videos_failed"] + progress["videos_quarantined"]
    state = job["state"] if job["pause_reason"] is None else f"paused ({job['pause_reason']})"
    parts = [state, f"videos {settled}/{progress['videos_total']}"]
    expected = progress["frames_expected"]
    parts.append(f"frames {progress['frames_done']}" + (f"/{expected}" if expected else ""))
    if progress["frames_per_s"]:
        parts.append(f"{progress['frames_per_s']:.2f} frames/s")
    if progress["eta_s"] is not None and job["state"] == "running":
        minutes, seconds = divmod(round(progress["eta_s"]), 60)
        parts.append(f"ETA {minutes}:{seconds:02d}")
    return "  ".join(parts)


def show_progress(client: Client, job_id: str, console: Console | None = None) -> dict[str, Any]:
    """Show a job's progress until it ends, and return it. Without a terminal: a plain line now and then."""
    console = console or Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(bar_width=30), TimeElapsedColumn())
    last_line = 0.0
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("waiting", total=None)
        while True:
            job = client.job(job_id)
            progress = job["progress"]
            bar.update(
                task,
                description=describe(job),
                completed=progress["frames_done"],
                total=progress["frames_expected"] or None,
            )
            if job["state"] in TERMINAL:
                return job
            if not console.is_terminal and time.monotonic() - last_line >= _PLAIN_INTERVAL_S:
                last_line = time.monotonic()
                console.print(describe(job), highlight=False)
            time.sleep(0.5)
