"""The engine judged on many videos: what to run, each sequence in a process of its own, and what is kept of it.

Finished sequences are found again by their key, a hash of the preset, the video, the protocol and what is measured; a
sequence that failed is a row with its error code, and is tried again by the next run.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import logging
import multiprocessing
import resource
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vipe_core.annotation import Annotation
from vipe_core.errors import FormatError, MediaNotFound, VipeError
from vipe_core.evaluation.consistency import SampsonErrors, sampson_errors, shuttle_errors, unit_length
from vipe_core.evaluation.datasets import SequenceRef, protocol_of
from vipe_core.evaluation.datasets.sequence import GroundTruthSequence, Pictures
from vipe_core.evaluation.matching import point_matcher
from vipe_core.evaluation.metrics import DepthAlignment, sample_mask
from vipe_core.evaluation.results import Paths, SequenceResult, flat_figures, load_result, save_result
from vipe_core.evaluation.truth import Estimate, GroundTruth, SequenceReport, evaluate, evaluate_artifacts
from vipe_core.formats import list_sequences, read_artifacts
from vipe_core.pipeline.annotator import Annotator
from vipe_core.pipeline.presets import Preset
from vipe_core.pipeline.provenance import engine_version
from vipe_core.video import FrameSource, sanitise_name
from vipe_core.video.image_directory import IMAGE_SUFFIXES
from vipe_core.video.views import ReversedView

logger = logging.getLogger(__name__)

VIDEO_SUFFIXES = frozenset({".mp4", ".mov", ".mkv", ".webm", ".avi", ".m4v"})
# Part of every key: raised when the meaning of a figure changes.
_FIGURES_VERSION = 1


@dataclass(frozen=True, slots=True)
class Measure:
    """What is measured, and with what engine.

    Attributes:
        preset: The engine's configuration.
        device: Where bundle adjustment runs.
        depth: Judge depth where there is truth for it.
        consistency: Measure shuttle and Sampson errors.
        alignment: Of depth.
        matcher: Of the Sampson error.
    """

    preset: Preset
    device: str = "cpu"
    depth: bool = False
    consistency: bool = False
    alignment: DepthAlignment = "scale"
    matcher: str = "auto"


@dataclass(frozen=True, slots=True)
class Task:
    """One row of a report before it is known.

    Attributes:
        name: Name of the sequence.
        stem: Name of its files, unlike that of any other task.
        group: Group that it is averaged in.
        measure: What is measured.
        truth: The sequence with ground truth; None for a video without.
        video: The video without ground truth; None for a sequence with.
        max_frames: Only the first so many frames of `video`.
        artifacts: Folder of finished annotations to score instead of running the engine.
    """

    name: str
    stem: str
    group: str
    measure: Measure
    truth: SequenceRef | None = None
    video: Path | None = None
    max_frames: int | None = None
    artifacts: Path | None = None

    @property
    def key(self) -> str:
        """Hash of all that the figures depend on."""
        measure = dataclasses.asdict(self.measure) | {"preset": self.measure.preset.canonical_json()}
        told = {
            "version": _FIGURES_VERSION,
            "engine": engine_version(),
            "measure": measure,
            "truth": None if self.truth is None else dataclasses.asdict(self.truth),
            "video": None if self.video is None else [str(self.video), _size_bytes(self.video)],
            "max_frames": self.max_frames,
            "artifacts": None if self.artifacts is None else str(self.artifacts),
        }
        text = json.dumps(told, sort_keys=True, default=str)
        return hashlib.sha256(text.encode()).hexdigest()[:16]


def dataset_tasks(refs: Iterable[SequenceRef], measure: Measure, artifacts: Path | None = None) -> list[Task]:
    """Tasks for sequences with ground truth; with `artifacts` their finished annotations there are scored."""
    return _unique(
        Task(ref.name, sanitise_name(ref.name), ref.group, measure, truth=ref, artifacts=artifacts) for ref in refs
    )


def video_tasks(folder: Path, measure: Measure, max_frames: int | None = None) -> list[Task]:
    """Tasks for the videos and the folders of images in `folder`, or for `folder` itself if it is one.

    Raises:
        MediaNotFound: There is none.
    """
    if folder.is_file() or _holds_images(folder):
        found = [folder]
    elif folder.is_dir():
        found = sorted(
            path for path in folder.iterdir() if path.suffix.lower() in VIDEO_SUFFIXES or _holds_images(path)
        )
    else:
        found = []
    if not found:
        raise MediaNotFound(f"{folder}: no video and no folder of images; check the path")
    return _unique(
        Task(path.name, sanitise_name(path.stem), "all", measure, video=path, max_frames=max_frames) for path in found
    )


def run_tasks(
    tasks: Sequence[Task],
    out: Path,
    jobs: int = 1,
    report: Callable[[Task, SequenceResult, bool], None] = lambda task, result, fresh: None,
) -> list[SequenceResult]:
    """Runs what is not done yet; rows in the order of `tasks`.

    Args:
        out: Folder of the stored rows.
        jobs: Processes.
        report: Told each row as it is there, and whether it was made now.
    """
    rows: dict[str, SequenceResult] = {}
    waiting: list[Task] = []
    for task in tasks:
        stored = load_result(out, task.stem)
        if stored is not None and stored.key == task.key and stored.error is None:
            rows[task.stem] = stored
            report(task, stored, False)
        else:
            waiting.append(task)
    for task, result in _run_all(waiting, out, min(jobs, len(waiting))):
        rows[task.stem] = result
        report(task, result, True)
    return [rows[task.stem] for task in tasks]


def _run_all(tasks: Sequence[Task], out: Path, jobs: int) -> Iterator[tuple[Task, SequenceResult]]:
    if jobs <= 1:
        for task in tasks:
            yield task, run_task(task, out)
        return
    # Spawned: a fork would share the locks of torch and OpenCV with this process.
    with ProcessPoolExecutor(jobs, mp_context=multiprocessing.get_context("spawn")) as pool:
        running: dict[Future[SequenceResult], Task] = {pool.submit(run_task, task, out): task for task in tasks}
        for done in as_completed(running):
            task = running[done]
            try:
                yield task, done.result()
            except BrokenProcessPool:
                yield (
                    task,
                    _failed(task, "worker_died", "a process died, out of memory perhaps; run again with fewer jobs"),
                )


def run_task(task: Task, out: Path) -> SequenceResult:
    """One row, stored in `out`; an error becomes the row's."""
    try:
        result, paths = _score(task) if task.artifacts is not None else _run(task)
    except VipeError as error:
        logger.warning("%s: %s", task.name, error)
        result, paths = _failed(task, error.code, str(error)), None
    except Exception as error:
        # A defect of ours, but of one sequence: the others are worth having.
        logger.exception("%s: the evaluation failed", task.name)
        first_line = (str(error) or "no message").splitlines()[0][:300]
        result, paths = _failed(task, "evaluation_failed", f"{type(error).__name__}: {first_line}"), None
    save_result(out, task.stem, result, paths)
    return result


def _failed(task: Task, code: str, message: str) -> SequenceResult:
    return SequenceResult(task.name, task.group, task.key, error={"code": code, "message": message})


def _run(task: Task) -> tuple[SequenceResult, Paths | None]:
    """Annotate, and measure what was asked."""
    measure = task.measure
    sequence = None if task.truth is None else task.truth.load()
    if sequence is not None:
        source = sequence.pictures.open(task.stem)
    else:
        assert task.video is not None
        source = Pictures(task.video, stop=task.max_frames).open(task.stem)
    annotator = Annotator(measure.preset, measure.preset.camera, measure.device)
    started_s = _cpu_s()
    annotation = annotator.annotate(source)
    cpu_s = _cpu_s() - started_s
    report = paths = None
    if sequence is not None:
        report, paths = _against_truth(annotation, sequence, task)
    shuttle = sampson = None
    notes: tuple[str, ...] = () if sequence is None else sequence.notes
    if annotation.quality.cuts:
        at = ", ".join(str(frame) for frame in annotation.quality.cuts)
        notes = (*notes, f"cuts at frames {at}: each shot has a path of its own, the whole one means little")
    if measure.consistency:
        if annotation.num_frames > 1:
            backward = annotator.annotate(ReversedView(source, annotation.timestamps_s))
            shuttle = shuttle_errors(
                annotation.world_from_cam, annotation.camera, backward.world_from_cam, backward.camera
            )
            paths = paths or _there_and_back(annotation, backward)
        sampson = _sampson(source, annotation, measure)
        if sampson is not None:
            notes = (*notes, f"Sampson error of {sampson.matcher} matches")
    result = SequenceResult(
        task.name,
        task.group,
        task.key,
        frames=annotation.num_frames,
        figures=flat_figures(report, shuttle, sampson),
        reliable=annotation.quality.reliable,
        cpu_s=cpu_s,
        notes=notes,
    )
    return result, paths


def _sampson(source: FrameSource, annotation: Annotation, measure: Measure) -> SampsonErrors | None:
    matcher = point_matcher(measure.matcher, measure.device)
    return sampson_errors(source, annotation.world_from_cam, annotation.camera, matcher)


def _against_truth(
    annotation: Annotation, sequence: GroundTruthSequence, task: Task
) -> tuple[SequenceReport, Paths | None]:
    frames = np.arange(annotation.num_frames)
    truth = sequence.truth
    depth: Iterator[NDArray[np.float32]] | None = None
    masks: list[NDArray[np.uint8]] | None = None
    if task.measure.depth and truth.depth is not None:
        masks = None if truth.dynamic is None else []
        depth = _depth_and_masks(annotation, truth, masks)
    estimate = Estimate(
        annotation.name, annotation.world_from_cam, frames, annotation.camera, depth, annotation.depth_kind, masks
    )
    report = evaluate(estimate, truth, task.measure.alignment, _max_depth(task))
    return report, _truth_paths(annotation.world_from_cam, frames, annotation.timestamps_s, sequence)


def _depth_and_masks(
    annotation: Annotation, truth: GroundTruth, masks: list[NDArray[np.uint8]] | None
) -> Iterator[NDArray[np.float32]]:
    """The depth of every frame; on the way the masks are put into `masks`, at the size of the truth where it has some.

    The stream is expensive and gives both: the masks are complete when the depth has been gone through.
    """
    for frame in annotation.dense():
        if masks is not None and truth.dynamic is not None:
            masks.append(sample_mask(frame.mask, *truth.dynamic.shape[1:]).astype(np.uint8))
        yield frame.depth


def _score(task: Task) -> tuple[SequenceResult, Paths | None]:
    """Score finished artifacts."""
    assert task.truth is not None
    assert task.artifacts is not None
    sequence = task.truth.load()
    artifacts = read_artifacts(task.artifacts, _stored_name(task.artifacts, task))
    report = evaluate_artifacts(artifacts, sequence.truth, task.measure.alignment, _max_depth(task))
    times_s = artifacts.timestamps_s if artifacts.timestamps_s is not None else artifacts.frame_index / 30.0
    result = SequenceResult(
        task.name,
        task.group,
        task.key,
        frames=artifacts.num_frames,
        figures=flat_figures(report),
        notes=sequence.notes,
    )
    return result, _truth_paths(artifacts.world_from_cam, artifacts.frame_index, times_s, sequence)


def _stored_name(root: Path, task: Task) -> str:
    """The artifacts of a sequence carry its name, the last part of it, or that of its video."""
    assert task.truth is not None
    known = list_sequences(root)
    for name in (task.stem, sanitise_name(task.truth.folder.name), sanitise_name(task.truth.folder.resolve().name)):
        if name in known:
            return name
    if known == ["video"]:
        return "video"
    raise FormatError(f"{task.name}: no artifacts of this name in {root}; it holds {', '.join(known[:8]) or 'none'}")


def _truth_paths(
    world_from_cam: NDArray[np.float64],
    frame_index: NDArray[np.int64],
    times_s: NDArray[np.float64],
    sequence: GroundTruthSequence,
) -> Paths:
    _, ours, theirs = np.intersect1d(frame_index, sequence.truth.frame_index, return_indices=True)
    return Paths(world_from_cam[ours], sequence.truth.world_from_cam[theirs], "truth", times_s[ours])


def _there_and_back(forward: Annotation, backward: Annotation) -> Paths:
    return Paths(
        unit_length(backward.world_from_cam[::-1]),
        unit_length(forward.world_from_cam),
        "backward",
        forward.timestamps_s,
    )


def _max_depth(task: Task) -> float | None:
    return None if task.truth is None else protocol_of(task.truth.dataset, task.truth.protocol).max_depth_m


def _unique(tasks: Iterable[Task]) -> list[Task]:
    """Tasks whose stems differ, also where case does not count."""
    taken: set[str] = set()
    unique = []
    for task in tasks:
        stem, number = task.stem, 1
        while stem.lower() in taken:
            number += 1
            stem = f"{task.stem}-{number}"
        taken.add(stem.lower())
        unique.append(dataclasses.replace(task, stem=stem))
    return unique


def _holds_images(path: Path) -> bool:
    return path.is_dir() and any(file.suffix.lower() in IMAGE_SUFFIXES for file in path.iterdir())


def _size_bytes(path: Path) -> int:
    if path.is_dir():
        return sum(file.stat().st_size for file in path.iterdir() if file.is_file())
    return path.stat().st_size if path.is_file() else 0


def _cpu_s() -> float:
    """CPU seconds of this process and of the decoders that have ended."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime
