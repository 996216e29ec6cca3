"""`vipectl eval`: the engine judged on datasets with ground truth and on videos without."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from services.cli.engine_options import DEVICE_HELP, PRESET_HELP

if TYPE_CHECKING:
    from vipe_core.evaluation.report import Heading
    from vipe_core.evaluation.results import SequenceResult
    from vipe_core.pipeline.evaluate import Measure, Task

_RAW = "What is evaluated"
_HOW = "How"


def evaluate(
    out: Annotated[
        Path, typer.Option("-o", "--out", metavar="REPORT_DIR", help="Gets report.md, report.json, figures.")
    ],
    dataset: Annotated[
        str | None,
        typer.Option(help="tum, eth3d, kitti, sintel, 7scenes, euroc, or gt (gt.npz).", rich_help_panel=_RAW),
    ] = None,
    root: Annotated[Path | None, typer.Option(metavar="DIR", help="Where it lies.", rich_help_panel=_RAW)] = None,
    protocol: Annotated[str, typer.Option(help="paper, or all of what is there.", rich_help_panel=_RAW)] = "all",
    videos: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Videos without ground truth: shuttle and Sampson errors.", rich_help_panel=_RAW
        ),
    ] = None,
    artifacts: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Score these annotations; run nothing.", rich_help_panel=_RAW)
    ] = None,
    truth: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Their ground truth, of --dataset.", rich_help_panel=_RAW)
    ] = None,
    max_frames: Annotated[
        int | None, typer.Option(min=2, help="Only the first so many frames.", rich_help_panel=_RAW)
    ] = None,
    preset: Annotated[str, typer.Option(help=PRESET_HELP, rich_help_panel=_HOW)] = "classical",
    device: Annotated[str, typer.Option(help=DEVICE_HELP, rich_help_panel=_HOW)] = "cpu",
    jobs: Annotated[int, typer.Option(min=1, help="Sequences at a time.", rich_help_panel=_HOW)] = 1,
    ablate: Annotated[
        bool, typer.Option("--ablate", help="The paper's table 4: every row of it.", rich_help_panel=_HOW)
    ] = False,
    depth: Annotated[
        bool | None, typer.Option(help="Judge depth. Default: as the protocol does.", rich_help_panel=_HOW)
    ] = None,
    depth_alignment: Annotated[
        str, typer.Option(help="metric, scale, or scale_shift.", rich_help_panel=_HOW)
    ] = "scale",
    consistency: Annotated[
        bool | None, typer.Option(help="Shuttle and Sampson errors. Default: for --videos.", rich_help_panel=_HOW)
    ] = None,
    matcher: Annotated[
        str, typer.Option(help="Of the Sampson error: auto, lightglue, sift.", rich_help_panel=_HOW)
    ] = "auto",
    plots: Annotated[bool, typer.Option(help="Draw the trajectories.", rich_help_panel=_HOW)] = True,
    fresh: Annotated[bool, typer.Option("--fresh", help="Do finished sequences again.", rich_help_panel=_HOW)] = False,
) -> None:
    """Measure accuracy on datasets, or consistency on any videos, and write a report.

    A run that is started again goes on where it stopped. Exit code 1 if any sequence failed.
    """
    from vipe_core.errors import ConfigError
    from vipe_core.evaluation.metrics import DEPTH_ALIGNMENTS
    from vipe_core.evaluation.plots import require_matplotlib
    from vipe_core.pipeline.device import resolve_device
    from vipe_core.pipeline.evaluate import Measure
    from vipe_core.pipeline.presets import resolve

    given = [source for source in (root, videos, artifacts) if source is not None]
    if len(given) != 1 or (artifacts is None) != (truth is None) or (root is not None and dataset is None):
        raise ConfigError("give one of: --dataset NAME --root DIR; --videos DIR; --artifacts DIR --truth DIR")
    if artifacts is not None and (ablate or consistency):
        raise ConfigError("finished annotations can only be scored: leave --ablate and --consistency out")
    alignment = next((kind for kind in DEPTH_ALIGNMENTS if kind == depth_alignment), None)
    if alignment is None:
        raise ConfigError(f"unknown depth alignment {depth_alignment!r}; on offer: {', '.join(DEPTH_ALIGNMENTS)}")
    if plots:
        require_matplotlib()
    resolve_device(device)
    measure = Measure(resolve(preset), device, bool(depth), bool(consistency), alignment, matcher)
    if videos is not None:
        measure = dataclasses.replace(measure, consistency=consistency is not False)
        tasks, heading = _plan_videos(videos, measure, max_frames)
    else:
        below = root if root is not None else truth
        assert below is not None
        tasks, heading = _plan_dataset(dataset or "gt", below, protocol, measure, depth, max_frames, artifacts)
    if ablate:
        finished = _ablate(tasks, heading, out, jobs, plots, fresh)
    else:
        finished = _evaluate(tasks, heading, out, jobs, plots, fresh)
    typer.echo(f"Written to {out.resolve()}")
    if not finished:
        raise typer.Exit(1)


def _plan_videos(videos: Path, measure: Measure, max_frames: int | None) -> tuple[list[Task], Heading]:
    from vipe_core.evaluation.matching import point_matcher
    from vipe_core.pipeline.evaluate import video_tasks

    text = []
    if measure.consistency:
        # Found out once, so that every process and every row has the same one.
        measure = dataclasses.replace(measure, matcher=point_matcher(measure.matcher, measure.device).kind)
        text.append(f"Sampson errors are of {point_matcher(measure.matcher, measure.device).name} matches.")
    tasks = video_tasks(videos, measure, max_frames)
    first = "" if max_frames is None else f", the first {max_frames} frames of each"
    text.insert(0, f"Videos without ground truth: {len(tasks)}{first}.")
    return tasks, _heading(f"Consistency on {videos.resolve().name}", text, measure)


def _plan_dataset(
    dataset: str,
    root: Path,
    protocol: str,
    measure: Measure,
    depth: bool | None,
    max_frames: int | None,
    artifacts: Path | None,
) -> tuple[list[Task], Heading]:
    from vipe_core.evaluation.datasets import DATASETS, find_sequences
    from vipe_core.pipeline.evaluate import dataset_tasks

    found = find_sequences(dataset, root, protocol, max_frames)
    measure = dataclasses.replace(measure, depth=found.protocol.with_depth if depth is None else depth)
    text = [found.protocol.text]
    if max_frames is not None:
        text.append(f"Only the first {max_frames} frames of each sequence.")
    if found.missing:
        text.append(f"Not found, and so not in the means: {', '.join(found.missing)}.")
    if artifacts is not None:
        text.append(f"Finished annotations of {artifacts.resolve().name} were scored.")
    title = f"Accuracy on {DATASETS[dataset].title}" + (", protocol of the paper" if protocol == "paper" else "")
    heading = _heading(title, text, measure if artifacts is None else None, found.protocol.unit, measure.alignment)
    return dataset_tasks(found.sequences, measure, artifacts), heading


def _heading(
    title: str,
    text: Sequence[str],
    measure: Measure | None,
    unit: tuple[str, float] = ("m", 1.0),
    alignment: str = "scale",
) -> Heading:
    from vipe_core.evaluation.report import Heading
    from vipe_core.pipeline.device import describe_device, resolve_device
    from vipe_core.pipeline.provenance import engine_version

    facts = {"vipe-cluster": engine_version()}
    if measure is not None:
        facts["preset"] = measure.preset.name
        facts["configuration"] = measure.preset.config_hash
        facts["device"] = describe_device(resolve_device(measure.device), 1)
    return Heading(title, tuple(text), facts, unit, alignment)


def _evaluate(tasks: Sequence[Task], heading: Heading, out: Path, jobs: int, plots: bool, fresh: bool) -> bool:
    """Run, report and show; whether every sequence was finished."""
    from vipe_core.evaluation.report import columns, table_headings, table_rows

    results = _run(tasks, heading, out, jobs, plots, fresh)
    shown = columns(results, heading.unit)
    _show(heading.title, table_headings(shown), table_rows(results, shown))
    return all(result.error is None for result in results)


def _ablate(tasks: Sequence[Task], heading: Heading, out: Path, jobs: int, plots: bool, fresh: bool) -> bool:
    """Every variant of the energy on all tasks, one table; whether every sequence of each was finished."""
    from vipe_core.evaluation.report import ABLATION, ablation_headings, ablation_rows, columns, write_ablation

    by_name: dict[str, list[SequenceResult]] = {}
    for name, terms in ABLATION.items():
        changed = []
        for task in tasks:
            slam = dataclasses.replace(task.measure.preset.slam, terms=terms)
            preset = dataclasses.replace(task.measure.preset, slam=slam)
            changed.append(dataclasses.replace(task, measure=dataclasses.replace(task.measure, preset=preset)))
        facts = dict(heading.facts) | {"configuration": changed[0].measure.preset.config_hash}
        titled = dataclasses.replace(heading, title=f"{heading.title}: {name}", facts=facts)
        by_name[name] = _run(changed, titled, out / name, jobs, plots, fresh)
    facts = {fact: value for fact, value in heading.facts.items() if fact != "configuration"}
    whole = dataclasses.replace(heading, title=f"Ablation: {heading.title}", facts=facts)
    write_ablation(out, whole, by_name)
    shown = columns([result for results in by_name.values() for result in results], heading.unit)
    _show(whole.title, ablation_headings(shown), ablation_rows(by_name, shown))
    return all(result.error is None for results in by_name.values() for result in results)


def _run(
    tasks: Sequence[Task], heading: Heading, out: Path, jobs: int, plots: bool, fresh: bool
) -> list[SequenceResult]:
    """Run what is not done, and write the report with its pictures."""
    from vipe_core.evaluation.plots import plot_paths
    from vipe_core.evaluation.report import write_report
    from vipe_core.evaluation.results import load_paths
    from vipe_core.pipeline.evaluate import run_tasks

    rows = out / "sequences"
    if fresh:
        for task in tasks:
            (rows / f"{task.stem}.json").unlink(missing_ok=True)

    def tell(task: Task, result: SequenceResult, made: bool) -> None:
        state = result.error["code"] if result.error else "done" if made else "done before"
        typer.echo(f"{heading.title}: {result.name}: {state}", err=True)

    results = run_tasks(tasks, rows, jobs, tell)
    pictures: dict[str, str] = {}
    for task, result in zip(tasks, results, strict=True):
        paths = load_paths(rows, task.stem) if plots and result.error is None else None
        if paths is not None:
            picture = Path("figures", f"{task.stem}.png")
            plot_paths(paths, out / picture, result.name)
            pictures[result.name] = picture.as_posix()
    write_report(out, heading, results, pictures)
    return results


def _show(title: str, headings: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    from rich.table import Table
    from rich.text import Text

    from services.cli.tables import print_table

    table = Table(title=Text(title), show_edge=False, pad_edge=False, header_style="bold")
    for number, heading in enumerate(headings):
        # As text: [m] is a unit, not markup.
        table.add_column(Text(heading), justify="left" if number == 0 else "right")
    for row in rows:
        table.add_row(*map(Text, row))
    print_table(table)
