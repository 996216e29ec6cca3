"""Engines for the agent's tests: the "video" is a small text file that says what happens to whoever opens it.

    frames=12            a success with so many frames
    error                a typed error of the input
    bug                  an exception that nobody foresaw
    die                  the worker process dies, every time
    die-once=PATH        dies if PATH does not exist, and creates it
    hang                 never comes back
    hang-once=PATH       the first time
    disk-full-once=PATH  no file may become longer than 100 bytes, the first time
    slow=SECONDS         takes its time, reporting progress
    flaky=PATH           a retryable typed error, once
    leak=MIB             keeps so much memory for ever
    count=PATH           appends a line to PATH before anything else
    needs=GB/GB          runs out of GPU memory where it is granted less, in the full and in the low-memory profile
    planned=GB           refuses to begin where it is granted less
    gpu-log=PATH         appends what it is granted of a GPU

They write real artifacts with the engine's own writer, so that everything behind them is the real thing.
"""

from __future__ import annotations

import contextlib
import os
import resource
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import cast

import numpy as np

from services.agent.engine import ProgressCallback, VipeEngine, index_row
from services.agent.messages import Grant
from services.domain.models import JobSpec, VideoRef, VideoResult, is_rig
from vipe_core.annotation import MEASURED, Annotation, DenseFrame, Progress, Provenance, Quality
from vipe_core.cameras import Camera
from vipe_core.cameras.rig import Rig
from vipe_core.errors import ConfigError, CorruptMedia, DecodeCrashed, OutOfDeviceMemory
from vipe_core.formats import write_artifacts
from vipe_core.pipeline.rig_annotator import RigAnnotation, RigAnnotator

WIDTH, HEIGHT = 16, 12
_LEAKED: list[bytes] = []


class ProcessDeath(BaseException):
    """Stands for the death of the process in the in-memory executor."""


class ProcessHang(BaseException):
    """Stands for a process that never answers in the in-memory executor."""


class ScriptedEngine:
    def __init__(self, *, real_process: bool) -> None:
        self._real_process = real_process

    def annotate(
        self,
        path: Path,
        video: VideoRef,
        spec: JobSpec,
        root: Path,
        progress: ProgressCallback,
        grant: Grant | None = None,
    ) -> VideoResult:
        if is_rig(video.uri):
            return VipeEngine(cast(RigAnnotator, ScriptedRigs())).annotate(path, video, spec, root, progress)
        script = dict(part.partition("=")[::2] for part in path.read_text().split())
        frames = int(script.get("frames", "4"))
        progress("track", 0, frames, 0.0)
        if "count" in script:
            with Path(script["count"]).open("a") as log:
                log.write(f"{video.key}\n")
        if "leak" in script:
            _LEAKED.append(b"x" * (int(script["leak"]) << 20))
        if "error" in script:
            raise CorruptMedia(f"{path}: not a video")
        if "bug" in script:
            raise ValueError("a defect\nwith a second line")
        if "flaky" in script and not Path(script["flaky"]).exists():
            Path(script["flaky"]).touch()
            raise DecodeCrashed(f"{path}: the decoder died")
        if "gpu-log" in script:
            with Path(script["gpu-log"]).open("a") as log:
                log.write(f"{video.key} {grant and (grant.memory_bytes, grant.low_memory)}\n")
        if "needs" in script:
            _take_gpu_memory(path, grant, *(int(float(gb) * 1e9) for gb in script["needs"].split("/")))
        if "planned" in script and grant is not None and grant.memory_bytes < float(script["planned"]) * 1e9:
            raise OutOfDeviceMemory(f"{path}: too large", int(float(script["planned"]) * 1e9))
        if "die" in script:
            self._die()
        if "die-once" in script and not Path(script["die-once"]).exists():
            Path(script["die-once"]).touch()
            self._die()
        if "hang" in script or _first_time(script.get("hang-once")):
            if not self._real_process:
                raise ProcessHang
            time.sleep(3600)
        started = time.monotonic()
        while (spent := time.monotonic() - started) < float(script.get("slow", 0)):
            progress("track", int(spent * 10), frames, 0.1)
            time.sleep(0.05)
        annotation = fake_annotation(video.key, frames)
        with _short_files() if _first_time(script.get("disk-full-once")) else contextlib.nullcontext():
            write_artifacts(annotation, root, attributes=["pose", "intrinsics", "depth"])
        progress("depth", frames, frames, 1.0)
        return index_row(annotation, video)

    def _die(self) -> None:
        if not self._real_process:
            raise ProcessDeath
        os.kill(os.getpid(), signal.SIGSEGV)
        time.sleep(60)


def _take_gpu_memory(path: Path, grant: Grant | None, full_bytes: int, low_bytes: int) -> None:
    """What an allocator does that is given a part of a GPU."""
    assert grant is not None
    if (low_bytes if grant.low_memory else full_bytes) > grant.memory_bytes:
        raise OutOfDeviceMemory(f"{path}: the GPU's memory ran out")


class ScriptedRigs:
    """An annotator of rigs whose views are such scripts, `frames` and `error`."""

    def annotate_rig(
        self,
        rig: Rig,
        *,
        names: Sequence[str],
        scale_from: str | None,
        memory_bytes: int | None,
        progress: Callable[[Progress], None],
    ) -> RigAnnotation:
        views = []
        for view, name in zip(rig.views, names, strict=True):
            script = Path(view.video or "").read_text()
            if script == "error":
                raise CorruptMedia(f"{view.video}: not a video")
            views.append(fake_annotation(name, int(script.removeprefix("frames="))))
        progress(Progress("track", views[0].num_frames, views[0].num_frames))
        return RigAnnotation(tuple(views), rig, views[0].world_from_cam)

    def release(self) -> None:
        pass


def _first_time(marker: str | None) -> bool:
    if marker is None or Path(marker).exists():
        return False
    Path(marker).touch()
    return True


@contextlib.contextmanager
def _short_files() -> Iterator[None]:
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def open_in_memory(preset: str, camera: str, device: str) -> ScriptedEngine:
    if preset == "absent":
        raise ConfigError("there is no preset 'absent'")
    return ScriptedEngine(real_process=False)


def open_in_process(preset: str, camera: str, device: str) -> ScriptedEngine:
    return ScriptedEngine(real_process=True)


def fake_annotation(name: str, frames: int) -> Annotation:
    """A straight walk with a constant depth."""
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, 2, 3] = np.arange(frames) * 0.1

    def dense() -> Iterator[DenseFrame]:
        for index in range(frames):
            shape = (HEIGHT, WIDTH)
            rgb, depth = np.zeros((*shape, 3), np.uint8), np.full(shape, 2.0, np.float32)
            mask, kind = np.zeros(shape, np.uint8), np.full(shape, MEASURED, np.uint8)
            yield DenseFrame(index, rgb, depth, np.ones(shape, np.float32), mask, kind)

    return Annotation(
        name=name,
        world_from_cam=poses,
        camera=Camera.pinhole_from_fov(60.0, WIDTH, HEIGHT),
        timestamps_s=np.arange(frames) / 10.0,
        fps=10.0,
        keyframes=np.array([0], np.int64),
        scale="relative",
        depth_kind="z",
        quality=Quality("yes", (), 0.5, 0.9, 0.8, 3.0, 0.01, np.ones(frames, np.float32)),
        provenance=Provenance("0", "classical", "0" * 64, "cpu", {}, {}, {}, {"name": name}),
        dense=dense,
        timings_s={"track": 0.01},
    )
