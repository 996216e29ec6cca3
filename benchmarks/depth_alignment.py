"""Alignment of video depth to the map, and metric scale, on sequences with exact truth and models of stated errors.

    python -m benchmarks.depth_alignment [SEQUENCE ...] [--data FOLDER]

Poses and map are the engine's own. Video depth is the true depth with the errors that a row states, in windows of 32
frames that agree only up to scale and shift. AbsRel (and the share of pixels within 25 %) is over all static pixels
with truth, after one scale for the sequence; a jump is the change of a frame's median depth over the truth from one
frame to the next. Beside ours: the model's output with nothing but a scale; one scale and shift for the video; the
rule of the original implementation (plain least squares between the 10 and 90 % quantiles, momentum 0.99); and, as the
bound, the best scale and shift of every frame for the truth itself. Ours is measured at source size, the others at the
model's.

Then metric scale: from metric depth whose pictures are off by 20 % (1 sigma) and one in ten by a factor of 3, over ten
seeds; from the camera's true height; its true path; and true distances of nine pixels. Errors are against the scale
that aligns the poses with the truth.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from benchmarks.sequences import DATA, find_sequence
from vipe_core.depth.aligned import AlignedDepth
from vipe_core.depth.alignment import Samples, guess, measure
from vipe_core.depth.anchors import AnchorFinder
from vipe_core.depth.known import KnownLength
from vipe_core.depth.scale import normalised
from vipe_core.depth.scene import scene_of
from vipe_core.depth.types import SceneMap
from vipe_core.depth.windows import stitched
from vipe_core.errors import FormatError, ScaleUnobservable, VipeError
from vipe_core.evaluation.synthetic.depth_models import DistortedVideoDepth, Distortion, NoisyMetricDepth
from vipe_core.evaluation.truth import GroundTruth, read_truth
from vipe_core.geometry import umeyama
from vipe_core.pipeline.presets import resolve
from vipe_core.pipeline.scaling import set_scale
from vipe_core.priors.classical import classical_priors
from vipe_core.priors.protocols import DepthFamily
from vipe_core.slam.system import Slam
from vipe_core.video import open_source
from vipe_core.video.source import FrameSource

Array = NDArray[Any]

_DISTORTIONS = {
    "exact but for windows": Distortion(drift=0, smooth=0, noise=0, outliers=0),
    "3 % shared, 2 % noise, 2 % outliers, drift 1 %": Distortion(),
    "the same, drift 3 %": Distortion(drift=0.03, window_scale=1.0),
    "the same, a quarter wrong by half": Distortion(wrong=0.25),
}
_SEEDS = range(10)
_FLOOR = 1e-3


@dataclass(frozen=True, slots=True)
class _Sequence:
    """A sequence as the engine found it, and its truth."""

    name: str
    source: FrameSource
    scene: SceneMap
    truth: GroundTruth
    depth: Array
    size: tuple[int, int]
    metres_per_unit: float


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    default = ["room_tour"] + [n for n in ("street_drive", "dynamic_people") if (DATA / "synthetic" / n).is_dir()]
    parser.add_argument("sequences", nargs="*", default=default, metavar="SEQUENCE")
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the shared data")
    arguments = parser.parse_args(argv)
    console, failed = Console(width=140), 0
    for name in arguments.sequences:
        try:
            sequence = _open(name, arguments.data)
            _print_alignment(console, sequence)
            _print_scale(console, sequence)
        except VipeError as error:
            failed += 1
            print(f"{name}: {error}", file=sys.stderr)
    return 1 if failed else 0


def _open(name: str, data: Path) -> _Sequence:
    torch.set_num_threads(1)
    found = find_sequence(name, data)
    source, truth = open_source(found.video), read_truth(found.truth)
    if truth.depth is None or not np.array_equal(truth.frame_index, np.arange(truth.depth.shape[0])):
        raise FormatError(f"{name}: the truth lacks the depth of every frame")
    with torch.inference_mode():
        result = Slam(classical_priors(), resolve("classical").slam, torch.device("cpu")).run(source, _silent)
    scene = normalised(scene_of(result))
    scale = umeyama(scene.world_from_cam[:, :3, 3], truth.world_from_cam[:, :3, 3]).scale
    depth = np.stack([np.asarray(truth.depth[row], np.float32) for row in range(truth.depth.shape[0])])
    return _Sequence(found.name, source, scene, truth, depth, (source.info.width // 2, source.info.height // 2), scale)


def _silent(stage: str, done: int, total: int | None) -> None:
    """Nobody watches."""


def _print_alignment(console: Console, sequence: _Sequence) -> None:
    frames = len(sequence.depth)
    for title, distortion in _DISTORTIONS.items():
        video = DistortedVideoDepth(
            sequence.source, sequence.depth, sequence.truth.depth_kind, sequence.size, distortion
        )
        family = DepthFamily(video=video)
        maps, samples = _what_is_aligned(sequence, family)
        rows = {
            "a scale alone": [np.maximum(x, _FLOOR * float(np.nanmedian(x))) for x in maps],
            "one scale and shift": _one_for_all(maps, samples),
            "momentum 0.99": _momentum(maps, samples),
            "ours": [1 / frame.depth for frame in AlignedDepth(family).stream(sequence.source, sequence.scene)],
            "bound": _bound(maps, sequence),
        }
        table = Table(title=f"{sequence.name}, {frames} frames: {title}")
        for heading in ("", "AbsRel", "median", "within 25 %", "largest jump", "median jump"):
            table.add_column(heading, justify="right" if heading else "left")
        for name, inverse in rows.items():
            table.add_row(name, *_errors(inverse, sequence), style="bold" if name == "ours" else None)
        console.print(table)


def _what_is_aligned(sequence: _Sequence, family: DepthFamily) -> tuple[list[Array], list[Samples]]:
    """The stitched video depth of all frames, and what each is aligned to."""
    assert family.video is not None
    finder = AnchorFinder(sequence.scene, family, family.video.depth_kind, sequence.size, metres=False)
    maps, samples = [], []
    with closing(sequence.source.frames(size=sequence.size)) as frames:
        for frame, found in stitched(family.video, frames):
            maps.append(found)
            samples.append(finder.of(frame, found).samples)
    return maps, samples


def _one_for_all(maps: list[Array], samples: list[Samples]) -> list[Array]:
    pooled = Samples(
        np.concatenate([s.video for s in samples])[::7],
        np.concatenate([s.scene for s in samples])[::7],
        np.concatenate([s.weight for s in samples])[::7],
    )
    start = guess(pooled.video, float(np.median(pooled.scene)))
    found = measure(pooled, start)
    alpha, beta = start if found is None else found.solution(start)
    return [np.maximum(alpha * x + beta, _FLOOR) for x in maps]


def _momentum(maps: list[Array], samples: list[Samples], momentum: float = 0.99) -> list[Array]:
    """The original's rule, on the same samples."""
    out, state = [], None
    for x, sample in zip(maps, samples, strict=True):
        use = np.isfinite(sample.video)
        for values in (sample.video, sample.scene):
            low, high = np.quantile(values[use], (0.1, 0.9))
            use = use & (values > low) & (values < high)
        if use.sum() >= 2:
            fit = np.polyfit(sample.video[use], sample.scene[use], 1)
            state = fit if state is None else momentum * state + (1 - momentum) * fit
        alpha, beta = (1.0, 0.0) if state is None else state
        out.append(np.maximum(alpha * x + beta, _FLOOR))
    return out


def _bound(maps: list[Array], sequence: _Sequence) -> list[Array]:
    """Every frame's best scale and shift for the truth."""
    out = []
    for index, x in enumerate(maps):
        inverse, valid = _true(sequence, index)
        at = cv2.resize(x, (inverse.shape[1], inverse.shape[0]), interpolation=cv2.INTER_NEAREST).astype(np.float64)
        use = valid & np.isfinite(at)
        start = guess(at[use], float(np.median(inverse[use])))
        found = measure(Samples(at[use], inverse[use], np.ones(int(use.sum()))), start)
        alpha, beta = start if found is None else found.solution(start)
        out.append(np.maximum(alpha * x + beta, _FLOOR * float(np.median(inverse[use]))))
    return out


def _true(sequence: _Sequence, index: int) -> tuple[Array, Array]:
    """Inverse depth, and where it is known and nothing moves."""
    depth = sequence.depth[index].astype(np.float64)
    valid = depth > 0
    if sequence.truth.dynamic is not None:
        valid &= ~sequence.truth.dynamic[index]
    return 1 / np.where(valid, depth, 1), valid


def _errors(inverse: Sequence[Array], sequence: _Sequence) -> list[str]:
    logs, level = [], []
    for index, found in enumerate(inverse):
        true, valid = _true(sequence, index)
        at = cv2.resize(found, (true.shape[1], true.shape[0]), interpolation=cv2.INTER_NEAREST)
        valid = valid & np.isfinite(at)
        logs.append(np.log(true[valid] / at[valid]))
        level.append(float(np.median(logs[-1])))
    every = np.concatenate(logs) - float(np.median(np.concatenate(logs)))
    error, jump = np.abs(np.exp(every) - 1), np.abs(np.diff(level))
    near = float((np.abs(every) < math.log(1.25)).mean())
    return [
        f"{100 * float(error.mean()):.2f} %",
        f"{100 * float(np.median(error)):.2f} %",
        f"{100 * near:.1f} %",
        f"{100 * float(jump.max()):.2f} %",
        f"{100 * float(np.median(jump)):.2f} %",
    ]


def _print_scale(console: Console, sequence: _Sequence) -> None:
    table = Table(title=f"{sequence.name}: metres per unit")
    for heading in ("from", "error", "1 sigma said", "largest error over its sigma"):
        table.add_column(heading, justify="left" if heading == "from" else "right")
    height_m = float(np.median(sequence.truth.world_from_cam[:, 2, 3]))
    path_m = float(np.linalg.norm(np.diff(sequence.truth.world_from_cam[:, :3, 3], axis=0), axis=1).sum())
    # A seed of metric depth, or a known length. The world of the rendered sequences has z up and the ground at 0.
    tries: dict[str, Sequence[int | str]] = {
        f"metric depth, {len(_SEEDS)} seeds": _SEEDS,
        f"height={height_m:.3f}": [f"height={height_m}"],
        f"path={path_m:.3f}": [f"path={path_m}"],
        "depth of nine pixels": _known_pixels(sequence),
    }
    for name, each in tries.items():
        found, missing = [], 0
        for attempt in each:
            try:
                found.append(_scaled(sequence, attempt))
            except ScaleUnobservable as error:
                missing += 1
                reason = str(error)
        if not found:
            table.add_row(name, reason)
            continue
        errors, sigmas = np.abs(np.log([value for value, _ in found])), np.array([sigma for _, sigma in found])
        label = name + (f" ({missing} unobservable)" if missing else "")
        worst = f", at most {100 * errors.max():.2f} %" if len(errors) > 1 else ""
        table.add_row(
            label,
            f"{100 * float(np.median(errors)):.2f} %{worst}",
            f"{100 * float(np.median(sigmas)):.2f} %",
            f"{float((errors / sigmas).max()):.1f}",
        )
    console.print(table)


def _scaled(sequence: _Sequence, attempt: int | str) -> tuple[float, float]:
    """Metres per unit over the true ones, and the standard deviation of its logarithm."""
    known, metric = None, None
    if isinstance(attempt, str):
        known = KnownLength.parse(attempt)
    else:
        kind = sequence.truth.depth_kind
        metric = NoisyMetricDepth(sequence.source, sequence.depth, kind, sequence.size, seed=attempt)
    scaled = set_scale(sequence.scene, sequence.source, known, metric, _silent)
    after, before = (
        float(np.linalg.norm(np.diff(scene.world_from_cam[:, :3, 3], axis=0), axis=1).sum())
        for scene in (scaled.scene, sequence.scene)
    )
    return after / before / sequence.metres_per_unit, scaled.sigma_ratio


def _known_pixels(sequence: _Sequence) -> list[str]:
    """Nine pixels of the middle frame with their true distances, as the user would say them."""
    index, camera = len(sequence.depth) // 2, sequence.truth.camera
    assert camera is not None
    depth = sequence.depth[index]
    small = camera.resized(depth.shape[1], depth.shape[0])
    out = []
    for row in (1, 2, 3):
        for column in (1, 2, 3):
            v, u = row * depth.shape[0] // 4, column * depth.shape[1] // 4
            if depth[v, u] > 0:
                length = float(np.linalg.norm(small.unproject(np.array([u, v]))))
                distance_m = float(depth[v, u]) * (length if sequence.truth.depth_kind == "z" else 1.0)
                x, y = (u + 0.5) * camera.width / small.width, (v + 0.5) * camera.height / small.height
                out.append(f"depth={distance_m:.4f}@{x:.1f},{y:.1f},{index}")
    return out


if __name__ == "__main__":
    raise SystemExit(main())
