"""Engines with accidents: what happens to a worker process in the middle of a video.

Around the engine that ships, or around one that decodes with the real decoder process, writes real artifacts with the
real writer, and computes nothing in between: a minute of chaos is then about the service and not about the processor.

Runs inside the workers of the chaos run. `ROOT/orders/KIND.AGENT` orders an accident: the worker of that agent that
begins a video next takes the order by renaming it, so that it happens once. Inputs called `poison*` always kill.
`ROOT/work.log` gets a line at the beginning and at the end of every video.
"""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import json
import os
import resource
import threading
import time
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from services.agent.engine import Engine, ProgressCallback, index_row, open_engine
from services.agent.messages import Grant
from services.domain.models import JobSpec, VideoRef, VideoResult
from vipe_core.annotation import MEASURED, Annotation, DenseFrame, Provenance, Quality
from vipe_core.cameras import Camera
from vipe_core.errors import CorruptMedia
from vipe_core.formats import write_artifacts
from vipe_core.video import open_source
from vipe_core.video.source import VideoInfo

ROOT_VARIABLE = "VIPE_CHAOS_ROOT"
AGENT_VARIABLE = "VIPE_CHAOS_AGENT"
PACE_VARIABLE = "VIPE_CHAOS_PACE_S"
REAL_VARIABLE = "VIPE_CHAOS_REAL_ENGINE"

# Beyond what a worker has when it begins; opening and decoding a video needs more.
_SPARE_BYTES = 8 << 20
_DISK_FULL_S = 5.0


class EngineWithAccidents:
    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._root = Path(os.environ[ROOT_VARIABLE])
        self._agent = os.environ[AGENT_VARIABLE]
        self._pace_s = float(os.environ[PACE_VARIABLE])

    def annotate(
        self,
        path: Path,
        video: VideoRef,
        spec: JobSpec,
        root: Path,
        progress: ProgressCallback,
        grant: Grant | None = None,
    ) -> VideoResult:
        name = Path(video.uri).stem
        started = time.monotonic()
        self._log("begin", name)
        progress("track", 0, None, 0.0)
        if name.startswith("poison") or self._stands("bad-slot"):
            self._wait_a_little(progress)
            _segfault()
        kind = self._take_order(name)
        if kind == "segfault":
            self._wait_a_little(progress)
            _segfault()
        if kind == "exception":
            raise RuntimeError("an accident of the chaos run")
        if kind == "disk-full":
            _limit_file_size(_DISK_FULL_S)
        with _little_memory() if kind == "memory" else contextlib.nullcontext():
            result = self._engine.annotate(path, video, spec, root, progress, grant)
        while time.monotonic() - started < self._pace_s:  # A job that lasts as long as the faults, on an idle machine.
            progress("depth", 0, None, 1.0)
            time.sleep(0.1)
        self._log("end", name)
        return result

    def _take_order(self, name: str) -> str | None:
        for order in sorted((self._root / "orders").glob(f"*.{self._agent}")):
            if order.name.startswith("bad-slot"):
                continue
            try:
                order.rename(self._root / "taken" / f"{order.stem}.{name}.{time.time():.3f}")
            except FileNotFoundError:
                continue
            return order.stem
        return None

    def _stands(self, kind: str) -> bool:
        return (self._root / "orders" / f"{kind}.{self._agent}").exists()

    def _wait_a_little(self, progress: ProgressCallback) -> None:
        progress("track", 1, None, 0.1)
        time.sleep(1.0)

    def _log(self, event: str, name: str) -> None:
        line = json.dumps({"at": time.time(), "event": event, "video": name, "agent": self._agent, "pid": os.getpid()})
        with (self._root / "work.log").open("a") as log:
            fcntl.flock(log, fcntl.LOCK_EX)
            log.write(line + "\n")


class LightEngine:
    """Frames are decoded at the run's pace; the camera walks straight on past a wall."""

    def __init__(self, pace_s: float) -> None:
        self._pace_s = pace_s

    def annotate(
        self,
        path: Path,
        video: VideoRef,
        spec: JobSpec,
        root: Path,
        progress: ProgressCallback,
        grant: Grant | None = None,
    ) -> VideoResult:
        info = (source := open_source(path)).info
        stamps = []
        with contextlib.closing(source.frames()) as frames:
            for frame in frames:
                stamps.append(frame.timestamp_s)
                progress("track", len(stamps), info.num_frames_hint, 0.5)
                time.sleep(0.9 * self._pace_s / (info.num_frames_hint or 1))
        if not stamps:
            raise CorruptMedia(f"{path}: no frame can be decoded; check the file")
        annotation = _straight_walk(video.key, stamps, info)
        write_artifacts(annotation, root, attributes=["pose", "intrinsics", "depth"])
        return index_row(annotation, video)


def open_with_accidents(preset: str, camera: str, device: str) -> Engine:
    real = os.environ[REAL_VARIABLE] == "1"
    light = LightEngine(float(os.environ[PACE_VARIABLE]))
    return EngineWithAccidents(open_engine(preset, camera, device) if real else light)


def _straight_walk(name: str, stamps: list[float], info: VideoInfo) -> Annotation:
    number = len(stamps)
    poses = np.tile(np.eye(4), (number, 1, 1))
    poses[:, 2, 3] = np.arange(number) * 0.1
    shape = (info.height, info.width)

    def dense() -> Generator[DenseFrame, None, None]:
        for index in range(number):
            yield DenseFrame(
                index,
                np.zeros((*shape, 3), np.uint8),
                np.full(shape, 2.0, np.float32),
                np.ones(shape, np.float32),
                np.zeros(shape, np.uint8),
                np.full(shape, MEASURED, np.uint8),
            )

    return Annotation(
        name=name,
        world_from_cam=poses,
        camera=Camera.pinhole_from_fov(60.0, info.width, info.height),
        timestamps_s=np.array(stamps),
        fps=info.fps,
        keyframes=np.array([0], np.int64),
        scale="relative",
        depth_kind="z",
        quality=Quality("no", (), 0.5, 0.9, 0.8, 3.0, 0.01, np.ones(number, np.float32)),
        provenance=Provenance("chaos", "chaos", "0" * 64, "cpu", {}, {}, {}, {"name": name}),
        dense=dense,
    )


def _segfault() -> None:
    ctypes.string_at(0)


def _limit_file_size(seconds: float) -> None:
    """A disk that is full for a while: every write beyond a few bytes fails, in all threads of this process."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (64, before[1]))

    def lift() -> None:
        time.sleep(seconds)
        resource.setrlimit(resource.RLIMIT_FSIZE, before)

    threading.Thread(target=lift, daemon=True).start()


@contextmanager
def _little_memory() -> Iterator[None]:
    """An address space that is all but used up."""
    before = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + _SPARE_BYTES, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)
