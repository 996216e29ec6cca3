"""`vipectl annotate`: the engine on this machine, without the service."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from services.cli.engine_options import CameraModel, DetectionInterval, Device, Preset, listed

if TYPE_CHECKING:
    from vipe_core.annotation import Annotation
    from vipe_core.pipeline.annotator import Annotator


def annotate(
    output: Annotated[
        Path,
        typer.Option(
            "-o", "--output", metavar="OUT", help="Gets pose/, intrinsics/, depth/, rgb/, mask/, confidence/."
        ),
    ],
    inputs: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="INPUT...", help="Video files, or directories of images. With --rig, one per view, in their order."
        ),
    ] = None,
    preset: Preset = "classical",
    camera: CameraModel = None,
    device: Device = "cpu",
    masks: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="One PNG per frame of the one INPUT; what is not zero in it is not used."),
    ] = None,
    scale_from: Annotated[
        str | None,
        typer.Option(
            metavar="KNOWN",
            help="A known length, which makes the scale metric: path=METRES that the camera goes, height=METRES of the "
            "camera above the ground, or depth=METRES@X,Y,FRAME from the camera to what a pixel of a frame shows.",
        ),
    ] = None,
    rig: Annotated[
        Path | None,
        typer.Option(
            metavar="RIG.json",
            help="The inputs are the synchronised views of one rig (docs/rigs.md); without inputs, those that the file "
            "names. Writes one sequence per view, and the rig as it was found.",
        ),
    ] = None,
    phrases: Annotated[
        str | None,
        typer.Option(
            metavar="A,B,...",
            help="Find, follow and mask what these words name (extra hf); '' for nothing. Default: the preset's own.",
        ),
    ] = None,
    detection_interval: DetectionInterval = None,
    metric_depth: Annotated[
        str | None,
        typer.Option(metavar="NETWORK", help="What tells the scale, such as hf.depth_pro or nvidia_vipe.unidepth."),
    ] = None,
    tracks: Annotated[
        str | None,
        typer.Option(
            metavar="FOLLOWER",
            help="Tracks beside the DROID network: classical.corners, cuvslam.odometry (PyCuVSLAM) or none. "
            "Default: corners with vipe, none with vipe_fast and pose_only.",
        ),
    ] = None,
    calibration: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="The camera, where it is known: our camera.json, COLMAP's cameras.txt, OpenCV's YAML or XML, or "
            "nerfstudio's transforms.json. What it says of `use` decides: fixed, or initial for a starting point.",
        ),
    ] = None,
    low_memory: Annotated[
        bool,
        typer.Option("--low-memory", help="On a GPU: slower, in less of its memory; what does not fit does so itself."),
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON line per input on stdout, nothing else.")] = False,
) -> None:
    """Annotate videos on this machine, without the service.

    Writes poses, intrinsics, dense depth and the frames in ViPE's artifact layout. Exit code 1 if any input failed.
    """
    from rich.console import Console

    from services.cli.settings import read_settings
    from vipe_core.cameras.calibration_files import read_calibration
    from vipe_core.depth.known import KnownLength
    from vipe_core.errors import ConfigError, VipeError
    from vipe_core.formats import SequenceNames
    from vipe_core.pipeline.presets import PresetOptions, resolve
    from vipe_core.video.limits import use_limits

    paths = list(inputs or [])
    if not paths and rig is None:
        raise typer.BadParameter("give at least one input, or a rig that names its videos", param_hint="INPUT")
    if rig is not None and masks is not None:
        raise typer.BadParameter("the views of a rig take no masks", param_hint="--masks")
    if masks is not None and len(paths) > 1:
        raise typer.BadParameter(f"the masks are of one input, not of {len(paths)}", param_hint="--masks")
    if scale_from is not None:
        try:
            KnownLength.parse(scale_from)
        except ConfigError as error:
            raise typer.BadParameter(str(error), param_hint="--scale-from") from error
    if calibration is not None and camera is not None:
        raise typer.BadParameter("the calibration says which model the camera has", param_hint="--camera")
    if calibration is not None and rig is not None:
        raise typer.BadParameter("the file of the rig holds the calibrations of its views", param_hint="--calibration")
    try:
        known = None if calibration is None else read_calibration(calibration)
    except ConfigError as error:
        raise typer.BadParameter(str(error), param_hint="--calibration") from error
    use_limits(read_settings().media_limits())
    console = Console(stderr=True, quiet=as_json)
    words = None if phrases is None else tuple(listed(phrases))
    options = PresetOptions(words, detection_interval, metric_depth, tracks)
    if rig is not None:
        if options != PresetOptions():
            raise typer.BadParameter("a rig is annotated without networks for masks and scale", param_hint="--rig")
        from services.cli.annotate_rig import annotate_rig

        engine = {"preset": preset, "camera": camera, "device": device}
        views = annotate_rig(rig, paths, output, scale_from, engine, console)
        if as_json:
            for row in views:
                _print_json(row)
        _show(views, output, as_json=as_json, stages=False)
        return
    chosen = resolve(preset, camera, options)
    # What was asked wrongly is answered before the engine's libraries are loaded, which takes seconds.
    from vipe_core.pipeline.annotator import Annotator

    annotator = Annotator(preset=chosen, device=device)
    names = SequenceNames(output)
    rows: list[dict[str, Any]] = []
    for path in paths:
        started = time.perf_counter()
        try:
            how = {"masks": masks, "scale_from": scale_from, "calibration": known, "low_memory": low_memory}
            row = _annotate_one(annotator, path, output, names.name_for(path), how, console)
            row["seconds"] = round(time.perf_counter() - started, 3)
            row["frames_per_s"] = round(row["num_frames"] / row["seconds"], 3)
        except VipeError as error:
            row = {"input": str(path), "error": {"code": error.code, "message": str(error)}}
            console.print(f"[red]{path}: {error} \\[{error.code}]", highlight=False)
        rows.append(row)
        if as_json:
            _print_json(row)
    _show(rows, output, as_json=as_json)


def _print_json(row: dict[str, Any]) -> None:
    sys.stdout.write(json.dumps(row) + "\n")
    sys.stdout.flush()


def _show(rows: list[dict[str, Any]], output: Path, *, as_json: bool, stages: bool = True) -> None:
    """Tables of what was done, and of what took how long unless rows share it; exit code 1 if anything failed."""
    done = [row for row in rows if "error" not in row]
    if done and not as_json:
        from services.cli.tables import annotation_table, print_table, results_console, stage_table

        print_table(annotation_table(done))
        if stages:
            print_table(stage_table(done))
        results_console().print(f"Written to {output.resolve()}", soft_wrap=True)
    if len(done) < len(rows):
        raise typer.Exit(1)


def _annotate_one(
    annotator: Annotator,
    path: Path,
    output: Path,
    name: str,
    how: dict[str, Any],
    console: Any,
) -> dict[str, Any]:
    """The row of one input; `how` are arguments of `Annotator.annotate`."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    from vipe_core.annotation import Progress as EngineProgress
    from vipe_core.formats import write_artifacts

    columns = (
        TextColumn("{task.fields[video]}"),
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=console, transient=True) as bars:
        task = bars.add_task("opening", video=path.name, total=None)

        def report(progress: EngineProgress) -> None:
            bars.update(task, description=progress.stage, completed=progress.frames_done, total=progress.frames_total)

        annotation = annotator.annotate(path, name=name, progress=report, **how)

        def written(done: int, total: int) -> None:
            bars.update(task, description="depth", completed=done, total=total)

        write_artifacts(annotation, output, progress=written)
    return annotation_row(path, annotation, output)


def annotation_row(path: Path, annotation: Annotation, output: Path) -> dict[str, Any]:
    return {
        "input": str(path),
        "name": annotation.name,
        "output": str(output),
        "num_frames": annotation.num_frames,
        "num_keyframes": len(annotation.keyframes),
        "width": annotation.camera.width,
        "height": annotation.camera.height,
        "camera_model": annotation.camera.model,
        "camera_params": list(annotation.camera.params),
        "fov_x_deg": round(annotation.camera.fov_x_deg, 4),
        "trajectory_length": round(annotation.trajectory_length, 6),
        "scale": annotation.scale,
        "scale_source": annotation.provenance.scale_source,
        "quality": annotation.quality.summary(),
        "timings_s": {stage: round(seconds, 3) for stage, seconds in annotation.timings_s.items()},
        "peak_bytes": dict(annotation.peak_bytes),
    }
