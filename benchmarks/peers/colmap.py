"""COLMAP on a video or a folder of images, as a peer to compare with: SIFT, sequential matching, both mappers.

    python -m benchmarks.peers.colmap INPUT [INPUT ...] --cache FOLDER [--every N] [--mapper global|incremental]

The camera is one shared SIMPLE_RADIAL of unknown focal length; the global mapper, which depends on a good start, gets
it from COLMAP's view graph calibration, as its manual asks for. Every step runs in a process of its own that is killed
at a time limit; its CPU-seconds are those that the kernel counted for it. Features and matches are made once and count
for either mapper. Decoding a video into images is not counted, which is to COLMAP's advantage.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib.metadata
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.peers import colmap_steps
from vipe_core.cameras import Camera
from vipe_core.video import open_source

MAPPERS = ("global", "incremental")
_IMAGES = (".png", ".jpg", ".jpeg")


@dataclass(frozen=True, slots=True)
class ColmapSettings:
    """What determines a run besides the pictures.

    Attributes:
        every: Use every n-th frame.
        limit_s: Wall seconds that one step may take before it is killed.
        threads: CPU threads of every stage.
        seed: Of every random number generator; several threads still make the last digits differ.
    """

    every: int = 1
    limit_s: float = 3600.0
    threads: int = 1
    seed: int = 0


@dataclass(frozen=True, slots=True)
class ColmapRun:
    """What one mapper made of one input.

    Attributes:
        mapper: `global` or `incremental`.
        num_frames: Frames that it was given.
        frame_index: (M,) int64, frames of the input that it posed, ascending.
        world_from_cam: (M, 4, 4) float64, OpenCV axes.
        camera: Pinhole part of its camera (distortion dropped); None when nothing was posed.
        cpu_s: CPU-seconds of features, matching and mapping, of all threads and child processes.
        wall_s: The same in wall seconds.
        failure: Why there is no result; None when there is one.
    """

    mapper: str
    num_frames: int
    frame_index: NDArray[np.int64]
    world_from_cam: NDArray[np.float64]
    camera: Camera | None
    cpu_s: float
    wall_s: float
    failure: str | None

    @property
    def cpu_s_per_posed_frame(self) -> float | None:
        return self.cpu_s / len(self.frame_index) if len(self.frame_index) else None


@dataclass(frozen=True, slots=True)
class _Spent:
    """CPU and wall seconds of a child process, and how it failed, if it did."""

    cpu_s: float
    wall_s: float
    failure: str | None


def run_colmap(
    path: Path,
    mappers: Sequence[str] = MAPPERS,
    settings: ColmapSettings | None = None,
    cache: Path | None = None,
) -> list[ColmapRun]:
    """Runs the mappers on a video file or an image folder, one after the other.

    Args:
        path: As for the annotator: a video file, or a directory whose images are taken in order of their names.
        cache: Folder where results are kept and found again, by input, settings and COLMAP's version.

    Raises:
        InputError, DecodeError: The input cannot be read.
        SystemExit: pycolmap is not installed.
    """
    settings = settings or ColmapSettings()
    try:
        version = importlib.metadata.version("pycolmap")
    except importlib.metadata.PackageNotFoundError:
        raise SystemExit('the comparison needs pycolmap: pip install -e ".[bench]"') from None
    if cache is None:
        with tempfile.TemporaryDirectory(prefix="colmap-") as temporary:
            return _run(path, mappers, settings, Path(temporary))
    steps = Path(colmap_steps.__file__).read_text()
    key = hashlib.sha256(f"{version} {steps} {_identity(path)} {settings}".encode()).hexdigest()[:12]
    label = path.parent.name if path.is_file() or path.parent.parent.name == "real" else path.name
    folder = cache / f"{label}-every{settings.every}-{key}"
    folder.mkdir(parents=True, exist_ok=True)
    return _run(path, mappers, settings, folder)


def _run(path: Path, mappers: Sequence[str], settings: ColmapSettings, folder: Path) -> list[ColmapRun]:
    wanted = {mapper: folder / f"{mapper}.json" for mapper in mappers}
    if all(file.is_file() for file in wanted.values()):
        return [_read(folder, mapper) for mapper in mappers]
    with tempfile.TemporaryDirectory(prefix="colmap-work-") as scratch:
        work = Path(scratch)
        images, names, numbers, size = _images(path, work / "images", settings.every)
        matched = _step("features", images, names, folder, settings)
        for mapper, file in wanted.items():
            if file.is_file():
                continue
            spent = matched if matched.failure else _step(mapper, images, names, folder, settings)
            facts = {
                "num_frames": len(names),
                "numbers": numbers,
                "size": size,
                "cpu_s": matched.cpu_s + (0.0 if matched.failure else spent.cpu_s),
                "wall_s": matched.wall_s + (0.0 if matched.failure else spent.wall_s),
                "features": asdict(matched),
                "failure": spent.failure,
            }
            file.write_text(json.dumps(facts, indent=1))
            shutil.rmtree(folder / mapper, ignore_errors=True)
    (folder / "database.db").unlink(missing_ok=True)
    return [_read(folder, mapper) for mapper in mappers]


def _read(folder: Path, mapper: str) -> ColmapRun:
    facts = json.loads((folder / f"{mapper}.json").read_text())
    index, poses, camera = np.zeros(0, np.int64), np.zeros((0, 4, 4)), None
    failure = facts["failure"]
    if failure is None:
        with np.load(folder / f"{mapper}.npz", allow_pickle=False) as file:
            index, poses, params = file["index"], file["world_from_cam"], file["params"]
        if len(index):
            width, height = facts["size"]
            focal, cx, cy = (float(value) for value in params[:3])
            camera = Camera("pinhole", (focal, focal, cx, cy), width, height)
        else:
            failure = "no model"
    numbers = np.array(facts["numbers"], dtype=np.int64)
    return ColmapRun(
        mapper, facts["num_frames"], numbers[index], poses, camera, facts["cpu_s"], facts["wall_s"], failure
    )


def _step(step: str, images: Path, names: Sequence[str], folder: Path, settings: ColmapSettings) -> _Spent:
    """Runs one step in a process group of its own and waits for it, with the time limit."""
    request = folder / f"{step}.request.json"
    request.write_text(
        json.dumps(
            {
                "step": step,
                "images": str(images),
                "names": list(names),
                "work": str(folder),
                "out": str(folder / f"{step}.npz"),
                "threads": settings.threads,
                "seed": settings.seed,
            }
        )
    )
    count = str(settings.threads)
    environment = {**os.environ, "OMP_NUM_THREADS": count, "OPENBLAS_NUM_THREADS": count}
    started = time.perf_counter()
    with (folder / f"{step}.log").open("wb") as log:
        child = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.peers.colmap_steps", str(request)],
            stdout=log,
            stderr=log,
            stdin=subprocess.DEVNULL,
            start_new_session=True,
            env=environment,
            cwd=Path(__file__).resolve().parents[2],
        )
        failure = None
        try:
            # wait4 and not Popen.wait: it returns the resources of this child, whatever else runs beside it.
            while not (ended := os.wait4(child.pid, os.WNOHANG))[0]:
                if time.perf_counter() - started > settings.limit_s:
                    failure = f"{step} took more than {settings.limit_s:.0f} s"
                    os.killpg(child.pid, signal.SIGKILL)
                    ended = os.wait4(child.pid, 0)
                    break
                time.sleep(0.05)
        except BaseException:
            os.killpg(child.pid, signal.SIGKILL)
            raise
        _, code, usage = ended
        status = os.waitstatus_to_exitcode(code)
        child.returncode = status
    if status and failure is None:
        failure = f"{step} ended with status {status}"
    return _Spent(usage.ru_utime + usage.ru_stime, time.perf_counter() - started, failure)


def _images(path: Path, folder: Path, every: int) -> tuple[Path, list[str], list[int], tuple[int, int]]:
    """Folder and names of every n-th image, their frame numbers, and the size of the input in pixels.

    A folder of images is read where it is; a video's frames are written losslessly to `folder`.
    """
    source = open_source(path)
    size = (source.info.width, source.info.height)
    if path.is_dir():
        names = sorted(file.name for file in path.iterdir() if file.suffix.lower() in _IMAGES)
        numbers = list(range(0, len(names), every))
        return path.resolve(), [names[number] for number in numbers], numbers, size
    folder.mkdir(parents=True)
    names, numbers = [], []
    for frame in source.frames():
        if frame.index % every == 0:
            name = f"{frame.index:06d}.png"
            cv2.imwrite(str(folder / name), cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2BGR))
            names.append(name)
            numbers.append(frame.index)
    return folder, names, numbers, size


def _identity(path: Path) -> str:
    """Names and sizes of the input's files: enough to notice another input under the same path."""
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    listing = [f"{file.name}:{file.stat().st_size}" for file in files]
    return f"{path.resolve()}|{'|'.join(listing)}"


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("inputs", nargs="+", type=Path, metavar="INPUT")
    parser.add_argument("--cache", type=Path, help="keep results in this folder")
    parser.add_argument("--every", type=int, default=1, help="use every n-th frame")
    parser.add_argument("--mapper", choices=MAPPERS, action="append", help="default: both")
    parser.add_argument("--limit-s", type=float, default=3600.0, help="wall seconds for one step")
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args(argv)
    settings = ColmapSettings(arguments.every, arguments.limit_s, arguments.threads)
    for path in arguments.inputs:
        for run in run_colmap(path, arguments.mapper or MAPPERS, settings, arguments.cache):
            rate = run.cpu_s_per_posed_frame
            field = f"{run.camera.fov_x_deg:.2f} deg" if run.camera else "-"
            print(
                f"{path}: {run.mapper}: {len(run.frame_index)}/{run.num_frames} posed, field of view {field}, "
                f"{run.cpu_s:.1f} CPU-s, {'-' if rate is None else f'{rate:.2f}'} per posed frame, "
                f"{run.wall_s:.1f} s{'' if run.failure is None else f'; {run.failure}'}",
                flush=True,
            )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
