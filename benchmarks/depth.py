"""Dense depth against ground truth, beside stereo matching and the map of the keyframes, with what is asked of it.

    python -m benchmarks.depth [SEQUENCE ...] [--fast] [--plots FOLDER] [--json FILE]
    python -m benchmarks.depth --memory [SEQUENCE] [--fast]

Errors are of static pixels with a true depth, after one scale for the sequence; those of moving pixels stand beside
them, at the same scale. `depth/pose` is that scale over the scale of the path: 1 where both are in the same units.
`temporal` is the median relative difference to the next frame's depth, followed with the estimated poses, of pixels
that no mask holds. CPU-seconds are of the depth stage, decoders included. Below: the mean error of the tenths of the
pixels by rising confidence. Beside it, on the same frames with the same poses: OpenCV's semi-global stereo matcher on
rectified pairs (of the frames that can be rectified), and the inverse depth of the nearest keyframes, interpolated.
The depth sensor of sevenscenes is not registered to its pictures: its pixels are compared with what lies in their
directions.

With --memory, the pictures of a sequence are played forth and back at 320 pixels' width, to 200 and to 2,000 frames:
what the depth stage holds at most must not depend on it.
The status is 1 when something that is asked is not met.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from benchmarks.long_video import Looped
from benchmarks.peers.stereo import stereo_depth
from benchmarks.processes import anonymous_bytes, cpu_s
from benchmarks.sequences import DATA, BenchSequence, find_sequence
from vipe_core.annotation import depth_kind_of
from vipe_core.depth.geometry import KeyframePrior, length_of
from vipe_core.depth.scene import scene_of
from vipe_core.depth.stream import DenseDepth
from vipe_core.depth.types import DepthFrame, DepthSettings, SceneMap
from vipe_core.errors import VipeError
from vipe_core.evaluation.metrics import (
    DepthErrors,
    convert_depth,
    depth_errors,
    depth_pose_scale_ratio,
    trajectory_errors,
)
from vipe_core.evaluation.truth import GroundTruth, read_truth, sample_at_truth
from vipe_core.geometry.arrays import inverse
from vipe_core.pipeline.annotator import Annotator
from vipe_core.priors.classical import classical_priors
from vipe_core.slam.system import Slam
from vipe_core.video import open_source

Array = NDArray[Any]
Samples = list[tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]]


@dataclass(frozen=True, slots=True)
class DepthLimit:
    """What is asked of a sequence; None is not asked.

    Attributes:
        abs_rel: Largest mean relative error of static pixels.
        delta125: Least share within a factor of 1.25.
    """

    abs_rel: float | None = None
    delta125: float | None = None


LIMITS = {
    "room_orbit": DepthLimit(0.025, 0.98),
    "room_handheld": DepthLimit(0.025, 0.98),
    "street_drive": DepthLimit(0.06, 0.94),
    "dynamic_people": DepthLimit(0.07),
    "low_texture": DepthLimit(0.08),
    "sevenscenes": DepthLimit(0.08),
    "hololens": DepthLimit(0.08),
}
_MIN_DENSITY, _MAX_SCALE_OFF, _MAX_TEMPORAL = 0.99, 0.02, 0.015
_CPU_S, _FAST_CPU_S = 2.0, 0.6
# Every so many pixels of a frame are followed into the next one.
_FOLLOW_STEP_PX = 4
# Frames that the stereo matcher is run on.
_STEREO_FRAMES = 15
_LENGTHS, _MEMORY_WIDTH = (200, 2000), 320
_TENTHS = 10


@dataclass
class Collected:
    """What one pass over the depth of a sequence gathers, frames with a true depth only but for `steps`.

    Attributes:
        ours: Depth and truth on the grid of the truth, and which pixels are static.
        confidence: Of the same pixels.
        prior: The keyframes' map of the same frames.
        stereo: The same for those that the stereo matcher was run on.
        steps: Relative differences to the frame before.
        cpu_s: Of the depth stage.
        frames: All frames.
    """

    ours: Samples = field(default_factory=list)
    confidence: list[NDArray[np.float32]] = field(default_factory=list)
    prior: Samples = field(default_factory=list)
    stereo: Samples = field(default_factory=list)
    steps: list[NDArray[np.float32]] = field(default_factory=list)
    cpu_s: float = 0.0
    stereo_cpu_s: float = 0.0
    frames: int = 0


@dataclass(frozen=True, slots=True)
class DepthFigures:
    """Errors of one kind of depth. `moving_abs_rel` is None without moving pixels, `temporal` where it is not asked."""

    static: DepthErrors
    moving_abs_rel: float | None
    depth_pose_ratio: float | None
    temporal: float | None
    cpu_s_per_frame: float | None
    tenths: tuple[float, ...] = ()


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("sequences", nargs="*", metavar="SEQUENCE", help="default: all that something is asked of")
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the shared data")
    parser.add_argument("--fast", action="store_true", help="the fast setting of the depth stage")
    parser.add_argument("--memory", action="store_true", help="measure memory at two lengths instead")
    parser.add_argument("--plots", type=Path, metavar="FOLDER", help="draw error over confidence, and over time")
    parser.add_argument("--json", type=Path, help="also write the figures to this file")
    arguments = parser.parse_args(argv)
    settings = DepthSettings.fast() if arguments.fast else DepthSettings()
    if arguments.memory:
        name = arguments.sequences[0] if arguments.sequences else "room_tour"
        return _memory(find_sequence(name, arguments.data), settings)

    table = _table(arguments.fast)
    calibration = _calibration_table()
    written: dict[str, Any] = {}
    failed = missed = 0
    for name in arguments.sequences or LIMITS:
        try:
            sequence = find_sequence(name, arguments.data)
            truth = read_truth(sequence.truth)
            scene = _scene(sequence)
            collected = collect(sequence, truth, scene, settings)
        except VipeError as error:
            failed += 1
            print(f"{Path(name).name}: {error}", file=sys.stderr)
            continue
        figures = _figures(collected, truth, scene)
        if figures is None:
            print(f"{sequence.name}: no true depth", file=sys.stderr)
            continue
        checks = _checks(LIMITS.get(sequence.name, DepthLimit()), figures["ours"], fast=arguments.fast)
        missed += any(not met for _, met in checks)
        _add_rows(table, calibration, sequence.name, figures, checks)
        written[sequence.name] = {kind: dataclasses.asdict(one) for kind, one in figures.items()}
        if arguments.plots:
            _plot(arguments.plots, sequence.name, collected, figures["ours"])
        print(f"{sequence.name}: {', '.join(t + ('' if met else ' MISSED') for t, met in checks)}", file=sys.stderr)
    console = Console(width=170)
    console.print(table)
    console.print(calibration)
    if arguments.json:
        arguments.json.write_text(json.dumps(written, indent=1, allow_nan=False) + "\n")
    return 1 if failed or missed else 0


def collect(sequence: BenchSequence, truth: GroundTruth, scene: SceneMap, settings: DepthSettings) -> Collected:
    """Runs the depth stage over a sequence, and the others on the same frames."""
    out = Collected()
    row_of = {int(frame): row for row, frame in enumerate(truth.frame_index)}
    source = open_source(sequence.video)
    known = [f for f, row in row_of.items() if truth.depth is not None and (truth.depth[row] > 0).any()]
    chosen = {known[i] for i in np.linspace(0, len(known) - 1, min(len(known), _STEREO_FRAMES)).astype(int)}
    size = (scene.camera.width, scene.camera.height)
    with closing(source.frames(size)) as frames:
        gray = [np.asarray(cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY), np.uint8) for frame in frames]
    keyframes = KeyframePrior(scene)
    before: DepthFrame | None = None
    with closing(DenseDepth(settings).stream(source, scene)) as stream:
        while True:
            started_s = cpu_s()
            frame = next(stream, None)
            out.cpu_s += cpu_s() - started_s
            if frame is None:
                return out
            out.frames += 1
            if before is not None and not any(before.index < cut <= frame.index for cut in scene.cuts):
                out.steps.append(followed(before, frame, scene))
            before = frame
            row = row_of.get(frame.index)
            if row is None or truth.depth is None or frame.index not in known:
                continue
            true = np.asarray(truth.depth[row], np.float32)
            static = np.ones(true.shape, np.bool_) if truth.dynamic is None else ~truth.dynamic[row]
            height, width = true.shape

            def sampled(depth: Array) -> NDArray[np.float32]:
                lens = scene.camera if truth.camera is None else truth.camera
                kind = depth_kind_of(scene.camera)
                return convert_depth(
                    sample_at_truth(np.asarray(depth, np.float32), truth), lens, kind, truth.depth_kind
                )

            out.ours.append((sampled(frame.depth), true, static))
            out.confidence.append(cv2.resize(frame.confidence, (width, height), interpolation=cv2.INTER_AREA))
            prior = keyframes.of(frame.index)
            out.prior.append((sampled(1 / prior.inverse_depth), true, static))
            if frame.index in chosen and scene.camera.model == "pinhole":
                near = float(np.quantile(frame.depth, 0.02))
                started_s = cpu_s()
                poses, middle = scene.world_from_cam, float(np.median(frame.depth))
                stereo = stereo_depth(frame.index, gray.__getitem__, poses, scene.camera, middle, near)
                out.stereo_cpu_s += cpu_s() - started_s
                nothing = np.zeros((scene.camera.height, scene.camera.width), np.float32)
                out.stereo.append((sampled(nothing if stereo is None else stereo), true, static))


def followed(frame: DepthFrame, after: DepthFrame, scene: SceneMap) -> NDArray[np.float32]:
    """Relative differences between the depth of static pixels, carried into the next frame, and that frame's own."""
    height, width = frame.depth.shape
    camera = scene.camera.resized(width, height)
    half = _FOLLOW_STEP_PX // 2
    rows, cols = np.mgrid[half:height:_FOLLOW_STEP_PX, half:width:_FOLLOW_STEP_PX]
    rays = camera.unproject(np.stack([cols, rows], axis=-1).astype(np.float64))
    length = length_of(camera, rays)
    motion = inverse(scene.world_from_cam[after.index]) @ scene.world_from_cam[frame.index]
    points = rays * (frame.depth[rows, cols] / length)[..., None] @ motion[:3, :3].T + motion[:3, 3]
    px, imaged = camera.project(points)
    at = np.rint(np.where(imaged[..., None], px, -1)).astype(np.int64)
    inside = (at >= 0).all(-1) & (at < (width, height)).all(-1) & ~frame.moving[rows, cols]
    there_row, there_col = at[inside][:, 1], at[inside][:, 0]
    still = ~after.moving[there_row, there_col]
    predicted = length_of(camera, points)[inside][still]
    found = after.depth[there_row, there_col][still]
    return np.asarray(np.abs(found / np.maximum(predicted, 1e-12) - 1), np.float32)


def _scene(sequence: BenchSequence) -> SceneMap:
    annotator = Annotator(threads=1)
    slam = Slam(classical_priors(), annotator.preset.slam, annotator.device)
    with torch.inference_mode():
        return scene_of(slam.run(open_source(sequence.video), lambda stage, done, total: None))


def _figures(collected: Collected, truth: GroundTruth, scene: SceneMap) -> dict[str, DepthFigures] | None:
    """Of ours, the stereo matcher and the keyframes' map."""
    ours = depth_errors(collected.ours)
    if ours is None:
        return None
    path = trajectory_errors(
        scene.world_from_cam[truth.frame_index], truth.world_from_cam, truth.frame_index.astype(np.int64)
    )
    temporal = float(np.median(np.concatenate(collected.steps))) if collected.steps else None

    def one(samples: Samples, **more: Any) -> DepthFigures | None:
        errors = depth_errors(samples)
        if errors is None:
            return None
        return DepthFigures(errors, _moving(samples, errors.scale), depth_pose_scale_ratio(errors, path), **more)

    per_frame = collected.cpu_s / collected.frames
    stereo_s = collected.stereo_cpu_s / max(len(collected.stereo), 1)
    found = {
        "ours": one(
            collected.ours,
            temporal=temporal,
            cpu_s_per_frame=per_frame,
            tenths=tuple(_tenths(collected, ours.scale)),
        ),
        "OpenCV stereo": one(collected.stereo, temporal=None, cpu_s_per_frame=stereo_s),
        "keyframes": one(collected.prior, temporal=None, cpu_s_per_frame=None),
    }
    return {kind: figures for kind, figures in found.items() if figures is not None}


def _moving(samples: Samples, scale: float) -> float | None:
    parts = []
    for estimate, true, static in samples:
        valid = ~static & (true > 0) & (estimate > 0)
        parts.append(np.abs(scale * estimate[valid] / true[valid] - 1))
    errors = np.concatenate(parts) if parts else np.zeros(0)
    return float(errors.mean()) if errors.size else None


def _tenths(collected: Collected, scale: float) -> Iterator[float]:
    """Mean relative error of static pixels, in tenths of rising confidence."""
    errors, sure = [], []
    for (estimate, true, static), confidence in zip(collected.ours, collected.confidence, strict=True):
        valid = static & (true > 0) & (estimate > 0)
        errors.append(np.abs(scale * estimate[valid] / true[valid] - 1))
        sure.append(confidence[valid])
    order = np.argsort(np.concatenate(sure), kind="stable")
    for part in np.array_split(np.concatenate(errors)[order], _TENTHS):
        yield float(part.mean()) if part.size else float("nan")


def _checks(limit: DepthLimit, figures: DepthFigures, *, fast: bool) -> list[tuple[str, bool]]:
    """What is asked, in words, and whether it is met."""
    static, most_s = figures.static, _FAST_CPU_S if fast else _CPU_S
    checks = []
    if limit.abs_rel is not None:
        checks.append((f"AbsRel {limit.abs_rel:.1%}", static.abs_rel <= limit.abs_rel))
        checks.append((f"density {_MIN_DENSITY:.0%}", static.density >= _MIN_DENSITY))
        ratio = figures.depth_pose_ratio
        checks.append(("scale 2%", ratio is not None and abs(ratio - 1) <= _MAX_SCALE_OFF))
    if limit.delta125 is not None:
        checks.append((f"d1.25 {limit.delta125:.0%}", static.delta125 >= limit.delta125))
    checks.append((f"temporal {_MAX_TEMPORAL:.1%}", figures.temporal is None or figures.temporal <= _MAX_TEMPORAL))
    checks.append((f"{most_s:g} CPU-s", figures.cpu_s_per_frame is None or figures.cpu_s_per_frame <= most_s))
    return checks


def _table(fast: bool) -> Table:
    table = Table(title=f"Dense depth against ground truth, {'fast' if fast else 'default'} setting")
    for heading in ("sequence", "AbsRel", "d1.25", "moving", "density", "depth/pose", "temporal", "CPU-s/frame"):
        table.add_column(heading, justify="left" if heading == "sequence" else "right", no_wrap=True)
    table.add_column("asked: at most (share, density: at least)")
    table.add_column("met")
    return table


def _calibration_table() -> Table:
    table = Table(title="Mean relative error by tenths of rising confidence")
    table.add_column("sequence", no_wrap=True)
    for tenth in range(1, _TENTHS + 1):
        table.add_column(str(tenth), justify="right")
    return table


def _add_rows(
    table: Table,
    calibration: Table,
    name: str,
    figures: dict[str, DepthFigures],
    checks: Sequence[tuple[str, bool]],
) -> None:
    for kind, one in figures.items():
        mine = kind == "ours"
        misses = [text for text, met in checks if not met]
        table.add_row(
            name if mine else f"  {kind}",
            f"{one.static.abs_rel:.4f}",
            f"{one.static.delta125:.4f}",
            _number(one.moving_abs_rel, 3),
            f"{one.static.density:.3f}",
            _number(one.depth_pose_ratio, 4),
            _number(one.temporal, 4),
            _number(one.cpu_s_per_frame, 2),
            ", ".join(text for text, _ in checks) if mine else "",
            ("yes" if not misses else f"no: {', '.join(misses)}") if mine else "",
            style=None if mine else "dim",
        )
    calibration.add_row(name, *(f"{error:.3f}" for error in figures["ours"].tenths))


def _number(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"


def _plot(folder: Path, name: str, collected: Collected, figures: DepthFigures) -> None:
    """Error over confidence, and the difference between neighbouring frames over time."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 3.6), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    left.plot(np.arange(1, _TENTHS + 1), 100 * np.array(figures.tenths), "o-", color="#1f5fa8")
    left.set(xlabel="tenth of the pixels, by rising confidence", ylabel="mean relative error, %", yscale="log")
    steps = [100 * float(np.median(step)) for step in collected.steps if step.size]
    right.plot(steps, color="#1f5fa8")
    right.axhline(100 * _MAX_TEMPORAL, color="#c05020", linestyle="--")
    right.set(xlabel="frame", ylabel="median difference to the next frame, %", ylim=(0, None))
    figure.suptitle(name)
    folder.mkdir(parents=True, exist_ok=True)
    figure.savefig(folder / f"depth_{name}.png", dpi=110)


def _memory(sequence: BenchSequence, settings: DepthSettings) -> int:
    """Peak memory of the depth stage at two lengths of the same pictures, played forth and back."""
    short = _scene(sequence)
    count = len(short.world_from_cam)
    table = Table(title=f"Depth stage, {sequence.name} played forth and back")
    for heading in ("frames", "CPU-s/frame", "process at most, MiB"):
        table.add_column(heading, justify="right")
    width = _MEMORY_WIDTH
    height = 8 * round(short.camera.height * width / short.camera.width / 8)
    with tempfile.TemporaryDirectory(prefix="vipe-depth-") as folder:
        for length in _LENGTHS:
            source = Looped(open_source(sequence.video), length, (width, height), Path(folder))
            scene = _looped(short, length, count, width, height)
            peak_bytes = 0
            started_s = cpu_s()
            with closing(DenseDepth(settings).stream(source, scene)) as frames:
                for _ in frames:
                    peak_bytes = max(peak_bytes, anonymous_bytes())
            table.add_row(str(length), f"{(cpu_s() - started_s) / length:.3f}", f"{peak_bytes / 2**20:.0f}")
    Console(width=100).print(table)
    return 0


def _looped(scene: SceneMap, length: int, count: int, width: int, height: int) -> SceneMap:
    """The map of the same pictures played forth and back, at another size."""
    turns = (divmod(k, count) for k in range(length))
    places = [count - 1 - place if turn % 2 else place for turn, place in turns]
    number = {int(frame): k for k, frame in enumerate(scene.keyframes)}
    keyframes = [(k, number[place]) for k, place in enumerate(places) if place in number]
    cells = (width // 8, height // 8)

    def resized(maps: Array, how: int) -> NDArray[np.float32]:
        small = [cv2.resize(one, cells, interpolation=how) for one in maps]
        return np.stack([small[k] for _, k in keyframes])

    return SceneMap(
        camera=scene.camera.resized(width, height),
        world_from_cam=scene.world_from_cam[places],
        keyframes=np.array([k for k, _ in keyframes], np.int64),
        inverse_depth=resized(scene.inverse_depth, cv2.INTER_LINEAR),
        confidence=resized(scene.confidence, cv2.INTER_NEAREST),
    )


if __name__ == "__main__":
    sys.exit(main())
