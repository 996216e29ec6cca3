"""The nouns of the service: jobs, shards, videos, leases and the commit record. Values only, no I/O."""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import asdict, dataclass, field
from datetime import datetime
from typing import Any, Literal
from urllib.parse import urlsplit

from services.domain.control import JobControl
from services.domain.states import JobState, ShardState, VideoStatus

Attribute = Literal["pose", "intrinsics", "depth", "rgb", "mask", "confidence"]
DEFAULT_ATTRIBUTES: tuple[Attribute, ...] = ("pose", "intrinsics", "depth", "rgb", "mask")


@dataclass(frozen=True, slots=True)
class JobSpec:
    """What the user asked for.

    Attributes:
        inputs: Each a directory, a video file, `s3://bucket/key`, `s3://bucket/prefix/` (trailing slash),
            `http(s)://host/path`, the file of a rig (`is_rig`), or a list of videos (`.csv`, `.jsonl`, `.parquet`) in
            one of these places.
        output: A directory or `s3://bucket/prefix` that belongs to this job alone.
        preset: Engine preset.
        camera: Camera model.
        attributes: Tars to write; `pose` and `intrinsics` always.
        shard_max_videos: Most videos in one shard.
        shard_max_input_bytes: Most input bytes in one shard (a stand-in for cost; one video always fits).
        name: Free text for humans.
        scale_from: A length that is known of every video of the job, which makes their scale metric, as `annotate`
            takes it.
        phrases: What is found, followed and masked; None for what the preset does.
        detection_interval_s: Time between looks for new things; None for the preset's own.
        metric_depth: Network that tells the scale; None for the preset's own.
        tracks: What follows points for the DROID network; None for the preset's own.
        calibration: The camera that took every video of the job, in the engine's JSON; None where it is estimated.
    """

    inputs: tuple[str, ...]
    output: str
    preset: str = "classical"
    camera: str = "pinhole"
    attributes: tuple[Attribute, ...] = DEFAULT_ATTRIBUTES
    shard_max_videos: int = 16
    shard_max_input_bytes: int = 1 << 30
    name: str = ""
    scale_from: str | None = None
    phrases: tuple[str, ...] | None = None
    detection_interval_s: float | None = None
    metric_depth: str | None = None
    tracks: str | None = None
    calibration: dict[str, Any] | None = None

    @property
    def config_hash(self) -> str:
        """sha256 of what decides the payload bytes of a video, not of where they come from or go."""
        config: dict[str, Any] = {"preset": self.preset, "camera": self.camera, "attributes": list(self.attributes)}
        if self.scale_from is not None:
            config["scale_from"] = self.scale_from
        config |= {name: value for name, value in self.preset_options.items() if value is not None}
        if self.calibration is not None:
            config["calibration"] = self.calibration
        return hashlib.sha256(json.dumps(config, sort_keys=True).encode()).hexdigest()

    @property
    def preset_options(self) -> dict[str, Any]:
        """What is changed of the preset; None where it is left as it is."""
        return {
            "phrases": self.phrases,
            "detection_interval_s": self.detection_interval_s,
            "metric_depth": self.metric_depth,
            "tracks": self.tracks,
        }

    def to_json(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> JobSpec:
        several = {
            name: tuple(data[name]) for name in ("inputs", "attributes", "phrases") if data.get(name) is not None
        }
        return cls(**{**data, **several})


@dataclass(frozen=True, slots=True)
class VideoRef:
    """One input video.

    Attributes:
        key: Stable sample key `[a-z0-9_-]+`, the webdataset key and the artifact name; see `video_key`.
        uri: Absolute path or address; of a rig file (`is_rig`), which names the videos of its views.
        size_bytes: As listed.
        etag: Content tag of the listing where the store has one.
    """

    key: str
    uri: str
    size_bytes: int
    etag: str | None = None


def video_key(uri: str, hex_digits: int = 8) -> str:
    """Stable key of an input: its sanitised stem, then hex of its address, so that equal stems stay apart.

    Among a million equal stems some pairs agree in 8 digits; the planner takes 16 for the second of such a pair.
    """
    stem = uri.rstrip("/").rsplit("/", 1)[-1].rsplit(".", 1)[0]
    readable = re.sub(r"[^a-z0-9_-]+", "-", stem.lower()).strip("-")[:48] or "video"
    return f"{readable}-{hashlib.sha256(uri.encode()).hexdigest()[:hex_digits]}"


def is_rig(uri: str) -> bool:
    """Whether an input is a rig file: the views that it names are annotated together, as one video of the job."""
    path = urlsplit(uri).path if "://" in uri else uri
    member, hash_sign, number = path.rpartition("#")
    name = (member if hash_sign and number.isdigit() else path).rsplit("/", 1)[-1].lower()
    return name == "rig.json" or name.endswith(".rig.json")


def view_key(rig: str, view: str) -> str:
    """Sample key of a view of a rig. The capitals keep it apart from every key of a video."""
    return f"{rig}_VIEW_{view}"


@dataclass(frozen=True, slots=True)
class ShardPlan:
    """Frozen membership of a shard. `plan_hash` binds a commit record to it."""

    ordinal: int
    videos: tuple[VideoRef, ...]

    @property
    def plan_hash(self) -> str:
        members = [[v.key, v.uri, v.size_bytes, v.etag] for v in self.videos]
        return hashlib.sha256(json.dumps([self.ordinal, members]).encode()).hexdigest()


@dataclass(frozen=True, slots=True)
class PlannedShard:
    """What a job's plan says about a shard.

    Attributes:
        videos: Their keys, in the order of the plan.
    """

    ordinal: int
    plan_hash: str
    videos: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class ShardDigest:
    """What the database knows about a shard's record.

    Attributes:
        record_sha256: Of its bytes; None before it is committed, or where an earlier release committed it.
    """

    id: str
    ordinal: int
    state: ShardState
    plan_hash: str
    record_sha256: str | None


def shard_id(job_id: str, ordinal: int) -> str:
    return f"{job_id}-{ordinal:06d}"


@dataclass(frozen=True, slots=True)
class JobProgress:
    """Counters of a job, derived from its shards, videos and live leases.

    Attributes:
        frames_done: Frames of settled videos plus what live leases report.
        frames_expected: Estimate of all frames; None until something is known.
        frames_per_s: Over the recent past, 0 when idle.
        eta_s: None when unknown.
        videos_done: Settled videos plus what live leases report; a video is settled when its shard is committed.
    """

    shards_total: int = 0
    shards_committed: int = 0
    videos_total: int = 0
    videos_succeeded: int = 0
    videos_failed: int = 0
    videos_quarantined: int = 0
    frames_done: int = 0
    frames_expected: int | None = None
    frames_per_s: float = 0.0
    eta_s: float | None = None
    videos_done: int = 0


@dataclass(frozen=True, slots=True)
class Job:
    """A job as it stands.

    Attributes:
        pause_reason, pause_message: Why it is paused, None otherwise.
        slot_seconds: Seconds that worker slots spent on it, those of lost and of live leases included.
        retries: How often its failed videos were tried again.
    """

    id: str
    spec: JobSpec
    state: JobState
    created_at: datetime
    updated_at: datetime
    tenant: str = "default"
    error_code: str | None = None
    error_message: str | None = None
    planned: bool = False
    started_at: datetime | None = None
    finished_at: datetime | None = None
    control: JobControl = field(default_factory=JobControl)
    pause_reason: str | None = None
    pause_message: str | None = None
    slot_seconds: float = 0.0
    retries: int = 0
    progress: JobProgress = field(default_factory=JobProgress)


@dataclass(frozen=True, slots=True)
class Death:
    """The end of a worker process that a video is blamed for.

    Attributes:
        reason: What ended it, in one line.
        place: Host and GPU, or host and slot; deaths in two places say more about the video than about either.
        holder: The agent.
        attempt: Of the shard.
        at: When the store heard of it, RFC 3339.
    """

    reason: str
    place: str = ""
    holder: str = ""
    attempt: int = 0
    at: str = ""

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


@dataclass(frozen=True, slots=True)
class Lease:
    """The right to work on one shard, until it expires.

    Attributes:
        fence: Grows with every lease of the shard; a smaller fence has lost.
        attempt: 1 for the first lease.
        spent: Video key -> the worker deaths already blamed on it.
        create_once: Whether the output decides between two writers of a record; otherwise the database does.
        retry: See `CommitRecord`.
    """

    job_id: str
    shard_id: str
    ordinal: int
    plan_hash: str
    videos: tuple[VideoRef, ...]
    spec: JobSpec
    attempt: int
    fence: int
    holder: str
    expires_at: datetime
    spent: dict[str, tuple[Death, ...]] = field(default_factory=dict)
    create_once: bool = True
    retry: int = 0


@dataclass(frozen=True, slots=True)
class LeaseProgress:
    """What a holder reports when it renews."""

    fence: int
    shard_id: str
    video_key: str | None = None
    stage: str | None = None
    videos_done: int = 0
    frames_done: int = 0
    frames_expected: int | None = None


@dataclass(frozen=True, slots=True)
class Renewal:
    """The store's answer to a renewal: go on, or stop and why."""

    shard_id: str
    verdict: Literal["continue", "lost", "cancel", "pause"]


@dataclass(frozen=True, slots=True)
class VideoResult:
    """One row of the dataset index. Everything but the first four is None where the video failed.

    Attributes:
        error_message: One line that names the input and says what to do.
        camera_params: Source-resolution parameters, half-pixel convention.
        quality: `Quality.summary()` of the engine.
        timings_s: Seconds per stage.
        peak_bytes: Most memory of the GPU per stage; None without one.
        source: What the probe found (codec, pixel format, rotation, size).
        deaths: The worker processes that died on it, where it is quarantined for them.
        views: Of a rig that succeeded, the rows of its views; its own row counts their frames, and describes the first
            and says what is said of the worst.
        rig: Of a view, the key of its rig.
        view: Of a view, its name in the rig.
    """

    key: str
    uri: str
    status: VideoStatus
    attempt: int
    error_code: str | None = None
    error_message: str | None = None
    num_frames: int | None = None
    num_keyframes: int | None = None
    width: int | None = None
    height: int | None = None
    fps: float | None = None
    duration_s: float | None = None
    camera_model: str | None = None
    camera_params: tuple[float, ...] | None = None
    fov_x_deg: float | None = None
    trajectory_length: float | None = None
    scale: str | None = None
    depth_kind: str | None = None
    quality: dict[str, Any] | None = None
    seconds: float | None = None
    timings_s: dict[str, float] | None = None
    source: dict[str, Any] | None = None
    provenance: dict[str, Any] | None = None
    deaths: tuple[Death, ...] | None = None
    peak_bytes: dict[str, int] | None = None
    views: tuple[VideoResult, ...] | None = None
    rig: str | None = None
    view: str | None = None

    @property
    def samples(self) -> tuple[VideoResult, ...]:
        """The rows of its samples in the data set: of the views of a rig, else its own; none where it failed."""
        if self.status is not VideoStatus.SUCCEEDED:
            return ()
        return (self,) if self.views is None else self.views

    def to_json(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> VideoResult:
        params, deaths, views = data.get("camera_params"), data.get("deaths"), data.get("views")
        return cls(
            **{
                **data,
                "status": VideoStatus(data["status"]),
                "camera_params": None if params is None else tuple(params),
                "deaths": None if deaths is None else tuple(Death(**death) for death in deaths),
                "views": None if views is None else tuple(cls.from_json(view) for view in views),
            }
        )


@dataclass(frozen=True, slots=True)
class PayloadObject:
    """One uploaded tar.

    Attributes:
        key: Object key relative to the output root, attempt-unique.
        members: Sample key -> member name -> (offset, size) of the data in the tar, so that one can be range-read.
    """

    attribute: Attribute
    key: str
    size_bytes: int
    sha256: str
    members: dict[str, dict[str, tuple[int, int]]]


@dataclass(frozen=True, slots=True)
class CommitRecord:
    """The one create-once object that makes a shard exist. Readers trust nothing else.

    Attributes:
        retry: Which retry of the job made this shard, 0 for its first plan. A row of a later retry takes the place of
            an earlier row of the same video that failed; nothing ever takes the place of one that succeeded.
    """

    job_id: str
    shard_id: str
    ordinal: int
    plan_hash: str
    config_hash: str
    attempt: int
    fence: int
    holder: str
    tar_name: str | None
    objects: tuple[PayloadObject, ...]
    videos: tuple[VideoResult, ...]
    retry: int = 0
    schema_version: int = 1

    @property
    def frames(self) -> int:
        return sum(v.num_frames or 0 for v in self.videos)

    def to_bytes(self) -> bytes:
        return (json.dumps(asdict(self), sort_keys=True, indent=1) + "\n").encode()

    @classmethod
    def from_bytes(cls, data: bytes) -> CommitRecord:
        raw = json.loads(data)
        objects = tuple(
            PayloadObject(
                **{
                    **o,
                    "members": {
                        sample: {name: (int(offset), int(size)) for name, (offset, size) in files.items()}
                        for sample, files in o["members"].items()
                    },
                }
            )
            for o in raw["objects"]
        )
        return cls(**{**raw, "objects": objects, "videos": tuple(VideoResult.from_json(v) for v in raw["videos"])})


@dataclass(frozen=True, slots=True)
class Event:
    """One line of a job's history; `seq` grows over the whole store."""

    seq: int
    job_id: str
    at: datetime
    kind: str
    data: dict[str, Any]


@dataclass(frozen=True, slots=True)
class Shard:
    id: str
    job_id: str
    ordinal: int
    state: ShardState
    num_videos: int
    attempts: int
    holder: str | None = None
    lease_expires_at: datetime | None = None
    tar_name: str | None = None
