"""What the service costs: frames per second through REST, Ray, tars and commits, next to a bare loop.

    python benchmarks/service_efficiency.py [VIDEO ...] [--slots N]

The bare loop is one warm engine in one process that writes artifacts of the same videos and nothing else, with as many
threads as a slot has. The service is timed from the job's start to its last commit (Ray's start and the engine's import
are not in it, as they are not in the loop's). The ratio is the share of the engine's speed that the service keeps, per
slot.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from datetime import datetime
from pathlib import Path

from rich.console import Console

from services.cli.demo import running_service
from services.cli.progress import show_progress
from vipe_core.evaluation.samples import DEMO_NAMES, sample_path
from vipe_core.formats import SequenceNames, write_artifacts
from vipe_core.pipeline.annotator import Annotator


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("videos", nargs="*", type=Path, help="default: the sample videos")
    parser.add_argument("--slots", type=int, default=1)
    arguments = parser.parse_args()
    videos = [path.resolve() for path in arguments.videos] or [sample_path(name).video.resolve() for name in DEMO_NAMES]
    with tempfile.TemporaryDirectory(prefix="vipe-efficiency-") as folder:
        loop = bare_loop(videos, Path(folder) / "loop")
        service = through_service(videos, Path(folder), arguments.slots)
    print(f"bare loop, 1 process   {loop:7.3f} frames/s")
    print(f"service, {arguments.slots} slot(s)     {service:7.3f} frames/s")
    print(f"per slot, of the loop  {service / loop / arguments.slots:7.3f}")


def bare_loop(videos: list[Path], output: Path) -> float:
    """Frames per second of a warm engine, one video after the other."""
    annotator = Annotator(threads=1)
    names = SequenceNames(output)
    # The first video once more at the start: compiled kernels and caches are warm in the timed part.
    frames = 0
    started = time.perf_counter()
    for number, video in enumerate([videos[0], *videos]):
        if number == 1:
            frames, started = 0, time.perf_counter()
        annotation = annotator.annotate(video, name=names.name_for(video))
        write_artifacts(annotation, output)
        frames += annotation.num_frames
    return frames / (time.perf_counter() - started)


def through_service(videos: list[Path], folder: Path, slots: int) -> float:
    """Frames per second of a job, from its start to its last commit; the workers are warm from a job before it."""
    console = Console(stderr=True)
    with running_service(folder / "service", console, slots) as client:
        for name, inputs in (
            ("warm", [str(video) for video in videos[:slots]]),
            ("timed", [str(video) for video in videos]),
        ):
            job = client.submit({"inputs": inputs, "output": str(folder / name)})
            job = show_progress(client, job["id"], console)
            if job["state"] != "succeeded":
                raise SystemExit(f"the job {job['state']}: {job['error_message']}")
    elapsed = datetime.fromisoformat(job["finished_at"]) - datetime.fromisoformat(job["started_at"])
    return float(job["progress"]["frames_done"] / elapsed.total_seconds())


if __name__ == "__main__":
    main()
