"""The inside of a worker process: a warm engine, one task at a time, and a second thread that can look and interrupt.

Nothing here knows how the process was started. A task never raises: what goes wrong becomes a `Failed` answer with a
stable code, so that only a dead process looks like a dead process.
"""

from __future__ import annotations

import errno
import logging
import resource
import socket
import threading
import time
import traceback
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from pathlib import Path

from services.agent.engine import Engine, load_opener
from services.agent.messages import (
    Annotated,
    AnnotateVideo,
    Answer,
    Cancelled,
    Discarded,
    DiscardShard,
    Failed,
    FailureScope,
    Opened,
    OpenShard,
    Packed,
    PackShard,
    Reply,
    SlotProgress,
    Task,
)
from services.agent.scratch import ShardScratch, sweep
from services.agent.traffic import TrafficRecorder
from services.domain.errors import InputUnavailable, ObjectMissing, ServiceError, StorageError
from services.domain.models import JobSpec, VideoRef, VideoResult, is_rig
from services.domain.redaction import redact
from services.domain.states import VideoStatus
from services.inputs.fetching import Fetched, fetched
from services.inputs.rigs import fetched_rig
from services.inputs.rules import InputRules
from services.storage import open_store
from vipe_core.errors import EngineError, OutOfDeviceMemory, VipeError
from vipe_core.video.limits import Limits, use_limits

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class SlotConfig:
    """What a worker process must know; the meaning of each is that of `AgentConfig`."""

    scratch_dir: Path
    device: str
    engine: str
    s3_endpoint_url: str | None
    scratch_max_age_s: float
    inputs: InputRules = field(default_factory=InputRules)
    media: Limits = field(default_factory=Limits)


# Writing fails so where there is no room; such an error names no file. Nothing else of a video's work writes.
_DISK_TROUBLE = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}


class _Interrupted(BaseException):
    """Raised from the engine's progress callback. Not an Exception, so that no stage mistakes it for a failure."""


class _JobFailure(Exception):
    """The engine cannot be opened for this job at all."""

    def __init__(self, cause: VipeError) -> None:
        super().__init__(str(cause))
        self.cause = cause


class Slot:
    """One worker. `run` from one thread; `progress` and `cancel` from another."""

    def __init__(self, config: SlotConfig) -> None:
        self._config = config
        self._engines: dict[tuple[object, ...], Engine] = {}
        self._traffic = TrafficRecorder()
        self._cancel = threading.Event()
        self._progress = SlotProgress()
        use_limits(config.media)
        config.scratch_dir.mkdir(parents=True, exist_ok=True)
        sweep(config.scratch_dir, config.scratch_max_age_s)

    def run(self, task: Task) -> Reply:
        """Do one task to its end. Never raises."""
        self._cancel.clear()
        try:
            answer = self._answer(task)
        except _Interrupted:
            answer = Cancelled()
        finally:
            self._progress = SlotProgress()
        return Reply(answer, self._traffic.take(), _rss_bytes())

    def progress(self) -> SlotProgress:
        return self._progress

    def cancel(self) -> None:
        """Stop the task in flight at its next sign of progress."""
        self._cancel.set()

    def _answer(self, task: Task) -> Answer:
        scope: FailureScope = "video" if isinstance(task, AnnotateVideo) else "shard"
        try:
            match task:
                case AnnotateVideo():
                    return self._annotate(task)
                case PackShard():
                    return self._pack(task)
                case OpenShard():
                    return Opened(ShardScratch(self._config.scratch_dir, task.lease).open())
                case DiscardShard():
                    ShardScratch(self._config.scratch_dir, task.lease).discard()
                    return Discarded()
        except _JobFailure as error:
            # Of many workers, one that lacks something ends the job: whoever reads this must know which.
            message = f"worker {socket.gethostname()}: {error}"
            return Failed(error.cause.code, message, retryable=False, scope="job")
        except ObjectMissing as error:
            return Failed(InputUnavailable.code if scope == "video" else error.code, str(error), False, scope)
        except StorageError as error:
            # An output that refuses fails the job in the end; an input that refuses becomes a row in the end.
            refused_output = scope == "shard" and not error.retryable
            return Failed(error.code, str(error), error.retryable, "shard" if refused_output else "storage")
        except (ServiceError, VipeError) as error:
            return Failed(error.code, str(error), error.retryable, scope)
        except OSError as error:
            message = f"the scratch folder {self._config.scratch_dir} failed: {error.strerror or error}"
            return Failed(StorageError.code, message, True, "storage", traceback.format_exc())
        except Exception as error:
            return _unforeseen(error, f"{type(task).__name__} of {task.lease.shard_id}", scope)

    def _annotate(self, task: AnnotateVideo) -> Answer:
        lease, video = task.lease, task.video
        started = time.perf_counter()
        self._progress = SlotProgress(video.key, "fetch")
        scratch = ShardScratch(self._config.scratch_dir, lease)
        engine = self._engine(lease.spec)
        with self._fetched(video, scratch) as local:
            return self._annotate_local(task, engine, scratch, local, started)

    def _fetched(self, video: VideoRef, scratch: ShardScratch) -> AbstractContextManager[Fetched]:
        rules, endpoint_url, observer = self._config.inputs, self._config.s3_endpoint_url, self._traffic
        if is_rig(video.uri):
            folder = scratch.input_folder()
            return fetched_rig(video, rules, folder, s3_endpoint_url=endpoint_url, observer=observer)

        def place(suffix: str) -> Path:
            return scratch.input_path(video.key, suffix)

        return fetched(video, rules, place, s3_endpoint_url=endpoint_url, observer=observer)

    def _annotate_local(
        self, task: AnnotateVideo, engine: Engine, scratch: ShardScratch, local: Fetched, started: float
    ) -> Answer:
        lease, video, path = task.lease, task.video, local.path
        root = scratch.staging()
        failure: Failed
        try:
            result = engine.annotate(path, video, lease.spec, root, self._report, task.grant)
        except OutOfDeviceMemory as error:
            message = _one_line(error, path, video)
            failure = Failed(error.code, message, error.retryable, needed_bytes=error.needed_bytes)
        except VipeError as error:
            failure = Failed(error.code, _one_line(error, path, video), retryable=error.retryable)
        except MemoryError as error:
            failure = Failed(EngineError.code, f"{video.uri}: {_one_line(error, path, video)}", retryable=True)
        except OSError as error:
            in_scratch = Path(str(error.filename or "/")).is_relative_to(self._config.scratch_dir)
            if not in_scratch and error.errno not in _DISK_TROUBLE:
                failure = _unforeseen(error, video.uri)
            else:
                raise
        except Exception as error:
            failure = _unforeseen(error, video.uri)
        else:
            timings = {**({"fetch": local.seconds} if local.seconds else {}), **(result.timings_s or {})}
            seconds = round(time.perf_counter() - started, 4)
            result = replace(result, attempt=lease.attempt, seconds=seconds, timings_s=timings)
            scratch.keep(result)
            return Annotated(result)
        scratch.staging()
        if not failure.retryable:
            scratch.keep(failed_row(video, lease.attempt, failure.code, failure.message))
        return failure

    def _pack(self, task: PackShard) -> Answer:
        from services.commit.protocol import prepare_payload  # Slow to import: not before the process is ready.

        self._progress = SlotProgress(None, "pack")
        scratch = ShardScratch(self._config.scratch_dir, task.lease)
        output = open_store(task.lease.spec.output, endpoint_url=self._config.s3_endpoint_url, observer=self._traffic)
        return Packed(
            prepare_payload(task.lease, task.results, scratch.artifacts, scratch.tars, output, tar_name=task.tar_name)
        )

    def _engine(self, spec: JobSpec) -> Engine:
        changed = {} if set(spec.preset_options.values()) == {None} else {"options": spec.preset_options}
        key = (spec.preset, spec.camera, *spec.preset_options.values())
        engine = self._engines.get(key)
        if engine is None:
            try:
                engine = load_opener(self._config.engine)(spec.preset, spec.camera, self._config.device, **changed)
            except OutOfDeviceMemory:
                raise  # With more of the GPU, or another one, it can be opened.
            except VipeError as error:
                raise _JobFailure(error) from error
            self._engines = {key: engine}  # One at a time: another preset's weights would stay in memory.
        return engine

    def _report(self, stage: str, frames_done: int, frames_total: int | None, share: float) -> None:
        if self._cancel.is_set():
            raise _Interrupted
        expected = frames_total or self._progress.frames_expected
        done = int(share * expected) if expected else 0
        self._progress = replace(self._progress, stage=stage, frames_done=done, frames_expected=expected)


def _rss_bytes() -> int:
    """Memory of this process that is really there; 0 where the platform does not say."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except (OSError, ValueError, IndexError):
        return 0
    return pages * resource.getpagesize()


def failed_row(video: VideoRef, attempt: int, code: str, message: str) -> VideoResult:
    """The index row of a video that has no artifacts."""
    return VideoResult(
        video.key, video.uri, VideoStatus.FAILED, attempt, error_code=code, error_message=redact(message)
    )


def _one_line(error: BaseException, path: Path, video: VideoRef) -> str:
    """The first line of an error, speaking of the address that the user gave instead of our copy."""
    text = (str(error) or type(error).__name__).replace(str(path), video.uri)
    return text.splitlines()[0][:500]


def _unforeseen(error: Exception, what: str, scope: FailureScope = "video") -> Failed:
    detail = traceback.format_exc()
    first_line = (str(error) or "no message").splitlines()[0][:300]
    message = f"{what}: {type(error).__name__}: {first_line}; please report it with the agent's log"
    return Failed(EngineError.code, message, False, scope, detail)
