"""`vipectl annotate --rig`: the views of a rig, annotated together."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from services.cli.annotate import annotation_row


def annotate_rig(
    rig: Path, videos: Sequence[Path], output: Path, scale_from: str | None, engine: dict[str, Any], console: Any
) -> list[dict[str, Any]]:
    """Annotate a rig and write its views and `<name of the rig file>.rig.json`.

    Args:
        videos: One per view; none for those that the rig file names.
        engine: Arguments of the annotator.

    Returns:
        One row per view, or one with an error.
    """
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    from vipe_core.annotation import Progress as EngineProgress
    from vipe_core.cameras.rig import read_rig
    from vipe_core.errors import VipeError
    from vipe_core.formats import SequenceNames, write_artifacts
    from vipe_core.pipeline.rig_annotator import RigAnnotator

    columns = (TextColumn("{task.fields[rig]}"), TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    started = time.perf_counter()
    names = SequenceNames(output)
    try:
        known = read_rig(rig)
        titles = [names.name_for(Path(f"{rig.stem}_{view.name}")) for view in known.views]
        with Progress(*columns, TimeElapsedColumn(), console=console, transient=True) as bars:
            task = bars.add_task("opening", rig=rig.name, total=None)

            def report(progress: EngineProgress) -> None:
                bars.update(
                    task, description=progress.stage, completed=progress.frames_done, total=progress.frames_total
                )

            annotator = RigAnnotator(**engine)
            found = annotator.annotate_rig(rig, videos or None, names=titles, scale_from=scale_from, progress=report)
            for annotation in found.views:
                write_artifacts(annotation, output)
        path = output / f"{rig.stem}.rig.json"
        path.write_text(json.dumps(found.rig.to_json(), indent=1) + "\n", encoding="utf-8")
    except VipeError as error:
        console.print(f"[red]{rig}: {error} \\[{error.code}]", highlight=False)
        return [{"input": str(rig), "error": {"code": error.code, "message": str(error)}}]
    seconds = round(time.perf_counter() - started, 3)
    rows = []
    for view, annotation in zip(known.views, found.views, strict=True):
        row = annotation_row(rig, annotation, output)
        row |= {"view": view.name, "rig": str(path), "seconds": seconds}
        row["frames_per_s"] = round(row["num_frames"] * len(found.views) / max(seconds, 1e-9), 3)
        rows.append(row)
    return rows
