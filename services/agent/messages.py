"""What travels between the supervisor and a worker slot: plain frozen values, small enough for any transport."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

from services.domain.models import Lease, VideoRef, VideoResult

if TYPE_CHECKING:
    from services.commit.protocol import PreparedPayload

FailureScope = Literal["video", "storage", "shard", "job"]
"""Whom a failure concerns: this video; storage, so everybody for a while; this shard; or every video of the job."""


@dataclass(frozen=True, slots=True)
class Grant:
    """What a video may take of a GPU that others share.

    Attributes:
        memory_bytes: At most.
        low_memory: The low-memory profile, whatever would fit.
    """

    memory_bytes: int
    low_memory: bool = False


@dataclass(frozen=True, slots=True)
class AnnotateVideo:
    """Annotate one video.

    Attributes:
        grant: None where there is no GPU.
    """

    lease: Lease
    video: VideoRef
    grant: Grant | None = None


@dataclass(frozen=True, slots=True)
class PackShard:
    """Build, verify and upload the tars of the videos that succeeded.

    Attributes:
        tar_name: Taken for this task in the database; None where the output decides who takes a name.
    """

    lease: Lease
    results: tuple[VideoResult, ...]
    tar_name: str | None = None


@dataclass(frozen=True, slots=True)
class OpenShard:
    """Prepare scratch for a lease; what an earlier attempt on this node finished is taken over."""

    lease: Lease


@dataclass(frozen=True, slots=True)
class DiscardShard:
    """Remove the scratch of a shard that is committed, lost or cancelled."""

    lease: Lease


Task = AnnotateVideo | PackShard | OpenShard | DiscardShard


@dataclass(frozen=True, slots=True)
class Annotated:
    result: VideoResult


@dataclass(frozen=True, slots=True)
class Packed:
    payload: PreparedPayload


@dataclass(frozen=True, slots=True)
class Opened:
    """Results whose artifacts are on this node."""

    results: tuple[VideoResult, ...]


@dataclass(frozen=True, slots=True)
class Discarded:
    pass


@dataclass(frozen=True, slots=True)
class Failed:
    """A task failed with a reason.

    Attributes:
        message: One line for the user.
        detail: Traceback of an error that nobody foresaw, for the log.
        needed_bytes: Of a GPU too small for the video: what it takes by plan; None where memory ran out in the work.
    """

    code: str
    message: str
    retryable: bool
    scope: FailureScope = "video"
    detail: str | None = None
    needed_bytes: int | None = None


@dataclass(frozen=True, slots=True)
class Cancelled:
    """The task stopped because it was asked to."""


Answer = Annotated | Packed | Opened | Discarded | Failed | Cancelled


@dataclass(frozen=True, slots=True)
class Traffic:
    """Object storage traffic of a worker since its last reply.

    Attributes:
        requests: (operation, status) -> count.
        transferred_bytes: Operation -> bytes.
    """

    requests: dict[tuple[str, str], int] = field(default_factory=dict)
    transferred_bytes: dict[str, int] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Reply:
    """What a worker says at the end of a task.

    Attributes:
        rss_bytes: Its memory then; 0 where it is not known.
    """

    answer: Answer
    traffic: Traffic = field(default_factory=Traffic)
    rss_bytes: int = 0


@dataclass(frozen=True, slots=True)
class SlotProgress:
    """Where a worker is.

    Attributes:
        frames_done: Frames of the running video that count as done: its frames times the share of the work behind it.
        frames_expected: Frames of the running video once they are known.
    """

    video_key: str | None = None
    stage: str | None = None
    frames_done: int = 0
    frames_expected: int | None = None
