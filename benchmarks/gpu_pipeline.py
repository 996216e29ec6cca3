"""Speed of the network's SLAM on a device: frames per second for several videos at once, stage by stage.

    python -m benchmarks.gpu_pipeline [--device cuda] [--videos 1 2 4 8] [--frames N] [--lean] [--vipe FOLDER]

Weights are random and seeded, so nothing that a network sees may decide anything: every n-th frame is a keyframe, none
is dropped, and edges join each keyframe with the three before it. The counts are printed. Each video has a process of
its own, as in the service; the clock runs from when all of them are ready to when the last is done. Without --device
the first GPU is taken; on a machine without one, a tiny clip on the CPU shows that the command works, and says so.

`--vipe` is an unpacked source distribution of nvidia-vipe 1.2.0: its SLAM then does the same to the same clip with the
same weights, see `peers/vipe_slam.py`. On a GPU its extension must have been built there (`python setup.py build_ext
--inplace`, with nvcc and Eigen).
"""

from __future__ import annotations

import argparse
import multiprocessing
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from multiprocessing.synchronize import Barrier
from pathlib import Path
from queue import Empty, Queue
from threading import BrokenBarrierError

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from benchmarks.network_slam import FOV_DEG, FPS, NetworkSlam
from vipe_core.cameras import Camera
from vipe_core.pipeline.device import device_memory_bytes, resolve_device, set_threads
from vipe_core.pipeline.memory import USABLE_SHARE, plan_of
from vipe_core.pipeline.presets import resolve
from vipe_core.priors.droid import DroidNetwork
from vipe_core.slam.recurrent.posing import Unposed
from vipe_core.slam.selection import Keyframe
from vipe_core.slam.settings import SlamSettings
from vipe_core.slam.timing import StageClock
from vipe_core.slam.working import working_size
from vipe_core.video import open_source
from vipe_core.video.encode import VideoWriter

_SEED = 1
_PATIENCE_S = 3600.0


@dataclass(frozen=True, slots=True)
class Workload:
    """What every video is.

    Attributes:
        video: The clip.
        every: Every so many-th frame is a keyframe.
        device: Where networks and bundle adjustment run.
        settings: Of the SLAM stage, with a schedule that nothing of the picture decides.
        vipe: Source of nvidia-vipe, which then does the work; None for ours.
    """

    video: Path
    every: int
    device: str
    settings: SlamSettings
    vipe: Path | None = None


@dataclass(frozen=True, slots=True)
class Run:
    """One video's part: frames, keyframes, edges of the global graph, seconds by stage, most bytes on the GPU."""

    frames: int
    keyframes: int
    edges: int
    seconds: dict[str, float]
    peak_bytes: int


class WorkerFailed(Exception):
    """A process that annotates a video ended without an answer."""


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--device", help="cuda, cuda:N or cpu")
    parser.add_argument("--videos", type=int, nargs="+", help="how many at once, one run for each")
    parser.add_argument("--frames", type=int, help="of each video")
    parser.add_argument("--size", help="of the video, WIDTHxHEIGHT")
    parser.add_argument("--every", type=int, help="every n-th frame is a keyframe")
    parser.add_argument("--vipe", type=Path, help="unpacked source of nvidia-vipe, to run beside ours")
    parser.add_argument("--lean", action="store_true", help="no volumes of correlation: the profile for small GPUs")
    parser.add_argument("--short", action="store_true", help="few updates, as without a GPU: not for speed")
    arguments = parser.parse_args(argv)
    device = resolve_device(arguments.device or ("cuda" if torch.cuda.is_available() else "cpu"))
    on_gpu = device.type == "cuda"
    width, height = (int(side) for side in (arguments.size or ("640x480" if on_gpu else "128x128")).split("x"))
    frames = arguments.frames or (300 if on_gpu else 20)
    every = arguments.every or (6 if on_gpu else 2)
    counts = arguments.videos or ([1, 2, 4, 8] if on_gpu else [1, 2])
    settings = _settings(lean=arguments.lean, short=arguments.short or not on_gpu)

    console = Console(width=120)
    if not on_gpu:
        console.print("No GPU: a tiny clip with a short schedule on the CPU. Its figures say nothing about speed.")
    console.print(f"device: {torch.cuda.get_device_name(device) if on_gpu else 'cpu'}, torch {torch.__version__}")
    _print_plan(console, settings, width, height, frames // every + 1, device)
    with tempfile.TemporaryDirectory(prefix="vipe-gpu-") as folder:
        video = moving_clip(Path(folder) / "clip.mp4", frames, width, height)
        workload = Workload(video, every, str(device), settings)
        table = Table(title=f"{frames} frames of {width}x{height}, random weights, a fixed schedule")
        for heading in ("whose", "videos at once", "frames/s", "wall s", "GB at most", "keyframes", "edges"):
            table.add_column(heading, justify="right")
        table.add_column("seconds by stage")
        both = [("ours", workload)]
        if arguments.vipe is not None:
            both.append(("nvidia-vipe", replace(workload, vipe=arguments.vipe)))
        failed = False
        for count, (whose, work) in ((count, one) for count in counts for one in both):
            try:
                wall_s, runs = _at_once(work, count)
            except WorkerFailed as error:
                failed = True
                row = ["failed", "", "", "", "", str(error)]
            else:
                row = _row(wall_s, runs, on_gpu=on_gpu)
            table.add_row(whose, str(count), *row)
            # Whatever ends this command later.
            print(whose, count, *row, sep=" | ", file=sys.stderr, flush=True)
        console.print(table)
    return int(failed)


def _row(wall_s: float, runs: Sequence[Run], *, on_gpu: bool) -> list[str]:
    stages = (f"{stage} {np.mean([run.seconds[stage] for run in runs]):.2f}" for stage in runs[0].seconds)
    return [
        f"{sum(run.frames for run in runs) / wall_s:.2f}",
        f"{wall_s:.2f}",
        f"{max(run.peak_bytes for run in runs) / 1e9:.2f}" if on_gpu else "-",
        str(runs[0].keyframes),
        str(runs[0].edges),
        ", ".join(stages),
    ]


def _settings(*, lean: bool, short: bool) -> SlamSettings:
    slam = resolve("pose_only").slam
    schedule = replace(slam.refinement, redundant_px=0.0, window_px=0.0, global_px=0.0, lean=lean)
    if short:
        schedule = replace(
            schedule, first_updates=2, updates=1, more_updates=1, global_updates=(1, 1, 2), fill_updates=2
        )
    return replace(slam, refinement=schedule)


def _at_once(workload: Workload, count: int) -> tuple[float, list[Run]]:
    """Seconds from when all videos are ready to when the last is done, and each one's part.

    Raises:
        WorkerFailed: A process ended without an answer, as where memory runs out.
    """
    context = multiprocessing.get_context("spawn")
    ready, answers = context.Barrier(count + 1), context.Queue()
    workers = [context.Process(target=_worker, args=(workload, ready, answers)) for _ in range(count)]
    for worker in workers:
        worker.start()
    try:
        ready.wait(_PATIENCE_S)
        start_s = time.perf_counter()
        runs: list[Run] = []
        while len(runs) < count:
            try:
                runs.append(answers.get(timeout=1.0))
            except Empty:
                if any(worker.exitcode for worker in workers):
                    raise WorkerFailed("a worker failed; it says why above") from None
        wall_s = time.perf_counter() - start_s
    except BrokenBarrierError as error:
        raise WorkerFailed("a worker failed before it was ready; it says why above") from error
    finally:
        for worker in workers:
            worker.join(1.0)
            worker.terminate()
    return wall_s, runs


def _worker(workload: Workload, ready: Barrier, answers: Queue[Run]) -> None:
    try:
        run = _ready(workload)
    except BaseException:
        ready.abort()
        raise
    ready.wait(_PATIENCE_S)
    answers.put(run(None))


def _ready(workload: Workload) -> Callable[[int | None], Run]:
    """What annotates the first so many frames of the clip, warmed up."""
    set_threads(1)
    device = resolve_device(workload.device)
    run: Callable[[int | None], Run]
    if workload.vipe is None:
        network = DroidNetwork.random(_SEED).ready(device)
        run = partial(_annotate, workload, network)
    else:
        run = _vipe(workload, workload.vipe, device)
    run(9 * workload.every + 1)  # kernels are compiled and memory is there
    return run


def _vipe(workload: Workload, folder: Path, device: torch.device) -> Callable[[int | None], Run]:
    """The same work by nvidia-vipe."""
    from benchmarks.peers import vipe_slam

    settings = workload.settings
    info = open_source(workload.video).info
    size = working_size(info.width, info.height, settings.working_area_px)
    focal_px = Camera.pinhole_from_fov(FOV_DEG, size.width, size.height).focal_px
    _, *steps = settings.refinement.global_updates
    state = DroidNetwork.random(_SEED).state_dict()
    slam = vipe_slam.VipeSlam(vipe_slam.load(folder), state, size.size, focal_px, (steps[0], steps[1]), device)

    def run(frames: int | None) -> Run:
        clock = StageClock(device)
        done = slam.run(islice(vipe_slam.frames_of(workload.video), frames), workload.every, clock)
        peak_bytes = max(clock.peak_bytes.values(), default=0)
        return Run(done.frames, done.keyframes, done.edges, clock.seconds, peak_bytes)

    return run


def _annotate(workload: Workload, network: DroidNetwork, frames: int | None = None) -> Run:
    """One video with the pieces that the engine is made of, and a schedule in the place of its decisions."""
    settings = workload.settings
    clock = StageClock(network.device)
    slam = NetworkSlam.of(open_source(workload.video), network, settings)
    built = slam.built
    keyframes: list[Keyframe] = []
    with clock("decode and encode"), closing(slam.frames.first_pass()) as stream:
        for work, features in stream:
            if keyframes:
                slam.matcher.motion_px(keyframes[-1].features, features)  # It decides nothing, and takes its time.
            if work.index % workload.every == 0:
                keyframes.append(Keyframe(work.index, features))
            if frames is not None and work.index + 1 == frames:
                break
    count = len(slam.frames)
    with torch.inference_mode():
        with clock("track"):
            for _ in slam.track(keyframes):
                pass
        with clock("backend"):
            for updates in settings.refinement.global_updates[1:]:
                slam.backend.run(updates)
        with clock("infill"):
            poser = slam.poser()
            waiting: list[Unposed] = []
            with closing(slam.frames.again(0, count)) as stream:
                for index, features in stream:
                    before = min(index // workload.every, len(built) - 2)
                    if index % workload.every:
                        waiting.append(Unposed(features, built.pose(before), (before, before + 1)))
                    if len(waiting) == settings.infill_batch or (waiting and index == count - 1):
                        poser.run(waiting)
                        waiting = []
    return Run(count, len(built), len(slam.graph), clock.seconds, max(clock.peak_bytes.values(), default=0))


def moving_clip(path: Path, frames: int, width: int, height: int) -> Path:
    """A smooth random picture that the camera pans over."""
    rng = np.random.default_rng(_SEED)
    coarse = torch.from_numpy(rng.uniform(0, 255, (1, 3, height // 8 + 2, width // 8 + frames // 4 + 2)))
    wide = torch.nn.functional.interpolate(coarse, scale_factor=8, mode="bicubic")[0].clamp(0, 255)
    picture = wide.permute(1, 2, 0).numpy().astype(np.uint8)
    with VideoWriter(path, FPS) as writer:
        for index in range(frames):
            writer.write(np.ascontiguousarray(picture[:height, 2 * index : 2 * index + width]))
    return path


def _print_plan(
    console: Console, settings: SlamSettings, width: int, height: int, keyframes: int, device: torch.device
) -> None:
    grid = working_size(width, height, settings.working_area_px).grid
    preset = resolve("pose_only")
    for lean in (False, True):
        plan_bytes = plan_of(preset, grid, keyframes, lean=lean).total_bytes
        room = ""
        total_bytes = device_memory_bytes(device)
        if total_bytes is not None:
            room = f"; {int(USABLE_SHARE * total_bytes) // plan_bytes} at once on this GPU"
        profile = "in the low-memory profile" if lean else "with volumes"
        console.print(f"planned {profile}: {plan_bytes / 1e9:.2f} GB a video, {keyframes} keyframes{room}")


if __name__ == "__main__":
    sys.exit(main())
