"""Memory, time per frame and time of the global adjustment as a video gets longer.

    python -m benchmarks.long_video [SEQUENCE] [--frames N ...] [--size WIDTHxHEIGHT] [--out FILE]

The video is a sequence (a name of the shared data, of a sample, or a folder) played forth and back until it has N
frames, so a long one sees every place many times. CPU-seconds per frame are of poses and intrinsics without depth; the
memory is what the process holds beyond the pictures of the loop (anonymous memory of this process, the decoders' not
counted). The columns beside are relative to the first length.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from benchmarks.processes import anonymous_bytes, cpu_s
from benchmarks.sequences import DATA, find_sequence
from vipe_core.pipeline.annotator import Annotator
from vipe_core.pipeline.warmup import warm_up
from vipe_core.priors.classical import classical_priors
from vipe_core.quality import assess
from vipe_core.slam.system import Slam
from vipe_core.video import open_source
from vipe_core.video.source import Frame, FrameSource, FrameStream, VideoInfo

_LENGTHS = (250, 1000, 5000)


@dataclass(frozen=True, slots=True)
class LongRun:
    """What one length costs.

    Attributes:
        cpu_s_per_frame: Of all stages but the global adjustment at the end.
        backend_cpu_s: Of the global adjustment at the end.
        peak_bytes: Most anonymous memory at any time.
        start_bytes: The same before the run.
        silence_s: Longest wall time between two signs of progress.
    """

    frames: int
    keyframes: int
    cpu_s_per_frame: float
    backend_cpu_s: float
    start_bytes: int
    peak_bytes: int
    silence_s: float
    reliable: str
    loop_edges: int


class Looped:
    """A `FrameSource` that plays a short one forth and back. Its pictures lie in a file, not in memory."""

    def __init__(self, source: FrameSource, num_frames: int, size: tuple[int, int], folder: Path) -> None:
        self._info = replace(source.info, width=size[0], height=size[1], num_frames_hint=num_frames)
        self._num_frames = num_frames
        path = folder / f"{size[0]}x{size[1]}.raw"
        if not path.exists():
            with path.open("wb") as file, closing(source.frames(size)) as frames:
                for frame in frames:
                    file.write(frame.rgb.tobytes())
        self._pictures: NDArray[np.uint8] = np.memmap(path, np.uint8, "r").reshape(-1, size[1], size[0], 3)

    @property
    def info(self) -> VideoInfo:
        return self._info

    def frames(self, size: tuple[int, int] | None = None, start: int = 0, stop: int | None = None) -> FrameStream:
        count = len(self._pictures)
        for index in range(self._num_frames)[start:stop]:
            there, place = divmod(index, count)
            picture = self._pictures[count - 1 - place if there % 2 else place]
            if size is not None and size != (self._info.width, self._info.height):
                picture = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)
            yield Frame(index, index / 30.0, np.array(picture))


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("sequence", nargs="?", default="room_tour", metavar="SEQUENCE")
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the shared data")
    parser.add_argument("--frames", type=int, nargs="+", default=_LENGTHS, metavar="N")
    parser.add_argument("--size", default="640x480", metavar="WIDTHxHEIGHT")
    parser.add_argument("--out", type=Path, help="also write the figures here, one JSON object a line")
    arguments = parser.parse_args(argv)
    width, height = (int(length) for length in arguments.size.split("x"))
    sequence = find_sequence(arguments.sequence, arguments.data)
    annotator = Annotator()
    runs: list[LongRun] = []
    with tempfile.TemporaryDirectory(prefix="vipe-long-") as folder:
        warm_up(annotator, Path(folder))
        for length in arguments.frames:
            source = Looped(open_source(sequence.video), length, (width, height), Path(folder))
            runs.append(_run(annotator, source))
            if arguments.out:
                with arguments.out.open("a") as file:
                    file.write(json.dumps(asdict(runs[-1])) + "\n")
    _print(runs, sequence.name)
    return 0


def _run(annotator: Annotator, source: Looped) -> LongRun:
    spent_s: dict[str, float] = {}
    start_bytes = peak_bytes = anonymous_bytes()
    last_s, last_cpu_s, silence_s = time.perf_counter(), cpu_s(), 0.0

    def report(stage: str, done: int, total: int | None) -> None:
        nonlocal last_s, last_cpu_s, silence_s, peak_bytes
        now_s, now_cpu_s = time.perf_counter(), cpu_s()
        spent_s[stage] = spent_s.get(stage, 0.0) + now_cpu_s - last_cpu_s
        silence_s = max(silence_s, now_s - last_s)
        last_s, last_cpu_s = now_s, now_cpu_s
        peak_bytes = max(peak_bytes, anonymous_bytes())

    settings = annotator.preset.slam
    slam = Slam(classical_priors(), settings, annotator.device)
    with torch.inference_mode():
        result = slam.run(source, report)
    quality = assess(result, settings, source.info.width)
    count = len(result.timestamps_s)
    backend_s = spent_s.get("backend", 0.0)
    return LongRun(
        frames=count,
        keyframes=len(result.keyframes),
        cpu_s_per_frame=(sum(spent_s.values()) - backend_s) / count,
        backend_cpu_s=backend_s,
        start_bytes=start_bytes,
        peak_bytes=max(peak_bytes, anonymous_bytes()),
        silence_s=silence_s,
        reliable=quality.reliable,
        loop_edges=quality.loop_edges,
    )


def _print(runs: Sequence[LongRun], name: str) -> None:
    table = Table(title=f"{name}, played forth and back")
    for column in ("frames", "keyframes", "CPU-s/frame", "x", "backend CPU-s", "CPU-ms/keyframe", "x"):
        table.add_column(column, justify="right")
    for column in ("peak MiB", "KiB/keyframe", "silence s", "loop edges", "reliable"):
        table.add_column(column, justify="right")
    first = runs[0]
    for run in runs:
        backend_ms, first_ms = (1000 * r.backend_cpu_s / max(r.keyframes, 1) for r in (run, first))
        grown = run.peak_bytes - run.start_bytes
        table.add_row(
            str(run.frames),
            str(run.keyframes),
            f"{run.cpu_s_per_frame:.3f}",
            f"{run.cpu_s_per_frame / first.cpu_s_per_frame:.2f}",
            f"{run.backend_cpu_s:.1f}",
            f"{backend_ms:.1f}",
            f"{backend_ms / max(first_ms, 1e-9):.2f}",
            f"{run.peak_bytes / 2**20:.0f}",
            f"{grown / 1024 / max(run.keyframes, 1):.0f}",
            f"{run.silence_s:.1f}",
            str(run.loop_edges),
            run.reliable,
        )
    Console(width=140).print(table)


if __name__ == "__main__":
    sys.exit(main())
